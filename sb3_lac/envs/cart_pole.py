import math
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, stated_parameters


class CartPoleCostEnv(CostEnv):
    """
    ## Description

    A pole stands on a cart, which is to be kept at the origin with the pole upright: the stabilisation task of Han et al.
    (2020), with the dynamics of Barto, Sutton and Anderson (1983), integrated by Euler steps of 0.02 s.

    ## Action Space

    One number in [-1, 1]: the horizontal force on the cart, in units of `force_max_N`.

    ## Observation Space

    | index | variable | range | unit |
    | --- | --- | --- | --- |
    | 0 | position of the cart x | -20 .. 20 | m |
    | 1 | velocity of the cart | -1000 .. 1000 | m/s |
    | 2 | angle of the pole theta | -1 .. 1 | rad |
    | 3 | angular velocity of the pole | -1000 .. 1000 | rad/s |

    ## Cost

    `(x / 10)^2 + 20 * (theta / 0.349)^2` of the next state, and 100 for a transition that ends the episode. The reward is
    minus the cost. Inside, a step costs up to 21: the 100 is that of the paper, and dearer than any step, but not than the
    rest of an episode near the limits.

    `info["error"]` is the distance of the pole's tip from its place above the origin, in m.

    ## Starting State

    x is uniform in -5 .. 5, the other variables in -0.2 .. 0.2.

    ## Episode End

    Termination: |x| > 10 m or |theta| > 0.349 rad (20 degrees). Truncation: 250 steps.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `cart_mass_kg` | 1.0 | mass of the cart |
    | `pole_mass_kg` | 0.1 | mass of the pole |
    | `pole_half_length_m` | 0.5 | half the length of the pole |
    | `force_max_N` | 20.0 | force of action 1 |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is a force on the cart
    (N).

    ## Reference Controller

    A linear-quadratic regulator costs 0.36 per step on average over 100 episodes and drops no pole. 100 of 100 end with an
    error below 0.1 m, the largest is 0.066 m.

    ## Version History

    * v0: first version
    """

    state_names = ("x (m)", "dx/dt (m/s)", "theta (rad)", "dtheta/dt (rad/s)")
    error_name = "distance of the pole's tip from where it should be (m)"
    error_tolerance = 0.1
    cart_mass_kg: float = 1.0
    pole_mass_kg: float = 0.1
    pole_half_length_m: float = 0.5
    force_max_N: float = 20.0

    GRAVITY_M_S2 = 10.0
    DT_S = 0.02
    X_MAX_M = 10.0
    THETA_MAX_RAD = 0.349
    TERMINAL_COST = 100.0

    def __init__(self, **options: Any) -> None:
        parameters = stated_parameters(CartPoleCostEnv, options)
        state_high = np.array([2 * self.X_MAX_M, 1000.0, 1.0, 1000.0])
        observation_space = spaces.Box(-state_high.astype(np.float32), state_high.astype(np.float32))
        super().__init__(parameters, -state_high, state_high, observation_space, n_actions=1, **options)

    def _initial_state(self) -> np.ndarray:
        return self.np_random.uniform(-1.0, 1.0, 4) * (5.0, 0.2, 0.2, 0.2)

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        force = self.force_max_N * float(action[0]) + push
        x, x_dot, theta, theta_dot = state.tolist()
        sine, cosine = float(np.sin(theta)), float(np.cos(theta))
        mass, half_length = self.cart_mass_kg + self.pole_mass_kg, self.pole_half_length_m
        pull = (force + self.pole_mass_kg * half_length * theta_dot**2 * sine) / mass
        theta_acceleration = (self.GRAVITY_M_S2 * sine - cosine * pull) / (
            half_length * (4.0 / 3.0 - self.pole_mass_kg * cosine**2 / mass)
        )
        x_acceleration = pull - self.pole_mass_kg * half_length * theta_acceleration * cosine / mass
        return np.array(
            [
                x + self.DT_S * x_dot,
                x_dot + self.DT_S * x_acceleration,
                theta + self.DT_S * theta_dot,
                theta_dot + self.DT_S * theta_acceleration,
            ]
        )

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        if abs(next_state[0]) > self.X_MAX_M or abs(next_state[2]) > self.THETA_MAX_RAD:
            return self.TERMINAL_COST, True
        cost = (next_state[0] / self.X_MAX_M) ** 2 + 20.0 * (next_state[2] / self.THETA_MAX_RAD) ** 2
        return float(cost), False

    def _error(self) -> float:
        x, _, theta, _ = self.state.tolist()
        length = 2 * self.pole_half_length_m
        return math.hypot(x + length * math.sin(theta), length * (1.0 - math.cos(theta)))

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        x, _, theta, _ = states[-1]
        # The pole is five times as long as it is, to be seen on a track of 20 m
        length, track = 10.0 * self.pole_half_length_m, self.X_MAX_M
        axes.set(xlim=(-1.1 * track, 1.1 * track), ylim=(-3.0, 13.5))
        axes.plot([-track, -track, track, track], [0.6, 0.0, 0.0, 0.6], color="0.6")
        axes.plot([0.0, 0.0], [-1.2, 1.2 + length], color="tab:green", linestyle="--")
        axes.fill(x + np.array([-1.5, 1.5, 1.5, -1.5]), [0.3, 0.3, 1.2, 1.2], color="0.2")
        axes.plot([x - 1.0, x + 1.0], [0.3, 0.3], "o", color="0.2", markersize=8)
        tip = [x + length * math.sin(theta), 1.2 + length * math.cos(theta)]
        axes.plot([x, tip[0]], [1.2, tip[1]], color="tab:orange", linewidth=6, solid_capstyle="round")
