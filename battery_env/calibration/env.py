"""The calibration task as a Gymnasium environment."""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from typing import Any, Literal, SupportsFloat

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from battery_env.calibration.full_state import OBSERVATION_LIMIT, FullStateTask, Parameter
from battery_env.trajectories import TrajectoryDataset

_ROW = np.zeros(1, dtype=np.intp)

Split = Literal["train", "test", "all"]


@lru_cache(maxsize=4)
def paper_split(parameter: Parameter, split: Split) -> TrajectoryDataset:
    """
    The paper's data set, or one side of its 70/30 split by trajectory (seed 0), made once per process.

    :param parameter: what ages
    :param split: ``"train"``, ``"test"`` or ``"all"``
    :return: the trajectories
    :raises ValueError: for another split
    """
    if split == "all":
        return TrajectoryDataset.paper(parameter)
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train', 'test' or 'all', got {split!r}")
    return TrajectoryDataset.paper(parameter).split(test=0.3, by="trajectory", seed=0)[split == "test"]


class FullStateEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """
    What the full-state environments share; see the registered ones.

    :param parameter: what the action is: ``"q_mobile"`` or ``"r_o"``
    :param formulation: observation and cost: ``"scaled"`` or ``"paper"``
    :param episode_steps: decisions per episode; fewer where the data end
    :param initial_perturbation: the model starts in the true state plus a uniform draw within this many error scales to
        either side, in Vo, Vsn, Vsp and in charge that has moved between the electrodes
    :param split: side of the paper's data set that episodes are drawn from; not with ``dataset``
    :param dataset: other trajectories to draw from
    :param render_mode: ``"rgb_array"`` or ``None``
    :raises ValueError: for values out of range
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as in gym.Env)

    def __init__(
        self,
        parameter: Parameter,
        formulation: str,
        episode_steps: int,
        initial_perturbation: float = 0.0,
        split: Split = "train",
        dataset: TrajectoryDataset | None = None,
        render_mode: str | None = None,
    ) -> None:
        if episode_steps < 1:
            raise ValueError(f"episode_steps must be at least 1, got {episode_steps!r}")
        if not 0.0 <= initial_perturbation < np.inf:
            raise ValueError(f"initial_perturbation must be finite and at least 0, got {initial_perturbation!r}")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.dataset = paper_split(parameter, split) if dataset is None else dataset
        self.task = FullStateTask(self.dataset, parameter, formulation, cells=1)
        self.formulation = formulation
        self.episode_steps = episode_steps
        self.initial_perturbation = initial_perturbation
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(
            -OBSERVATION_LIMIT, OBSERVATION_LIMIT, shape=(self.task.observation_size,), dtype=np.float32
        )
        self.action_space = gym.spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        self._steps_left = 0
        self._history: deque[dict[str, float]] = deque(maxlen=episode_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode at a random point of a random trajectory.

        :param seed: seed of this and the following episodes
        :param options: ``trajectory`` and ``sample`` (counted from full charge) choose the point instead
        :return: observation, info
        """
        super().reset(seed=seed)
        chosen = options or {}
        dataset = self.dataset
        n = int(chosen.get("trajectory", self.np_random.integers(len(dataset))))
        if not 0 <= n < len(dataset):
            raise ValueError(f"options['trajectory'] must lie within 0 .. {len(dataset) - 1}, got {n}")
        first, last = int(dataset.first[n]), int(dataset.stop[n]) - 3  # one decision needs the two samples that follow
        t = int(chosen.get("sample", self.np_random.integers(first, last + 1)))
        if not first <= t <= last:
            raise ValueError(f"options['sample'] must lie within {first} .. {last} for trajectory {n}, got {t}")
        bound = self.initial_perturbation
        perturbation = self.np_random.uniform(-bound, bound, size=(1, 4)) if bound > 0.0 else None
        self.task.begin(_ROW, np.array([n]), np.array([t]), perturbation)
        self._steps_left = self.episode_steps
        self._history.clear()
        return self.task.observation()[0], self._info(0.0)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """
        Run the model for one time step with the parameter that the action stands for.

        :param action: shape (1,), in [-1, 1]
        :return: observation, reward (minus the cost), terminated (never), truncated (end of the episode or of the data), info
        """
        cost = float(self.task.advance(action)[0])
        self._steps_left -= 1
        truncated = self._steps_left <= 0 or self.task.transitions_left()[0] <= 0
        info = self._info(cost)
        if self.render_mode is not None:
            self._history.append(info)
        return self.task.observation()[0], -cost, False, bool(truncated), info

    def _info(self, cost: float) -> dict[str, Any]:
        return {"cost": cost, **{name: float(value[0]) for name, value in self.task.report().items()}}

    def render(self) -> NDArray[np.uint8] | None:
        """
        A picture of the episode so far: voltage and parameter, of the cell and of the model.

        :return: shape (height, width, 3), or ``None`` without a render mode
        """
        if self.render_mode is None:
            return None
        from battery_env.calibration.rendering import draw_frame  # matplotlib only for those who look

        return draw_frame(list(self._history), self.task.parameter, self.episode_steps, self.dataset.dt_s)
