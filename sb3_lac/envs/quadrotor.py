import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, runge_kutta_step, stated_parameters


class QuadrotorCostEnv(CostEnv):
    """
    ## Description

    A quadrotor in a vertical plane has to fly to a point and hover there. It has two rotors for three degrees of freedom: to
    move sideways it must tilt (Tedrake, Underactuated Robotics, chapter on acrobots, cart-poles and quadrotors: the planar
    quadrotor).

    With position x, z, pitch phi (positive to the left), mass m, moment of inertia J, arm r, and forces F_1 of the left and
    F_2 of the right rotor:

        m x'' = -(F_1 + F_2) sin(phi)
        m z'' = (F_1 + F_2) cos(phi) - m g
        J phi'' = r (F_2 - F_1)

    integrated by Runge-Kutta steps of fourth order of 0.02 s, in which the forces are constant; g = 9.81 m/s^2. The default
    constants are those of a machine of 1 kg whose rotors lift twice its weight: it hovers at action 0.

    ## Action Space

    Two numbers in [-1, 1], one for each rotor, mapped to forces from 0 to `rotor_force_max_N`.

    ## Observation Space

    | index | variable | range | unit |
    | --- | --- | --- | --- |
    | 0 | x | -3 .. 3 | m |
    | 1 | z | -3 .. 3 | m |
    | 2 | phi | -pi .. pi | rad |
    | 3 | dx/dt | -20 .. 20 | m/s |
    | 4 | dz/dt | -20 .. 20 | m/s |
    | 5 | dphi/dt | -50 .. 50 | rad/s |

    ## Cost

    `0.16 (x^2 + z^2) + 0.07 phi^2 + 0.05 (a_1^2 + a_2^2)` with positions and pitch of the next state and the actions a. It
    lies in 0 .. 1. A transition that ends the episode costs 300, 1 for each step of an episode, so that leaving never is the
    cheaper way. The reward is minus the cost.

    `info["error"]` is the distance to the point, the Euclidean norm of (x, z), in m.

    ## Starting State

    x and z are uniform in -1 .. 1 m, phi in -0.3 .. 0.3 rad, velocities in -0.5 .. 0.5 m/s and rad/s.

    ## Episode End

    Termination: abs(x) > 1.5 m, abs(z) > 1.5 m or abs(phi) > pi / 2. Truncation: 300 steps (6 s).

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `mass_kg` | 1.0 | the mass m |
    | `inertia_kg_m2` | 0.02 | the moment of inertia J |
    | `arm_m` | 0.2 | distance r from the middle to a rotor |
    | `rotor_force_max_N` | 9.81 | force of a rotor at action 1 |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is a horizontal force on
    the middle (N), a gust.

    ## Reference Controller

    A linear-quadratic regulator costs 0.0079 per step on average over 100 episodes and never leaves. 100 of 100 end with an
    error below 0.01 m, the largest is 4.2e-7 m.

    ## Version History

    * v0: first version
    """

    state_names = ("x (m)", "z (m)", "phi (rad)", "dx/dt (m/s)", "dz/dt (m/s)", "dphi/dt (rad/s)")
    error_name = "distance to the point (m)"
    error_tolerance = 0.01
    mass_kg: float = 1.0
    inertia_kg_m2: float = 0.02
    arm_m: float = 0.2
    rotor_force_max_N: float = 9.81

    GRAVITY_M_S2 = 9.81
    DT_S = 0.02
    POSITION_MAX_M = 1.5
    PITCH_MAX_RAD = math.pi / 2
    #: Weights of the cost: position, pitch, action
    WEIGHTS = (0.16, 0.07, 0.05)
    TERMINAL_COST = 300.0

    def __init__(self, **options: Any) -> None:
        parameters = stated_parameters(QuadrotorCostEnv, options)
        position = 2 * self.POSITION_MAX_M
        state_high = np.array([position, position, math.pi, 20.0, 20.0, 50.0])
        # The float32 nearest to pi is above it
        observation_space = spaces.Box(-state_high.astype(np.float32), state_high.astype(np.float32))
        super().__init__(parameters, -state_high, state_high, observation_space, n_actions=2, **options)

    def _initial_state(self) -> np.ndarray:
        return self.np_random.uniform(-1.0, 1.0, 6) * (1.0, 1.0, 0.3, 0.5, 0.5, 0.5)

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        left, right = (0.5 * self.rotor_force_max_N * (a + 1.0) for a in action.tolist())
        thrust, gust = (left + right) / self.mass_kg, push / self.mass_kg
        pitch_acceleration = self.arm_m * (right - left) / self.inertia_kg_m2
        gravity = self.GRAVITY_M_S2

        def derivative(s: Sequence[float]) -> tuple[float, ...]:
            _, _, phi, x_dot, z_dot, phi_dot = s
            return x_dot, z_dot, phi_dot, gust - thrust * math.sin(phi), thrust * math.cos(phi) - gravity, pitch_acceleration

        return np.array(runge_kutta_step(derivative, state.tolist(), self.DT_S))

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        x, z, phi, *_ = next_state.tolist()
        if max(abs(x), abs(z)) > self.POSITION_MAX_M or abs(phi) > self.PITCH_MAX_RAD:
            return self.TERMINAL_COST, True
        left, right = action.tolist()
        position, pitch, effort = self.WEIGHTS
        return position * (x**2 + z**2) + pitch * phi**2 + effort * (left**2 + right**2), False

    def _error(self) -> float:
        return math.hypot(self.state[0], self.state[1])

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        limit = self.POSITION_MAX_M
        axes.set(xlim=(-1.47 * limit, 1.47 * limit), ylim=(-1.1 * limit, 1.1 * limit))
        axes.plot(limit * np.array([-1, 1, 1, -1, -1]), limit * np.array([-1, -1, 1, 1, -1]), color="0.8", linestyle="--")
        axes.plot(0.0, 0.0, "o", color="tab:green", markersize=30, markerfacecolor="none", markeredgewidth=3)
        axes.plot(states[:, 0], states[:, 1], color="tab:blue", alpha=0.5)
        x, z, phi = states[-1, :3]
        along, up = np.array([math.cos(phi), math.sin(phi)]), np.array([-math.sin(phi), math.cos(phi)])
        for side in (-self.arm_m, self.arm_m):
            rotor = [[x, z] + side * along, [x, z] + side * along + 0.06 * up]
            axes.plot(*np.transpose([[x, z], *rotor]), color="0.2", linewidth=4)
            axes.plot(*np.transpose([rotor[1] - 0.13 * along, rotor[1] + 0.13 * along]), color="tab:orange", linewidth=3)
