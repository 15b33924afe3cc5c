"""Reference controllers of the cost environments: linear feedback, from Riccati equations."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from sb3_lac.envs import CartPoleCostEnv, LinearCostEnv


class LinearController:
    """
    Linear feedback ``u = -K s`` within the limits of the control.

    :param gain: K, shape (n_controls, n_states)
    :param control_max: control of action 1
    """

    def __init__(self, gain: np.ndarray, control_max: float) -> None:
        self.gain, self.control_max = np.atleast_2d(gain), control_max

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The control, as Stable-Baselines3 predicts actions.

        :param observation: states, shape (n, n_states)
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used
        :return: actions of shape (n, n_controls) in units of the largest control, and no state
        """
        actions = np.clip(-np.asarray(observation) @ self.gain.T / self.control_max, -1.0, 1.0)
        return actions.astype(np.float32), None


def cart_pole_gain() -> np.ndarray:
    """
    Gain of the linear-quadratic regulator of the cart and pole, linearised at the upright pole by central differences.

    :return: K of ``force_N = -K s``, shape (1, 4)
    """
    env = CartPoleCostEnv()
    step = 1e-5

    def move(state: np.ndarray, action: float) -> np.ndarray:
        return env._next_state(state, np.array([action]), 0.0)

    a = np.stack([(move(step * axis, 0.0) - move(-step * axis, 0.0)) / (2 * step) for axis in np.eye(4)], axis=1)
    b = (move(np.zeros(4), step) - move(np.zeros(4), -step))[:, None] / (2 * step * env.force_max_N)
    # the weights of the cost, with a little on the velocities and on the force, which cost nothing
    q, r = np.diag([1 / env.X_MAX_M**2, 0.01, 20 / env.THETA_MAX_RAD**2, 0.1]), np.array([[1e-3]])
    p = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)


def reference_controllers(env_id: str) -> dict[str, LinearController]:
    """
    Controllers that settle, and controllers that do not.

    :param env_id: ``LinearCost-v0`` or ``CartPoleCost-v0``
    :return: by name
    :raises ValueError: for any other environment
    """
    if env_id == "LinearCost-v0":
        env = LinearCostEnv()
        best = env.optimal_gain()
        gains = {"optimal": best, "weak": 0.15 * best, "hardly unstable": -0.14 * best, "wrong sign": -best}
        return {name: LinearController(gain, env.control_max) for name, gain in gains.items()}
    if env_id == "CartPoleCost-v0":
        best, force_max_N = cart_pole_gain(), CartPoleCostEnv().force_max_N
        return {
            name: LinearController(share * best, force_max_N)
            for name, share in {"regulator": 1.0, "too weak": 0.05, "none": 0.0}.items()
        }
    raise ValueError(f"{env_id} has no reference controllers: choose LinearCost-v0 or CartPoleCost-v0")
