from abc import abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


def check_positive(**values: float) -> None:
    """
    Refuse parameters that make no sense.

    :param values: Parameters by name
    :raises ValueError: If one is not positive and finite
    """
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name}={value} must be positive and finite.")


def check_not_negative(**values: float) -> None:
    """
    Refuse parameters that make no sense.

    :param values: Parameters by name
    :raises ValueError: If one is negative or not finite
    """
    for name, value in values.items():
        if not 0 <= value < np.inf:
            raise ValueError(f"{name}={value} must be finite and at least 0.")


class CostEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    A control problem with a cost: the reward is ``-cost``, and ``info["cost"]`` holds the cost itself.

    Actions lie in [-1, 1]; each problem scales them. ``reset(options={"state": ...})`` starts from a given state.

    :param state_low: Smallest value of each state variable, shape (n,)
    :param state_high: Largest value of each state variable, shape (n,); states are clipped to these limits
    :param observation_space: What the agent sees, see ``_observation()``
    :param n_actions: Number of actions
    :param render_mode: ``"rgb_array"`` for a picture of the episode so far, or None
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 (as in gym.Env)
    #: Names of the state variables, for pictures and errors
    state_names: tuple[str, ...]

    def __init__(
        self,
        state_low: np.ndarray,
        state_high: np.ndarray,
        observation_space: spaces.Box,
        n_actions: int,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be one of {self.metadata['render_modes']}, or None.")
        self.state_low, self.state_high = state_low, state_high
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float32)
        self.render_mode = render_mode
        self.state: np.ndarray | None = None
        self.n_steps = 0

    @abstractmethod
    def _initial_state(self) -> np.ndarray:
        """
        :return: A random start, drawn with ``self.np_random``
        """

    @abstractmethod
    def _transition(self, state: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """
        :param state: Current state
        :param action: Action in [-1, 1]
        :return: Next state, cost of the transition, and whether the episode terminates
        """

    def _observation(self) -> np.ndarray:
        """
        :return: What the agent sees, the state by default
        """
        return np.asarray(self.state, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        start = self._initial_state()
        if options is not None and "state" in options:
            start = np.array(options["state"], dtype=np.float64)
            if start.shape != self.state_high.shape or not np.all((self.state_low <= start) & (start <= self.state_high)):
                raise ValueError(
                    f"options['state']={options['state']!r} must hold {len(self.state_high)} numbers {self.state_names} "
                    f"from {self.state_low.tolist()} to {self.state_high.tolist()}."
                )
        self.state = start
        self.n_steps = 0
        self._history = [(start, np.nan)]
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.all(np.isfinite(action)):
            raise ValueError(f"action={action} must be finite numbers in [-1, 1], shape {self.action_space.shape}.")
        state, cost, terminated = self._transition(self.state, np.clip(action, -1.0, 1.0))
        self.state = np.clip(state, self.state_low, self.state_high)
        self.n_steps += 1
        if self.render_mode is not None:
            self._history.append((self.state, cost))
        return self._observation(), -cost, terminated, False, {"cost": cost}

    def render(self) -> np.ndarray | None:
        """
        Draw the states and the costs of the episode so far.

        :return: Picture of shape (height, width, 3), or None without a render mode
        """
        if self.render_mode is None:
            return None
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset() before render().")
        # Drawing is rare, and slow to import
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        states = np.array([state for state, _ in self._history])
        figure = Figure(figsize=(6, 4), dpi=80, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        state_axes, cost_axes = figure.subplots(2, sharex=True, height_ratios=(2, 1))
        for name, values in zip(self.state_names, states.T, strict=True):
            state_axes.plot(values, marker="." if len(values) == 1 else None, label=name)
        state_axes.legend(loc="upper right", ncols=3, fontsize="small")
        state_axes.set_ylabel("state")
        cost_axes.plot([cost for _, cost in self._history], color="tab:red")
        cost_axes.set(xlabel="step", ylabel="cost")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
