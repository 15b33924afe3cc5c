import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, check_not_negative, runge_kutta_step, stated_parameters


class PendulumCostEnv(CostEnv):
    """
    ## Description

    A pendulum is to be swung up and kept upright by a motor that is too weak to lift it: its torque is 0.31 of the greatest
    torque of gravity, so that energy has to be pumped in over a few swings (Åström and Furuta, Swinging up a pendulum by
    energy control, Automatica 36, 2000).

    A point mass m on a massless rod of length l, with theta = 0 upright, torque u of the motor and damping d:

        m l^2 theta'' = m g l sin(theta) - d theta' + u

    integrated by Runge-Kutta steps of fourth order of 0.05 s, in which the torque is constant; g = 9.81 m/s^2. The motor turns
    at 12 rad/s at most, which is twice the speed of a fall from upright; there the speed is cut off.

    ## Action Space

    One number in [-1, 1]: the torque, in units of `torque_max_Nm`.

    ## Observation Space

    | index | variable | range | unit |
    | --- | --- | --- | --- |
    | 0 | cos(theta) | -1 .. 1 | |
    | 1 | sin(theta) | -1 .. 1 | |
    | 2 | angular velocity | -12 .. 12 | rad/s |

    The state, for `reset(options={"state": ...})`, is theta in -pi .. pi and the angular velocity.

    ## Cost

    `theta^2 + 0.1 (dtheta/dt)^2 + 0.01 u^2` with angle and velocity of the next state and the torque in N m that the action
    asks for. The reward is minus the cost. It is 9.9 at rest at the bottom, and 24.4 at most.

    `info["error"]` is the angle from upright, abs(theta), in rad.

    ## Starting State

    The angle is uniform in -pi .. pi, the angular velocity in -1 .. 1 rad/s.

    ## Episode End

    No termination. Truncation: 200 steps (10 s).

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `mass_kg` | 1.0 | the mass m |
    | `length_m` | 1.0 | the length l |
    | `damping_Nms` | 0.0 | the damping d |
    | `torque_max_Nm` | 3.0 | torque of action 1 |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is a torque (N m).

    ## Reference Controller

    Energy control, and a linear-quadratic regulator near the top, cost 0.89 per step on average over 100 episodes. 100 of 100
    end with an error below 0.01 rad, the largest is 4.6e-8 rad.

    ## Version History

    * v0: first version
    """

    state_names = ("theta (rad)", "dtheta/dt (rad/s)")
    error_name = "angle from upright (rad)"
    error_tolerance = 0.01
    mass_kg: float = 1.0
    length_m: float = 1.0
    damping_Nms: float = 0.0
    torque_max_Nm: float = 3.0

    GRAVITY_M_S2 = 9.81
    DT_S = 0.05
    SPEED_MAX_RAD_S = 12.0

    def __init__(self, **options: Any) -> None:
        parameters = stated_parameters(PendulumCostEnv, options)
        state_high = np.array([math.pi, self.SPEED_MAX_RAD_S])
        observation_high = np.array([1.0, 1.0, self.SPEED_MAX_RAD_S], dtype=np.float32)
        observation_space = spaces.Box(-observation_high, observation_high)
        super().__init__(parameters, -state_high, state_high, observation_space, n_actions=1, **options)

    def _check_parameters(self, **parameters: float) -> None:
        # A pendulum without friction is one of them
        check_not_negative(damping_Nms=parameters.pop("damping_Nms", 0.0))
        super()._check_parameters(**parameters)

    def _initial_state(self) -> np.ndarray:
        return self.np_random.uniform(-1.0, 1.0, 2) * (math.pi, 1.0)

    def _observation(self) -> np.ndarray:
        theta, speed = self.state.tolist()
        return np.array([math.cos(theta), math.sin(theta), speed], dtype=np.float32)

    def _limited(self, state: np.ndarray) -> np.ndarray:
        theta, speed = state.tolist()
        speed_max = self.SPEED_MAX_RAD_S
        return np.array([math.remainder(theta, math.tau), min(max(speed, -speed_max), speed_max)])

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        inertia = self.mass_kg * self.length_m**2
        gravity, damping = self.GRAVITY_M_S2 / self.length_m, self.damping_Nms / inertia
        drive = (self.torque_max_Nm * float(action[0]) + push) / inertia

        def derivative(x: Sequence[float]) -> tuple[float, float]:
            theta, speed = x
            return speed, gravity * math.sin(theta) - damping * speed + drive

        return np.array(runge_kutta_step(derivative, state.tolist(), self.DT_S))

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        theta, speed = next_state.tolist()
        torque = self.torque_max_Nm * float(action[0])
        return theta**2 + 0.1 * speed**2 + 0.01 * torque**2, False

    def _error(self) -> float:
        return abs(float(self.state[0]))

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        reach = 1.25 * self.length_m
        axes.set(xlim=(-1.33 * reach, 1.33 * reach), ylim=(-reach, reach))
        x, z = self.length_m * np.sin(states[:, 0]), self.length_m * np.cos(states[:, 0])
        axes.plot(0.0, self.length_m, "o", color="tab:green", markersize=34, markerfacecolor="none", markeredgewidth=3)
        axes.plot(x[-20:], z[-20:], color="tab:blue", alpha=0.5)
        axes.plot([0.0, x[-1]], [0.0, z[-1]], color="0.2", linewidth=5)
        axes.plot(0.0, 0.0, "o", color="0.6", markersize=10)
        axes.plot(x[-1], z[-1], "o", color="tab:orange", markersize=24)
