"""A calibration task as a Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from battery_env.arrays import BoolArray, FloatArray
from battery_env.checks import check_whole_number
from battery_env.tasks.base import CalibrationTask
from battery_env.tasks.env import CalibrationEnv, new_task, spaces_of


class CalibrationVectorEnv(gym.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """
    A calibration task for many cells, each in its own episode.

    With the same seeds it makes the episodes of as many scalar environments, to the bit. As in Gymnasium, seed s gives cell n
    the seed s + n, and ``info`` holds arrays of shape (num_envs,), with the cells that they are valid for under ``_name``.

    :param task: the class of the task, or its path, as ``"module:name"``
    :param num_envs: number of cells
    :param autoreset_mode: when a cell restarts after its episode: ``NEXT_STEP``: by the following step, which ignores the
        action of the cell; ``SAME_STEP``: at once, with ``final_obs`` and ``final_info`` in ``info``. The mode or its value, a
        string
    :param options: of the task
    :raises TypeError: for an option that the task does not have
    :raises ValueError: for values out of range
    """

    metadata: dict[str, Any] = {"discount": CalibrationEnv.metadata["discount"]}  # noqa: RUF012 (as in gym.vector.VectorEnv)

    def __init__(
        self,
        task: str | type[CalibrationTask],
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        self.num_envs = check_whole_number("num_envs", num_envs, 1)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be 'NextStep' or 'SameStep', got 'Disabled'")
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.task = new_task(task, num_envs, options)
        self.single_observation_space, self.single_action_space = spaces_of(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._needs_reset: BoolArray = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """
        Start an episode in every cell.

        :param seed: seed of this and the following episodes: one a cell, or a number s, which gives cell n the seed s + n
        :param options: choices that replace random draws; the page of the environment names them
        :return: observations, info
        :raises ValueError: for a wrong number of seeds
        """
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds: list[int | None] = [None if seed is None else int(seed) + n for n in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be one number, or one for each of the {self.num_envs} cells, got {len(seeds)}")
        generators: list[np.random.Generator | None] = [*self._generators] or [None] * self.num_envs
        self._generators = [
            seeding.np_random(value)[0] if generator is None or value is not None else generator
            for generator, value in zip(generators, seeds, strict=True)
        ]
        self._needs_reset = np.zeros(self.num_envs, dtype=np.bool_)
        self._start(~self._needs_reset, options)
        return self.task.observation(), self._info(np.zeros(self.num_envs))

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """
        Take one decision in every cell.

        :param actions: shape (num_envs, number of parameters), in [-1, 1]
        :return: observations, rewards (minus the cost), terminated (never), truncated (end of an episode or of its data), info
        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if not self._generators:
            raise gym.error.ResetNeeded("call reset() before step()")
        cost = self.task.advance(actions)
        reward, truncated, final = -cost, self.task.truncated(), {}
        reset_mask = None
        if self._needs_reset.any():
            reset_mask = self._needs_reset
            self._start(reset_mask)
            reward[reset_mask], truncated[reset_mask] = 0.0, False
        elif self.autoreset_mode is AutoresetMode.SAME_STEP and truncated.any():
            reset_mask = truncated
            final = self._final(reset_mask, cost)
            self._start(reset_mask)
        if reset_mask is not None:
            cost[reset_mask] = 0.0
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._needs_reset = truncated.copy()
        info = {**final, **self._info(cost)}
        return self.task.observation(), reward, np.zeros(self.num_envs, dtype=np.bool_), truncated, info

    def _start(self, mask: BoolArray, options: Mapping[str, Any] | None = None) -> None:
        rows = np.flatnonzero(mask)
        self.task.start(rows, [self._generators[n] for n in rows.tolist()], options)

    def _info(self, cost: FloatArray, mask: BoolArray | None = None) -> dict[str, Any]:
        info: dict[str, Any] = {"cost": cost, **self.task.report()}
        valid = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask
        info.update({f"_{name}": valid.copy() for name in tuple(info)})
        return info

    def _final(self, mask: BoolArray, cost: FloatArray) -> dict[str, Any]:
        observation, observations = self.task.observation(), np.full(self.num_envs, None, dtype=object)
        for n in np.flatnonzero(mask).tolist():
            observations[n] = observation[n]
        final = self._info(cost.copy(), mask)
        return {"final_obs": observations, "_final_obs": mask.copy(), "final_info": final, "_final_info": mask.copy()}
