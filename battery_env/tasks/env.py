"""A calibration task as a Gymnasium environment."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from battery_env.records import Record
from battery_env.tasks.base import OBSERVATION_LIMIT, CalibrationTask

_ROW = np.zeros(1, dtype=np.intp)
FloatSpace = gym.Space[NDArray[np.float32]]


def task_class(task: str | type[CalibrationTask]) -> type[CalibrationTask]:
    """Return the class of a task."""
    if not isinstance(task, str):
        return task
    module, _, name = task.partition(":")
    loaded: type[CalibrationTask] = getattr(import_module(module), name)
    return loaded


def new_task(task: str | type[CalibrationTask], cells: int, options: Mapping[str, Any]) -> CalibrationTask:
    """Make a task for a number of cells."""
    task_type: Any = task_class(task)  # a subclass, whose arguments the base class does not declare
    defaults = task_type.options()
    unknown = options.keys() - defaults.keys()
    if unknown:
        # Python's own message, which libraries look for: TorchRL tries each environment with a ``frameskip``
        names = ", ".join(map(repr, sorted(unknown)))
        raise TypeError(f"got an unexpected keyword argument {names}. There are {', '.join(sorted(defaults))}")
    instance: CalibrationTask = task_type(cells, **options)
    return instance


def spaces_of(task: CalibrationTask) -> tuple[FloatSpace, FloatSpace]:
    """Return the observation space and the action space of one cell."""
    return (
        gym.spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, shape=(task.observation_size,), dtype=np.float32),
        gym.spaces.Box(-1.0, 1.0, shape=(len(task.parameters),), dtype=np.float32),
    )


class CalibrationEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """
    A calibration task for one cell. The reward is minus the cost, and ``info`` holds the cost and the
    :meth:`~battery_env.tasks.base.CalibrationTask.report`. ``help(env.task)`` describes observations, actions, costs and
    options.

    :param task: the class of the task, or its path, as ``"module:name"``
    :param render_mode: ``"rgb_array"`` or ``None``
    :param options: of the task
    :raises TypeError: for an option that the task does not have
    :raises ValueError: for values out of range
    :cvar metadata: Gymnasium's entries, and ``discount``, the discount factor of the tasks, LAC's default. A wrong parameter
        shows within a second or a decision; later costs only add noise
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in gym.Env)
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "discount": 0.8,
    }

    def __init__(self, task: str | type[CalibrationTask], render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.render_mode = render_mode
        self.task = new_task(task, 1, options)
        self.observation_space, self.action_space = spaces_of(self.task)
        self._history: deque[dict[str, float]] = deque(maxlen=int(self.task.episode_steps))

    @property
    def dataset(self) -> Sequence[Record]:
        """The discharges that episodes are drawn from."""
        return self.task.dataset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode.

        :param seed: seed of this and the following episodes
        :param options: choices that replace random draws; the page of the environment names them
        :return: observation, info
        """
        super().reset(seed=seed)
        self.task.start(_ROW, [self.np_random], options)
        self._history.clear()
        return self.task.observation()[0], self._info(0.0)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """
        Take one decision.

        :param action: shape (number of parameters,), in [-1, 1]
        :return: observation, reward (minus the cost), terminated (never), truncated (end of the episode or of the data), info
        :raises ValueError: for an action of another shape, NaN, or a value that is no number
        """
        task = self.task
        cost = task.advance(np.asarray(action)[None]).item()
        info = self._info(cost)
        if self.render_mode is not None:
            self._history.append(info)
        return task.observation()[0], -cost, False, task.truncated().item(), info

    def _info(self, cost: float) -> dict[str, Any]:
        info = {name: value.item() for name, value in self.task.report().items()}
        info["cost"] = cost
        return info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the episode so far, shape (height, width, 3), or ``None`` without a render mode."""
        if self.render_mode is None:
            return None
        from battery_env.tasks.rendering import draw_frame  # matplotlib takes long to import

        return draw_frame(self._history, self.task)
