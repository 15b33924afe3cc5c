import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, runge_kutta_step, stated_parameters


class VehicleCostEnv(CostEnv):
    """
    ## Description

    A car has to follow the middle of a winding road at constant speed: the dynamic bicycle model in coordinates of the path
    (Rajamani, Vehicle Dynamics and Control, 2nd edition 2012, chapter 2), with tyres that slide, by Pacejka's magic formula
    (Bakker, Nyborg and Pacejka, Tyre modelling for use in vehicle dynamics studies, SAE 870421, 1987).

    With offset e and heading error psi from the path, lateral velocity v, yaw rate r, steering angle delta, distance s along
    the path with curvature kappa(s), speed V, mass m, moment of inertia J, distances l_f, l_r of the axles from the centre of
    gravity, their loads N_f = m g l_r / (l_f + l_r) and N_r = m g l_f / (l_f + l_r), and steering command u:

        e' = V sin(psi) + v cos(psi)
        psi' = r - kappa(s) s'
        m (v' + V r) = F_f cos(delta) + F_r
        J r' = l_f F_f cos(delta) - l_r F_r
        delta' = (u - delta) / steering_lag_s
        s' = (V cos(psi) - v sin(psi)) / (1 - kappa(s) e)
        F_f = friction N_f sin(1.5 arctan(10 (delta - arctan((v + l_f r) / V))))
        F_r = friction N_r sin(1.5 arctan(-10 arctan((v - l_r r) / V)))

    integrated by Runge-Kutta steps of fourth order of 0.05 s, in which the command is constant; g = 9.81 m/s^2. The path winds
    as `kappa(s) = 0.015 sin(2 pi s / 150)`, in 1/m and m: its bends ask for 3.4 m/s^2 at 15 m/s, and friction allows for 8.8.

    ## Action Space

    One number in [-1, 1]: the command of the steering angle, in units of `steering_max_rad`.

    ## Observation Space

    | index | variable | range | unit |
    | --- | --- | --- | --- |
    | 0 | offset e, positive to the left | -4 .. 4 | m |
    | 1 | heading error psi | -2 .. 2 | rad |
    | 2 | lateral velocity v | -20 .. 20 | m/s |
    | 3 | yaw rate r | -5 .. 5 | rad/s |
    | 4 | steering angle delta | -1 .. 1 | rad |
    | 5 | yaw rate of the path here, kappa(s) V | -5 .. 5 | rad/s |
    | 6 | yaw rate of the path 15 m ahead, kappa(s + 15) V | -5 .. 5 | rad/s |

    The last two tell the place on the path, so that the observation is Markov. The state, for `reset(options={"state": ...})`,
    is the first five and s in 0 .. 150 m.

    ## Cost

    `0.2 e^2 + 0.1 chi^2 + 0.1 ((a - delta / steering_max_rad) / 2)^2` with offset e and course error chi of the next state,
    the action a, and the steering angle before the step. The course error is the angle from the path to the velocity, `psi +
    arctan(v / V)`; the last term is for calm steering. The cost lies in 0 .. 1. A transition that ends the episode costs 300,
    1 for each step of an episode, so that leaving the road never is the cheaper way. The reward is minus the cost.

    `info["error"]` is the offset from the path, abs(e), in m.

    ## Starting State

    e is uniform in -1 .. 1 m, psi in -0.1 .. 0.1 rad, v in -0.5 .. 0.5 m/s, r in -0.1 .. 0.1 rad/s, delta is 0, and s uniform
    in 0 .. 150 m.

    ## Episode End

    Termination: abs(e) > 2 m, abs(psi) > 1 rad or abs(chi) > 1 rad. Truncation: 300 steps (15 s).

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `mass_kg` | 1500.0 | the mass m |
    | `inertia_kg_m2` | 2500.0 | the moment of inertia J about the vertical axis |
    | `front_axle_m` | 1.3 | distance l_f |
    | `rear_axle_m` | 1.4 | distance l_r |
    | `friction` | 0.9 | coefficient of friction of the road; 0.3 is snow |
    | `speed_m_s` | 15.0 | the speed V |
    | `steering_lag_s` | 0.1 | time constant of the steering |
    | `steering_max_rad` | 0.2 | steering angle of action 1, at most 1 |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is a lateral force on the
    centre of gravity (N), a gust.

    ## Reference Controller

    Output regulation with a linear-quadratic regulator costs 0.0020 per step on average over 100 episodes and never leaves the
    road. 100 of 100 end with an error below 0.01 m, the largest is 0.0055 m. On a slippery road, which it does not know of, it
    loses a part of the cars ([results](../cost_environments.md#reference-controllers)).

    ## Version History

    * v0: first version
    """

    state_names = ("e (m)", "psi (rad)", "v (m/s)", "r (rad/s)", "delta (rad)", "s (m)")
    _n_plotted = 5  # the place on the path would dwarf the others, and the plant shows it
    error_name = "offset from the path (m)"
    error_tolerance = 0.01
    mass_kg: float = 1500.0
    inertia_kg_m2: float = 2500.0
    front_axle_m: float = 1.3
    rear_axle_m: float = 1.4
    friction: float = 0.9
    speed_m_s: float = 15.0
    steering_lag_s: float = 0.1
    steering_max_rad: float = 0.2

    GRAVITY_M_S2 = 9.81
    DT_S = 0.05
    PATH_CURVATURE_1_m = 0.015
    PATH_PERIOD_M = 150.0
    PREVIEW_M = 15.0
    #: The magic formula's B and C
    TYRE_STIFFNESS, TYRE_SHAPE = 10.0, 1.5
    OFFSET_MAX_M = 2.0
    ANGLE_MAX_RAD = 1.0
    #: Weights of the cost: offset, course, steering
    WEIGHTS = (0.2, 0.1, 0.1)
    TERMINAL_COST = 300.0

    def __init__(self, **options: Any) -> None:
        parameters = stated_parameters(VehicleCostEnv, options)
        moving = [2 * self.OFFSET_MAX_M, 2 * self.ANGLE_MAX_RAD, 20.0, 5.0, 1.0]
        observation_high = np.array([*moving, 5.0, 5.0], dtype=np.float32)
        super().__init__(
            parameters,
            np.array([*(-limit for limit in moving), 0.0]),
            np.array([*moving, self.PATH_PERIOD_M]),
            spaces.Box(-observation_high, observation_high),
            n_actions=1,
            **options,
        )

    def _check_parameters(self, **parameters: float) -> None:
        super()._check_parameters(**parameters)
        for name, largest in {"steering_max_rad": 1.0, "speed_m_s": 5.0 / self.PATH_CURVATURE_1_m}.items():
            if parameters.get(name, 0.0) > largest:
                raise ValueError(f"{name}={parameters[name]} must be at most {largest:.4g}.")

    def curvature(self, distance_m: float) -> float:
        """Return the curvature of the path in 1/m, at a distance along it in m."""
        return self.PATH_CURVATURE_1_m * math.sin(math.tau * distance_m / self.PATH_PERIOD_M)

    def _initial_state(self) -> np.ndarray:
        start = self.np_random.uniform(-1.0, 1.0, 6) * (1.0, 0.1, 0.5, 0.1, 0.0, 1.0)
        start[5] = 0.5 * (start[5] + 1.0) * self.PATH_PERIOD_M
        return start

    def _observation(self) -> np.ndarray:
        *moving, distance = self.state.tolist()
        curvature, ahead = self.curvature(distance), self.curvature(distance + self.PREVIEW_M)
        return np.array([*moving, self.speed_m_s * curvature, self.speed_m_s * ahead], dtype=np.float32)

    def _limited(self, state: np.ndarray) -> np.ndarray:
        # The path goes on where it began
        return super()._limited(np.array([*state[:5], state[5] % self.PATH_PERIOD_M]))

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        front, rear, speed = self.front_axle_m, self.rear_axle_m, self.speed_m_s
        command = self.steering_max_rad * float(action[0])
        grip = self.friction * self.GRAVITY_M_S2 / (front + rear)  # force per mass of an axle at the other one's distance
        yaw_factor = self.mass_kg / self.inertia_kg_m2
        gust = push / self.mass_kg
        stiffness, shape = self.TYRE_STIFFNESS, self.TYRE_SHAPE

        def derivative(x: Sequence[float]) -> tuple[float, ...]:
            offset, heading, lateral, yaw_rate, steering, distance = x
            front_slip = steering - math.atan((lateral + front * yaw_rate) / speed)
            rear_slip = -math.atan((lateral - rear * yaw_rate) / speed)
            front_pull = grip * rear * math.sin(shape * math.atan(stiffness * front_slip)) * math.cos(steering)
            rear_pull = grip * front * math.sin(shape * math.atan(stiffness * rear_slip))
            sine, cosine = math.sin(heading), math.cos(heading)
            curvature = self.curvature(distance)
            progress = (speed * cosine - lateral * sine) / (1.0 - curvature * offset)
            return (
                speed * sine + lateral * cosine,
                yaw_rate - curvature * progress,
                front_pull + rear_pull + gust - speed * yaw_rate,
                yaw_factor * (front * front_pull - rear * rear_pull),
                (command - steering) / self.steering_lag_s,
                progress,
            )

        return np.array(runge_kutta_step(derivative, state.tolist(), self.DT_S))

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        offset, heading, lateral, *_ = next_state.tolist()
        course = heading + math.atan(lateral / self.speed_m_s)
        if abs(offset) > self.OFFSET_MAX_M or max(abs(heading), abs(course)) > self.ANGLE_MAX_RAD:
            return self.TERMINAL_COST, True
        turn = 0.5 * (float(action[0]) - float(state[4]) / self.steering_max_rad)
        offset_weight, course_weight, turn_weight = self.WEIGHTS
        return offset_weight * offset**2 + course_weight * course**2 + turn_weight * turn**2, False

    def _error(self) -> float:
        return abs(float(self.state[0]))

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        # The car from above, on a piece of the path around it; points of the plane are complex numbers
        offset, heading, _, _, steering, distance_m = states[-1]
        distances = math.floor(distance_m) + np.arange(-20.0, 45.0, 0.25)
        swing = self.PATH_CURVATURE_1_m * self.PATH_PERIOD_M / math.tau
        headings = -swing * np.cos(math.tau * distances / self.PATH_PERIOD_M)
        middle = 0.25 * np.cumsum(np.exp(1j * headings))

        def place(distance: Any, aside: Any) -> np.ndarray:
            along = np.exp(1j * np.interp(distance, distances, headings))
            return np.interp(distance, distances, middle) + 1j * aside * along

        view = place(distance_m + 8.0, 0.0)
        axes.set(xlim=(view.real - 16.0, view.real + 16.0), ylim=(view.imag - 12.0, view.imag + 12.0))
        road = np.concatenate((place(distances, self.OFFSET_MAX_M), place(distances, -self.OFFSET_MAX_M)[::-1]))
        axes.fill(road.real, road.imag, color="0.8")
        dashes = place(distances, np.where(distances % 5.0 < 2.5, 0.0, np.nan))
        axes.plot(dashes.real, dashes.imag, color="tab:green", linewidth=3)
        travelled = np.unwrap(states[:, 5], period=self.PATH_PERIOD_M)
        recent = travelled > travelled[-1] - 20.0
        trace = place(travelled[recent] - travelled[-1] + distance_m, states[recent, 0])
        axes.plot(trace.real, trace.imag, color="tab:blue")
        car, along = place(distance_m, offset), np.exp(1j * (heading + np.interp(distance_m, distances, headings)))
        front, rear = self.front_axle_m, self.rear_axle_m
        body = car + along * np.array([front + 0.8 + 0.9j, front + 0.8 - 0.9j, -rear - 0.8 - 0.9j, -rear - 0.8 + 0.9j])
        axes.fill(body.real, body.imag, color="tab:orange")
        for axle, turn in ((front, np.exp(1j * steering)), (-rear, 1.0)):
            for side in (-0.9j, 0.9j):
                wheel = car + along * (axle + side + turn * np.array([-0.5, 0.5]))
                axes.plot(wheel.real, wheel.imag, color="0.2", linewidth=3)
