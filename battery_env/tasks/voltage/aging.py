"""Calibration over the life of a cell: cycle after cycle, with wear between them and the estimate carried over."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from battery_env.electrochemistry import CellParameters, FloatArray
from battery_env.estimators.estimator import Record
from battery_env.loads import RandomPiecewise
from battery_env.tasks.task import check_counts
from battery_env.tasks.voltage.task import VoltageTask
from battery_env.trajectories import TrajectoryDataset

#: Lives to train on and to test on.
LIVES = {"train": 70, "test": 30}


@lru_cache(maxsize=4)
def simulated_lives(lives: int, cycles: int, seed: int, cell: CellParameters | None = None) -> TrajectoryDataset:
    """
    Lives of cells, each a discharge a cycle under a piecewise-constant power of 2 to 8 W of its own.

    A life starts with ``q_mobile`` of 6800 to 7600 C and ``r_o`` of 0.10 to 0.14 ohm. Over all its cycles it loses 10 to 40 %
    of the one and gains 20 to 100 % of the other, in steps of exponentially distributed size, so that some cycles wear a
    cell much and most do little.
    """
    rng = np.random.default_rng(seed)

    def worn(start: FloatArray, change: FloatArray) -> FloatArray:
        steps = np.hstack([np.zeros((lives, 1)), rng.exponential(size=(lives, cycles - 1))])
        progress = np.cumsum(steps, axis=1) / np.maximum(steps.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        return np.asarray(start[:, None] * (1.0 + change[:, None] * progress))

    q_mobile = worn(rng.uniform(6800.0, 7600.0, lives), -rng.uniform(0.1, 0.4, lives))
    r_o = worn(rng.uniform(0.10, 0.14, lives), rng.uniform(0.2, 1.0, lives))
    sampler = RandomPiecewise()
    loads = [sampler(rng) for _ in range(lives * cycles)]
    made = TrajectoryDataset.simulated(q_mobile.ravel(), r_o.ravel(), loads, np.arange(lives * cycles), cell=cell)
    return replace(made, description={"made_by": "simulated_lives", "lives": lives, "cycles": cycles, "seed": seed})


class BatteryAging(VoltageTask):
    """
    ## Description

    The life of a Li-ion cell: 20 cycles, each a discharge from full charge as in ``BatteryVoltageJoint-v0``, with wear
    between them (``battery_env.tasks.voltage.aging.simulated_lives``: q_max falls by 10 to 40 % and R_o rises by 20 to 100 %
    over a life, in uneven steps). The estimate is carried over from cycle to cycle. Only the readings of the present cycle
    count in observation and cost, so that early in a discharge, when the data say nothing of q_max, the estimate of the last
    cycle is the best there is.

    ## Observation space

    ``Box(-100, 100, (104,), float32)``: that of ``BatteryVoltageJoint-v0``, and at 102-103 the estimate that was carried over
    into this cycle, scaled as at 100-101.

    ## Action space

    That of ``BatteryVoltageJoint-v0``.

    ## Reward

    That of ``BatteryVoltageJoint-v0``.

    ## Starting state

    The first cycle of one of 70 lives, 10 to 60 readings after its start, with the estimate of a new cell. The sensor's noise
    and offset are drawn anew for each cycle.

    ## Episode end

    Truncated after the last decision of the last cycle: 8 decisions in each of 20 cycles, of which the last knows some two
    thirds of the readings. Never terminated.

    ## Arguments

    ``cycles`` (20), ``decisions_per_cycle`` (8), ``split`` (``"train"``; or ``"test"``: 30 other lives), ``dataset``
    (discharges, life after life, each with ``cycles`` of them), and those of ``BatteryVoltageJoint-v0`` but for
    ``episode_steps``, ``load``, ``dt_s``, ``mismatch``, ``nuisance`` and ``path``; ``new_readings`` is (10, 60) and ``start``
    ``"new_cell"`` here. ``reset(options={"discharge": n})`` takes the first discharge of a life.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile", "r_o")

    def __init__(
        self,
        cells: int,
        *,
        cycles: int = 20,
        decisions_per_cycle: int = 8,
        split: Literal["train", "test"] = "train",
        new_readings: tuple[int, int] = (10, 60),
        start: Literal["random", "new_cell", "true"] = "new_cell",
        cell: CellParameters | None = None,
        dataset: Sequence[Record] | str | os.PathLike[str] | None = None,
        **others: Any,
    ) -> None:
        check_counts(cycles=cycles, decisions_per_cycle=decisions_per_cycle)
        if split not in LIVES:
            raise ValueError(f"split must be one of {tuple(LIVES)}, got {split!r}")
        if dataset is None:
            dataset = simulated_lives(LIVES[split], cycles, seed=list(LIVES).index(split), cell=cell)
        else:
            self._refuse_beside_a_dataset(split=split)
        super().__init__(
            cells,
            cycles,
            episode_steps=decisions_per_cycle,
            new_readings=new_readings,
            start=start,
            cell=cell,
            dataset=dataset,
            **others,
        )

    @classmethod
    def options(cls) -> dict[str, Any]:
        """Its own options, and those of the voltage-only tasks that choose no standard discharges."""
        decided = ("episode_steps", "load", "dt_s", "mismatch", "nuisance", "path")
        inherited = {name: default for name, default in VoltageTask.options().items() if name not in decided}
        return {**inherited, **super(VoltageTask, cls).options()}
