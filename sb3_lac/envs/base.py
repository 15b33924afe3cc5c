import inspect
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_lac.envs.randomisation import Randomisation, Ranges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
else:  # slow to import, and only pictures need it
    Axes = Any


def check_positive(**values: float) -> None:
    """Refuse parameters that make no sense."""
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name}={value} must be positive and finite.")


def check_not_negative(**values: float) -> None:
    """Refuse parameters that make no sense."""
    for name, value in values.items():
        if not 0 <= value < np.inf:
            raise ValueError(f"{name}={value} must be finite and at least 0.")


def check_integer(**values: float) -> None:
    """Refuse numbers of steps that make no sense."""
    for name, value in values.items():
        if value != int(value):
            raise ValueError(f"{name}={value} must be a whole number of steps.")


def stated_parameters(problem: type["CostEnv"], options: dict[str, Any]) -> dict[str, float]:
    """Take the parameters out of the options of a problem, whose class states each as an attribute with its default."""
    return {name: options.pop(name, getattr(problem, name)) for name in inspect.get_annotations(problem)}


def _noise_std(name: str, std: float | Sequence[float], n: int) -> np.ndarray | None:
    """The standard deviation of each of n variables, None if there is no noise."""
    values = np.array(std, dtype=np.float64)
    if values.shape not in ((), (n,)) or not np.all((values >= 0) & (values < np.inf)):
        raise ValueError(f"{name}={std!r} must be a number, or {n} of them, finite and at least 0.")
    return np.broadcast_to(values, (n,)) if values.any() else None


def runge_kutta_step(
    derivative: Callable[[Sequence[float]], Sequence[float]], state: Sequence[float], dt_s: float
) -> list[float]:
    """Make a step of the classical Runge-Kutta method, with plain numbers: for a few variables they are faster than arrays."""
    half = 0.5 * dt_s
    k1 = derivative(state)
    k2 = derivative([x + half * k for x, k in zip(state, k1, strict=True)])
    k3 = derivative([x + half * k for x, k in zip(state, k2, strict=True)])
    k4 = derivative([x + dt_s * k for x, k in zip(state, k3, strict=True)])
    sixth = dt_s / 6.0
    return [x + sixth * (a + 2.0 * (b + c) + d) for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)]


class CostEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    A control problem with a cost: the reward is ``-cost``. ``info`` has ``"cost"``, and ``"error"``, the distance to the goal
    after the step, of the true state without noise (``error_name`` has its name and unit). The ``info`` of ``reset()`` has the
    initial error.

    Actions lie in [-1, 1]; each problem scales them. ``reset(options={"state": ...})`` starts from a given state.

    The disturbances are arguments of every problem, and off by default. A reference controller does not know them. They are
    the same in all episodes, or random in each episode (domain randomisation).

    :param parameters: Physical parameters of the problem by name. They become attributes of the environment
    :param state_low: Smallest value of each state variable, shape (n,)
    :param state_high: Largest value of each state variable, shape (n,); states are clipped to these limits
    :param observation_space: Space of the observations, see ``_observation()``
    :param n_actions: Number of actions
    :param changed_parameters: Disturbance: values of ``parameters`` other than the nominal ones
    :param impulse: Disturbance: size of a push for one step, in a random direction; each problem names the pushed variable
    :param impulse_interval: Steps from one push to the next
    :param process_noise: Disturbance: standard deviation of the Gaussian noise that is added to each state variable in each
        step, in its unit; one number for all, or one for each
    :param observation_noise: Disturbance: the same for each observed variable
    :param action_delay: Disturbance: steps until an action takes effect. Before that the plant gets zeros
    :param drawn: Disturbances that each episode samples anew, uniformly, in place of what is fixed: by name the smallest and
        the largest value of any of ``parameters``, ``impulse``, ``process_noise``, ``observation_noise`` and
        ``action_delay``. ``info["drawn"]`` tells what was sampled
    :param last_actions: Number of last actions added to the end of an observation, the latest first, zeros before the start.
        With a delay the policy needs these actions
    :param render_mode: ``"rgb_array"`` for pictures of the plant and of the episode so far, or None
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 (as in gym.Env)
    #: Names of the state variables, for pictures and errors
    state_names: tuple[str, ...]
    # of these the first so many are plotted over time
    _n_plotted: int | None = None
    #: What ``info["error"]`` is, with its unit
    error_name: str
    #: An ``info["error"]`` up to which an episode has reached the goal
    error_tolerance: float
    impulse: float
    action_delay: int
    #: None until the first episode starts
    state: np.ndarray

    def __init__(
        self,
        parameters: Mapping[str, float],
        state_low: np.ndarray,
        state_high: np.ndarray,
        observation_space: spaces.Box,
        n_actions: int,
        *,
        changed_parameters: Mapping[str, float] | None = None,
        impulse: float = 0.0,
        impulse_interval: int = 50,
        process_noise: float | Sequence[float] = 0.0,
        observation_noise: float | Sequence[float] = 0.0,
        action_delay: int = 0,
        drawn: Ranges | None = None,
        last_actions: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be one of {self.metadata['render_modes']}, or None.")
        changed = dict(changed_parameters or {})
        if unknown := changed.keys() - parameters.keys():
            raise ValueError(f"changed_parameters has {sorted(unknown)}, which are none of {sorted(parameters)}.")
        check_positive(impulse_interval=impulse_interval)
        check_not_negative(last_actions=last_actions)
        check_integer(impulse_interval=impulse_interval, last_actions=last_actions)
        self.state_low, self.state_high = state_low, state_high
        self.action_space = spaces.Box(-1.0, 1.0, (n_actions,), np.float32)
        self._plant_space, self.observation_space = observation_space, observation_space
        if last_actions > 0:
            ones = np.ones(n_actions * last_actions, np.float32)
            self.observation_space = spaces.Box(
                np.append(observation_space.low, -ones), np.append(observation_space.high, ones), dtype=np.float32
            )
        self.impulse_interval, self._zero_action = impulse_interval, np.zeros(n_actions)
        self._last_actions = deque([self._zero_action] * last_actions, maxlen=last_actions)
        #: The physical parameters as they are known, which make this problem without disturbances
        self.nominal_parameters = dict(parameters)
        disturbances = {"impulse": impulse, "process_noise": process_noise, "observation_noise": observation_noise}
        fixed = {**parameters, **disturbances, "action_delay": action_delay}
        self._randomisation = Randomisation(drawn or {}, {**dict.fromkeys(fixed, 0.0), "action_delay": 0})
        self._sampled: dict[str, float] = {}
        for values in (self._randomisation.smallest, self._randomisation.largest, {**fixed, **changed}):
            self._disturb(values)
        self.render_mode = render_mode
        self.state = None  # type: ignore[assignment]
        self.n_steps = 0

    def _disturb(self, values: Mapping[str, Any]) -> None:
        """Let physical parameters and disturbances have other values, unless one makes no sense."""
        for name, value in values.items():
            if name in self.nominal_parameters:
                self._check_parameters(**{name: value})
                setattr(self, name, value)
            elif name == "process_noise":
                self._process_noise = _noise_std(name, value, len(self.state_high))
            elif name == "observation_noise":
                self._observation_noise = _noise_std(name, value, self._plant_space.shape[0])
            else:
                check_not_negative(**{name: value})
                if name == "action_delay":
                    check_integer(action_delay=value)
                setattr(self, name, value)

    def _check_parameters(self, **parameters: float) -> None:
        """Refuse physical parameters that make no sense."""
        check_positive(**parameters)

    @abstractmethod
    def _initial_state(self) -> np.ndarray:
        """Sample the state that an episode starts from."""

    @abstractmethod
    def next_state(self, state: np.ndarray, action: np.ndarray, push: float) -> np.ndarray:
        """Move on by one step, with an action within its limits, and the push of an impulse if there is one."""

    @abstractmethod
    def _cost(self, state: np.ndarray, action: np.ndarray, next_state: np.ndarray) -> tuple[float, bool]:
        """The cost of a transition, and whether it ends the episode."""

    @abstractmethod
    def _error(self) -> float:
        """The distance of the present state to the goal."""

    def _draw(self, axes: Axes, states: np.ndarray) -> None:
        """Draw the plant in the last of its states so far, and its goal in green; without a drawing, the state in numbers."""
        text = "\n".join(f"{name} = {value:.3g}" for name, value in zip(self.state_names, states[-1], strict=True))
        axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)

    def _limited(self, state: np.ndarray) -> np.ndarray:
        """The nearest state within the limits."""
        return np.minimum(np.maximum(state, self.state_low), self.state_high)

    def _observation(self) -> np.ndarray:
        """Observe the present state, without noise."""
        return np.asarray(self.state, dtype=np.float32)

    def _noisy_observation(self) -> np.ndarray:
        observation = self._observation()
        if self._observation_noise is not None:
            noise = self._observation_noise * self.np_random.standard_normal(len(observation))
            observation = np.clip(observation + noise, self._plant_space.low, self._plant_space.high).astype(np.float32)
        if self._last_actions:
            observation = np.concatenate((observation, *reversed(self._last_actions)), dtype=np.float32)
        return observation

    def _info(self, **values: float) -> dict[str, Any]:
        """Return the entries of ``info``."""
        info: dict[str, Any] = {**values, "error": self._error()}
        return {**info, "drawn": dict(self._sampled)} if self._sampled else info

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, with ``options={"state": ...}`` from a given state; ``info`` holds its ``"error"``."""
        super().reset(seed=seed)
        if unknown := set(options or {}) - {"state"}:
            raise ValueError(f"options {sorted(map(str, unknown))} are unknown: there is 'state'.")
        start = self._initial_state()
        if options is not None and "state" in options:
            start = np.array(options["state"], dtype=np.float64)
            if start.shape != self.state_high.shape or not np.all((self.state_low <= start) & (start <= self.state_high)):
                raise ValueError(
                    f"options['state']={options['state']!r} must hold {len(self.state_high)} numbers {self.state_names} "
                    f"from {self.state_low.tolist()} to {self.state_high.tolist()}."
                )
        # After the start, which is the same without disturbances
        self._sampled = self._randomisation.sample(self.np_random)
        self._disturb(self._sampled)
        self.state = start
        self.n_steps = 0
        self._history = [(start, np.nan)]
        self._delayed_actions = deque([self._zero_action] * int(self.action_delay))
        self._last_actions.extend([self._zero_action] * len(self._last_actions))
        return self._noisy_observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move on by one step; ``info`` holds ``"cost"``, minus the reward, and ``"error"``."""
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        action = np.asarray(action)
        if action.dtype.kind not in "fiu":
            raise ValueError(f"action={action!r} must be real numbers.")
        action = action.astype(np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(f"action={action} must be finite numbers in [-1, 1], shape {self.action_space.shape}.")
        action = np.minimum(np.maximum(action, -1.0), 1.0)
        self._last_actions.append(action)
        if self.action_delay > 0:
            self._delayed_actions.append(action)
            action = self._delayed_actions.popleft()
        push = 0.0
        if self.impulse > 0 and (self.n_steps + 1) % self.impulse_interval == 0:
            push = self.impulse * (1.0 if self.np_random.random() < 0.5 else -1.0)
        next_state = self.next_state(self.state, action, push)
        if self._process_noise is not None:
            next_state = next_state + self._process_noise * self.np_random.standard_normal(len(next_state))
        next_state = self._limited(next_state)
        cost, terminated = self._cost(self.state, action, next_state)
        self.state = next_state
        self.n_steps += 1
        if self.render_mode is not None:
            self._history.append((self.state, cost))
        return self._noisy_observation(), -cost, terminated, False, self._info(cost=cost)

    def render(self) -> np.ndarray | None:
        """Draw the plant, and to the right of it states and costs so far: a picture of shape (300, 800, 3)."""
        if self.render_mode is None:
            return None
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset() before render().")
        # Drawing is rare, and slow to import
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        states = np.array([state for state, _ in self._history])
        figure = Figure(figsize=(8, 3), dpi=100, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        plant_axes = figure.add_axes((0.0, 0.0, 0.5, 1.0), aspect="equal")
        plant_axes.set_axis_off()
        self._draw(plant_axes, states)
        right = figure.add_subfigure(figure.add_gridspec(1, 2)[1])
        state_axes, cost_axes = right.subplots(2, sharex=True, height_ratios=(2, 1))
        for name, values in list(zip(self.state_names, states.T, strict=True))[: self._n_plotted]:
            state_axes.plot(values, marker="." if len(values) == 1 else None, label=name)
        right.legend(loc="outside upper center", ncols=3, fontsize="small")
        state_axes.set_ylabel("state")
        cost_axes.plot([cost for _, cost in self._history], color="tab:red")
        cost_axes.set(xlabel="step", ylabel="cost")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
