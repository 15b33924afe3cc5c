"""
Controllers that need no learning, one for each cost environment: the yardstick for what a policy learns.

They know the problem by its equations and nominal parameters, and see what a policy sees.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_lac.envs.base import CostEnv
from sb3_lac.envs.cart_pole import CartPoleCostEnv
from sb3_lac.envs.linear import LinearCostEnv, riccati_gain
from sb3_lac.envs.oscillator import OscillatorEnv
from sb3_lac.envs.pendulum import PendulumCostEnv
from sb3_lac.envs.quadrotor import QuadrotorCostEnv
from sb3_lac.envs.vehicle import VehicleCostEnv


def _linearised(model: CostEnv, at_rest: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of ``s' = A s + B (a - at_rest)`` about state zero, by central differences."""
    n, m = len(model.state_high), len(model.action_space.low)  # type: ignore[attr-defined]
    step = 1e-5

    def next_state(state_and_action: np.ndarray) -> np.ndarray:
        return model.next_state(state_and_action[:n], at_rest + state_and_action[n:], 0.0)

    columns = [(next_state(step * unit) - next_state(-step * unit)) / (2.0 * step) for unit in np.eye(n + m)]
    return np.array(columns[:n]).T, np.array(columns[n:]).T


class ReferenceController:
    """
    A controller with the ``predict()`` of a model of Stable-Baselines3, without memory or randomness: a linear one, unless a
    subclass says otherwise.

    :param model: The nominal problem, without disturbances
    """

    #: Actions per observation, towards the goal
    gain: np.ndarray
    #: Action that keeps the goal
    at_rest = 0.0

    def __init__(self, model: CostEnv) -> None:
        self.observation_space, self.action_space = model.observation_space, model.action_space
        assert model.observation_space.shape is not None
        self._n_seen = model.observation_space.shape[0]

    def _actions(self, observations: np.ndarray) -> np.ndarray:
        """The actions for a batch of observations, not yet limited."""
        return self.at_rest - observations @ self.gain.T

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Actions for one observation or a batch.

        :param observation: One observation, or several, shape (n, number of observed variables)
        :param state: Returned as it is
        :param episode_start: Not used
        :param deterministic: Not used
        :return: Actions in [-1, 1], float32, and ``state``
        :raises ValueError: If the observations are none of the environment
        """
        if isinstance(observation, dict):
            raise ValueError("observation is a dict, and the cost environments have arrays.")
        observations = np.asarray(observation, dtype=np.float64)
        size = self.observation_space.shape or ()
        if observations.ndim not in (1, 2) or observations.shape[-1:] != size:
            raise ValueError(f"observation has shape {observations.shape}, and not {size} or (n, {size[0]}).")
        # Without last actions: these controllers know of no delay
        actions = self._actions(np.atleast_2d(observations)[:, : self._n_seen])
        limited = np.clip(actions, -1.0, 1.0).astype(np.float32)
        return (limited if observations.ndim == 2 else limited[0]), state


class LinearController(ReferenceController):
    """
    ``a = -K s`` of the linear-quadratic regulator with the cost of ``LinearCostEnv``: the best there is, but for the limits of
    the action.
    """

    def __init__(self, model: LinearCostEnv) -> None:
        super().__init__(model)
        self.gain = model.optimal_gain() / model.control_max


class CartPoleController(ReferenceController):
    """
    The linear-quadratic regulator of the linearised cart and pole. Its weights are not those of the cost, which has none on
    the force and little on the position: these bring the cart home within an episode, and drop the pole from no start.
    """

    def __init__(self, model: CartPoleCostEnv) -> None:
        super().__init__(model)
        a, b = _linearised(model)
        self.gain = riccati_gain(a, b, np.diag([0.03, 0.0, 10.0, 0.0]), np.eye(1))


class OscillatorController(ReferenceController):
    """
    Inversion of the model: light on the first messenger such that the first protein meets its reference in two steps, which is
    as soon as light can reach it. Full light on the third messenger, whose protein represses the first one, leaves that to
    light alone; none on the second.
    """

    def __init__(self, model: OscillatorEnv) -> None:
        super().__init__(model)
        self.model = model
        self._two_cosines = 2.0 * math.cos(math.tau / model.PERIOD_STEPS)

    def _actions(self, observations: np.ndarray) -> np.ndarray:
        model = self.model
        messenger, protein, repressor = observations[:, 0], observations[:, 3], observations[:, 5]
        deviation, next_deviation = observations[:, 6] - model.reference(0), observations[:, 7] - model.reference(0)
        # The next value of a sine from two of them
        wanted_protein = self._two_cosines * next_deviation - deviation + model.reference(0)
        next_protein = protein + model.translation * messenger - model.protein_decay * protein
        wanted_messenger = (wanted_protein - (1.0 - model.protein_decay) * next_protein) / model.translation
        dark = messenger - model.messenger_decay * messenger + model.transcription / (model.half_saturation + repressor**2)
        light = (wanted_messenger - dark) / model.light
        return np.column_stack((2.0 * light - 1.0, np.full(len(light), -1.0), np.ones(len(light))))


class PendulumController(ReferenceController):
    """
    Energy control until the pendulum passes the top slowly enough to be caught (Åström and Furuta 2000), and then the
    linear-quadratic regulator with the cost of ``PendulumCostEnv``.
    """

    #: Above this cosine of the angle, the regulator takes over as soon as its torque is within the limits
    CATCH_COSINE = 0.9

    def __init__(self, model: PendulumCostEnv) -> None:
        super().__init__(model)
        self.model = model
        a, b = _linearised(model)
        self.gain = riccati_gain(a, b, np.diag([1.0, 0.1]), np.array([[0.01 * model.torque_max_Nm**2]]))

    def _actions(self, observations: np.ndarray) -> np.ndarray:
        model = self.model
        cosine, sine, speed = observations.T
        # Energy per moment of inertia, zero at rest upright
        energy = 0.5 * speed**2 + model.GRAVITY_M_S2 / model.length_m * (cosine - 1.0)
        drive = -np.sign(energy) * np.where(speed < 0, -1.0, 1.0)
        caught = -np.column_stack((np.arctan2(sine, cosine), speed)) @ self.gain.T
        is_caught = (cosine > self.CATCH_COSINE) & (np.abs(caught[:, 0]) < 1.0)
        return np.where(is_caught, caught[:, 0], drive)[:, None]


class QuadrotorController(ReferenceController):
    """The linear-quadratic regulator of the linearised quadrotor with the cost of ``QuadrotorCostEnv``."""

    def __init__(self, model: QuadrotorCostEnv) -> None:
        super().__init__(model)
        self.at_rest = model.mass_kg * model.GRAVITY_M_S2 / model.rotor_force_max_N - 1.0
        a, b = _linearised(model, self.at_rest)
        position, pitch, effort = model.WEIGHTS
        self.gain = riccati_gain(a, b, np.diag([position, position, pitch, 0.0, 0.0, 0.0]), effort * np.eye(2))


class VehicleController(ReferenceController):
    """
    Output regulation (Francis, The linear multivariable regulator problem, SIAM Journal on Control and Optimization 15, 1977)
    of the linearised vehicle: the winding path is the output of an oscillator with state w. Where ``x = Pi w`` and
    ``a = Gamma w``, the linear model stays on the path, and a linear-quadratic regulator leads it there.
    """

    def __init__(self, model: VehicleCostEnv) -> None:
        super().__init__(model)
        n = 5  # all but the distance
        a, b = (matrix[:n] for matrix in _linearised(model))
        a = a[:, :n]
        # w = (sin, cos) of the place on the path, and what each does to a vehicle that drives straight ahead
        places = (model.PATH_PERIOD_M / 4.0, 0.0)
        path = np.array([model.next_state(np.array([0.0] * n + [place]), np.zeros(1), 0.0)[:n] for place in places]).T
        turn = math.tau * model.speed_m_s * model.DT_S / model.PATH_PERIOD_M
        oscillator = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        # Pi S = A Pi + B Gamma + E with no offset, (1, 0, ..., 0) Pi = 0, for columns of Pi and Gamma one below the other
        identity = np.eye(2)
        dynamics = np.hstack((np.kron(oscillator.T, np.eye(n)) - np.kron(identity, a), -np.kron(identity, b)))
        no_offset = np.hstack((np.kron(identity, np.eye(1, n)), np.zeros((2, 2))))
        solution = np.linalg.solve(np.vstack((dynamics, no_offset)), np.concatenate((path.T.ravel(), np.zeros(2))))
        self.on_path, self.command = solution[: 2 * n].reshape(2, n), solution[2 * n :, None]
        offset, course, turning = model.WEIGHTS
        # The cost as a quadratic form, but for its products of state and action
        course_row = np.array([[0.0, 1.0, 1.0 / model.speed_m_s, 0.0, 0.0]])
        q = offset * np.diag(np.eye(n)[0]) + course * course_row.T @ course_row
        self.gain = riccati_gain(a, b, q, np.array([[0.25 * turning]]))
        ahead = math.tau * model.PREVIEW_M / model.PATH_PERIOD_M
        amplitude = model.speed_m_s * model.PATH_CURVATURE_1_m
        # From the two observed yaw rates to w
        self.to_place = np.linalg.inv([[amplitude, 0.0], [amplitude * math.cos(ahead), amplitude * math.sin(ahead)]])

    def _actions(self, observations: np.ndarray) -> np.ndarray:
        place = observations[:, 5:] @ self.to_place.T
        return place @ self.command - (observations[:, :5] - place @ self.on_path) @ self.gain.T


_CONTROLLERS: dict[type[CostEnv], Any] = {
    CartPoleCostEnv: CartPoleController,
    LinearCostEnv: LinearController,
    OscillatorEnv: OscillatorController,
    PendulumCostEnv: PendulumController,
    QuadrotorCostEnv: QuadrotorController,
    VehicleCostEnv: VehicleController,
}


def reference_controller(env: gym.Env[Any, Any]) -> ReferenceController:
    """
    The reference controller of a cost environment, to compare policies with.

    The controller is designed for the problem without disturbances, and does not know ``changed_parameters``. Known parameters
    are arguments of the environment.

    :param env: One of the cost environments; wrappers must leave observations and actions as they are
    :return: The controller
    :raises ValueError: If this environment has no reference controller
    """
    problem = env.unwrapped
    make_controller = _CONTROLLERS.get(type(problem))  # type: ignore[arg-type]
    if make_controller is None:
        names = sorted(env_type.__name__ for env_type in _CONTROLLERS)
        raise ValueError(f"env={env} has no reference controller: it must be one of {names}.")
    assert isinstance(problem, CostEnv)
    if env.observation_space != problem.observation_space or env.action_space != problem.action_space:
        raise ValueError(f"env={env} has a wrapper that changes observations or actions, which the controller would not know.")
    make_problem: Any = type(problem)  # each has arguments of its own
    controller: ReferenceController = make_controller(make_problem(**problem.nominal_parameters))
    controller.observation_space = env.observation_space
    return controller
