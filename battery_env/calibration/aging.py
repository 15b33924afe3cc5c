"""Calibration over the life of a cell: cycle after cycle, with wear between them and the estimate carried over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.calibration.readings import Readings
from battery_env.calibration.voltage import VoltageOptions, VoltageTask
from battery_env.electrochemistry import FloatArray
from battery_env.loads import RandomPiecewise
from battery_env.trajectories import TrajectoryDataset


@lru_cache(maxsize=4)
def simulated_lives(lives: int, cycles: int, seed: int) -> TrajectoryDataset:
    """
    Lives of cells, each a discharge a cycle under a piecewise-constant power of 2 to 8 W of its own.

    A life starts with ``q_mobile`` of 6800 to 7600 C and ``r_o`` of 0.10 to 0.14 ohm. Over all its cycles it loses 10 to 40 %
    of the one and gains 20 to 100 % of the other, in steps of exponentially distributed size, so that some cycles wear a
    cell much and most do little.

    :param lives: number of cells
    :param cycles: discharges of each
    :param seed: of ages, wear and loads
    :return: the discharges, life after life, each in the order of its cycles
    """
    rng = np.random.default_rng(seed)

    def worn(start: FloatArray, change: FloatArray) -> FloatArray:
        steps = np.hstack([np.zeros((lives, 1)), rng.exponential(size=(lives, cycles - 1))])
        progress = np.cumsum(steps, axis=1) / np.maximum(steps.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        return np.asarray(start[:, None] * (1.0 + change[:, None] * progress))

    q_mobile = worn(rng.uniform(6800.0, 7600.0, lives), -rng.uniform(0.1, 0.4, lives))
    r_o = worn(rng.uniform(0.10, 0.14, lives), rng.uniform(0.2, 1.0, lives))
    sampler = RandomPiecewise()
    return TrajectoryDataset.simulated(
        q_mobile.ravel(),
        r_o.ravel(),
        [sampler(rng) for _ in range(lives * cycles)],
        np.arange(lives * cycles),
        description={"made_by": "simulated_lives", "lives": lives, "cycles": cycles, "seed": seed},
    )


@dataclass(frozen=True)
class AgingOptions(VoltageOptions):
    """
    What ``BatteryAging-v0`` can be asked for, besides what all voltage-only tasks can.

    :param cycles: cycles of a life; an episode is a life
    :param decisions_per_cycle: decisions in each of them; ``episode_steps`` follows
    :raises ValueError: for values out of range
    """

    episode_steps: int = 0
    new_readings: tuple[int, int] = (10, 60)
    start: str = "new_cell"  # type: ignore[assignment]
    cycles: int = 20
    decisions_per_cycle: int = 8

    def __post_init__(self) -> None:
        for name in ("cycles", "decisions_per_cycle"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        object.__setattr__(self, "episode_steps", self.cycles * self.decisions_per_cycle)
        super().__post_init__()


class AgingTask(VoltageTask):
    """
    Both parameters of cells that wear, through their lives. Each cycle is a discharge from full charge; its data alone count
    in the misfit, so that early in a cycle little is known of ``q_mobile`` but what the last cycle said: the observation
    holds the estimate that was carried over beside the one of now.

    :param readings: discharges, life after life
    :param cells: size of the batch
    :param options: of the task
    """

    def __init__(self, readings: Readings, cells: int, options: AgingOptions) -> None:
        if len(readings) % options.cycles:
            raise ValueError(f"{len(readings)} discharges are no whole number of lives of {options.cycles} cycles")
        self.cycles, self.decisions_per_cycle = options.cycles, options.decisions_per_cycle
        super().__init__(readings, ("q_mobile", "r_o"), cells, options)
        self.observation_size += len(self.parameters)
        self._carried = self.estimate.copy()
        self._generators: list[np.random.Generator] = [np.random.default_rng(0)] * cells

    def start(
        self,
        rows: NDArray[np.intp],
        generators: Sequence[np.random.Generator],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """
        Begin new lives.

        :param rows: which cells of the batch, shape (m,)
        :param generators: one source of randomness for each of them
        :param options: as of :meth:`VoltageTask.start`; ``discharge`` has to be the first one of a life
        :raises ValueError: for an option that is unknown or out of range
        """
        discharge = (options or {}).get("discharge", 0)
        if discharge % self.cycles:
            raise ValueError(f"options['discharge'] must be the first of a life of {self.cycles} cycles, got {discharge}")
        for row, generator in zip(rows, generators, strict=True):
            # later cycles need randomness when the agent gets there; the generator of the cell is not to be drawn from then
            self._generators[row] = np.random.default_rng(generator.integers(2**63))
        super().start(rows, generators, options)
        self._carried[rows] = self.estimate[rows]

    def _draw_discharge(self, generator: np.random.Generator) -> int:
        return self.cycles * int(generator.integers(len(self.readings) // self.cycles))

    def _draw_count(self, discharge: int, generator: np.random.Generator) -> int:
        return min(int(generator.integers(*self.options.new_readings, endpoint=True)), int(self.readings.count[discharge]))

    def _arrive(self) -> None:
        """New readings, or after the last decision of a cycle those of the next one."""
        super()._arrive()
        ended = (self._step_of_episode % self.decisions_per_cycle == 0) & (self._step_of_episode < self.episode_steps)
        for row in np.flatnonzero(ended).tolist():
            discharge, generator = int(self.discharge[row]) + 1, self._generators[row]
            self._carried[row] = self.estimate[row]
            self.place(row, discharge, self._draw_count(discharge, generator), self.estimate[row])
            self._measure(row, discharge, generator)

    def _parts(self) -> list[FloatArray]:
        return [*super()._parts(), self._scaled(self._carried)]
