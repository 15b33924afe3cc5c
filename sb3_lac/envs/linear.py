import math
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_lac.envs.base import Axes, CostEnv, check_not_negative, stated_parameters


def riccati_gain(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The linear-quadratic regulator (discrete algebraic Riccati equation)."""
    from scipy.linalg import solve_discrete_are  # slow to import, and no training needs it

    p = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)


class LinearCostEnv(CostEnv):
    """
    ## Description

    A force has to bring a lightly damped mass on a spring to rest, with little noise: the linear-quadratic regulator problem.
    LAC can be compared with exact solutions here: the best policy (`optimal_gain`), the value L of a linear policy
    (`cost_to_go`), and the largest feasible alpha3 of the decrease condition (`largest_feasible_alpha3`).

        s' = A s + B u + w,    A = [[0.96, 0.2], [-0.2, 0.96]],  B = [[0], [0.5]],  w ~ N(0, noise_std^2 I)

    ## Action Space

    One number in [-1, 1]: the control u in units of `control_max`.

    ## Observation Space

    | index | variable | range |
    | --- | --- | --- |
    | 0 | position | -100 .. 100 |
    | 1 | velocity | -100 .. 100 |

    ## Cost

    `s^T Q s + u^T R u` of the current state and control, with Q = I and R = 1. The reward is minus the cost.

    `info["error"]` is the Euclidean norm of the state after the step.

    ## Starting State

    Both variables are uniform in -1 .. 1.

    ## Episode End

    No termination. Truncation: 100 steps.

    ## Arguments

    | argument | default | meaning |
    | --- | --- | --- |
    | `noise_std` | 0.01 | standard deviation of the noise on each state |
    | `control_max` | 2.0 | control of action 1 |

    and the [disturbances](../cost_environments.md#disturbances) of all cost environments. `impulse` is added to the control u,
    and `process_noise` to the noise that the problem has.

    ## Reference Controller

    The linear-quadratic regulator is the optimum. It costs 0.028 per step on average over 100 episodes, because of the
    noise. 100 of 100 end with an error below 0.1, the largest is 0.057.

    ## Version History

    * v0: first version
    """

    state_names = ("position", "velocity")
    error_name = "norm of the state"
    error_tolerance = 0.1
    control_max: float = 2.0

    A = np.array([[0.96, 0.2], [-0.2, 0.96]])
    B = np.array([[0.0], [0.5]])
    Q = np.eye(2)
    R = np.eye(1)
    STATE_MAX = 100.0

    def __init__(self, noise_std: float = 0.01, **options: Any) -> None:
        check_not_negative(noise_std=noise_std)
        observation_space = spaces.Box(-self.STATE_MAX, self.STATE_MAX, (2,), np.float32)
        state_high = np.full(2, self.STATE_MAX)
        parameters = stated_parameters(LinearCostEnv, options)
        super().__init__(parameters, -state_high, state_high, observation_space, n_actions=1, **options)
        self.noise_std = noise_std

    def _initial_state(self) -> np.ndarray:
        return self.np_random.uniform(-1.0, 1.0, 2)

    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        control = self.control_max * action
        return self.A @ state + self.B @ (control + push) + self.noise_std * self.np_random.standard_normal(2)

    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        control = self.control_max * action
        return float(state @ self.Q @ state + control @ self.R @ control), False

    def _error(self) -> float:
        return math.hypot(*self.state)

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        reach = max(1.3, 1.1 * float(np.abs(states).max()))
        axes.set(xlim=(-1.33 * reach, 1.33 * reach), ylim=(-reach, reach))
        axes.axhline(color="0.8")
        axes.axvline(color="0.8")
        axes.text(1.3 * reach, 0.03 * reach, self.state_names[0], ha="right", fontsize="large")
        axes.text(0.05 * reach, 0.88 * reach, self.state_names[1], fontsize="large")
        turn = np.linspace(0.0, math.tau, 50)
        axes.fill(self.error_tolerance * np.cos(turn), self.error_tolerance * np.sin(turn), color="tab:green")
        axes.plot(*states.T, ".-", color="tab:blue")
        axes.plot(*states[-1], "o", color="0.2", markersize=10)

    def optimal_gain(self, gamma: float = 1.0) -> np.ndarray:
        """
        Gain of the policy ``u = -K s`` that minimises the discounted sum of costs (discrete algebraic Riccati equation).

        :param gamma: The discount factor
        :return: K, shape (1, 2)
        """
        return riccati_gain(np.sqrt(gamma) * self.A, np.sqrt(gamma) * self.B, self.Q, self.R)

    def value_matrix(self, gain: np.ndarray, gamma: float) -> np.ndarray:
        """
        Matrix P of the discounted cost to go ``s^T P s + const`` of a linear policy (discrete Lyapunov equation).

        :param gain: K of the policy ``u = -K s``, shape (1, 2)
        :param gamma: The discount factor
        :return: P, shape (2, 2)
        :raises ValueError: If the discounted sum of costs is infinite with this policy
        """
        from scipy.linalg import solve_discrete_lyapunov

        closed_loop = np.sqrt(gamma) * (self.A - self.B @ gain)
        radius = np.abs(np.linalg.eigvals(closed_loop)).max()
        if not radius < 1:
            raise ValueError(
                f"gain={np.asarray(gain).tolist()} makes the discounted sum of costs infinite: the spectral radius of "
                f"sqrt(gamma) (A - B K) is {radius:.4g} and must be below 1."
            )
        return solve_discrete_lyapunov(closed_loop.T, self.Q + gain.T @ self.R @ gain)

    def cost_to_go(self, states: np.ndarray, controls: np.ndarray, gain: np.ndarray, gamma: float) -> np.ndarray:
        """
        The exact ``L(s, a)``: discounted sum of costs of a control now and of the linear policy from the next step on.

        :param states: Shape (n, 2)
        :param controls: u, not scaled, shape (n, 1)
        :param gain: K of the policy ``u = -K s``, shape (1, 2)
        :param gamma: The discount factor, below 1
        :return: Shape (n,)
        """
        p = self.value_matrix(gain, gamma)
        # The noise of each step adds its variance times the curvature of the value
        noise = gamma / (1 - gamma) * self.noise_std**2 * np.trace(p)
        next_states = states @ self.A.T + controls @ self.B.T
        stage_costs = np.einsum("ni,ij,nj->n", states, self.Q, states) + np.einsum("ni,ij,nj->n", controls, self.R, controls)
        return stage_costs + gamma * np.einsum("ni,ij,nj->n", next_states, p, next_states) + noise

    def largest_feasible_alpha3(self, gain: np.ndarray, gamma: float, n_steps: int = 100) -> float:
        """
        The largest ``alpha3`` with which ``E[L(s', a')] - L(s, a) <= -alpha3 * c`` holds on average over roll-outs of a linear
        policy from the starting states. The differences telescope: what counts is ``L`` at the start and at the end, and the
        sum of the costs between.

        :param gain: K of the policy ``u = -K s``, shape (1, 2)
        :param gamma: The discount factor of ``L``
        :param n_steps: Length of the roll-outs
        :return: ``sum E[L - L'] / sum E[c]``
        """
        p = self.value_matrix(gain, gamma)
        closed_loop = self.A - self.B @ gain
        stage = self.Q + gain.T @ self.R @ gain
        start = np.eye(2) / 3.0  # second moments of the uniform distribution on -1 .. 1
        moments, costs = start, 0.0
        for _ in range(n_steps):
            costs += float(np.trace(stage @ moments))
            moments = closed_loop @ moments @ closed_loop.T + self.noise_std**2 * np.eye(2)
        return float(np.trace(p @ (start - moments)) / costs)
