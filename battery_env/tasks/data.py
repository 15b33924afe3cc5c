"""The standard data sets of the calibration tasks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, TypeVar, get_args

import numpy as np

from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.loads import Load, LoadSampler, RandomPiecewise, RandomWalk, constant
from battery_env.trajectories import PAPER_LOADS_W, PAPER_RANGES, PAPER_TRIM, TrajectoryDataset, aged_parameters

_Discharges = TypeVar("_Discharges")

LoadKind = Literal["paper", "constant", "piecewise", "random_walk"]
Split = Literal["train", "test", "all"]

#: Discharges in a data set, except the paper's.
DISCHARGES = 1000
#: Seed of ages, loads and of the division into train and test: all data sets of a parameter hold the same cells.
SEED = 0

#: Ages of the cells that discharge under other loads than the paper's, C and ohm.
Q_MOBILE_RANGE_C = (4000.0, 7600.0)
R_O_RANGE_OHM = (0.1, 0.3)
#: Powers of the constant loads, W; the ends are those of the piecewise-constant and the random-walk loads.
CONSTANT_LOADS_W: tuple[float, ...] = tuple(np.linspace(2.0, 8.0, 13))


def standard_dataset(
    parameters: str | Sequence[str],
    load: LoadKind,
    split: Split,
    dt_s: float = 1.0,
    mismatch: float = 0.0,
    cell: CellParameters = NEW_CELL,
    path: AgingPath | None = None,
) -> TrajectoryDataset:
    """
    Return a data set of cells with one aged parameter or two, or one side of its 70/30 split by trajectory, made once per
    process. All discharges are at power, isothermal, and from seed 0.

    =============== ============================================================== ============ ============== ==========
    load            what                                                           q_mobile     r_o            discharges
    =============== ============================================================== ============ ============== ==========
    ``paper``       eleven constant loads, 8 to 16 W                               4000-7000 C  0.1-0.2 ohm    1000, 5511
    ``constant``    thirteen constant loads, 2 to 8 W                              4000-7600 C  0.1-0.3 ohm    1000
    ``piecewise``   2 to 8 W, uniform, changed every 60 to 140 s                   4000-7600 C  0.1-0.3 ohm    1000
    ``random_walk`` 2 to 8 W, changed every 60 s by at most 2 W                    4000-7600 C  0.1-0.3 ohm    1000
    =============== ============================================================== ============ ============== ==========

    ``paper`` is trimmed to 5 .. 95 % of each discharge and, for one parameter of the new cell at 1 s without mismatch, the
    paper's own grid of 5511; the others run from full charge to the end of discharge. A parameter that does not age is that
    of ``cell``. With a ``path`` the cells are drawn along it, with constants that age too.
    """
    if load not in get_args(LoadKind):
        raise ValueError(f"load must be one of {get_args(LoadKind)}, got {load!r}")
    if split not in get_args(Split):
        raise ValueError(f"split must be 'train', 'test' or 'all', got {split!r}")
    return _splits(aged_parameters(parameters), load, dt_s, mismatch, cell, path)[split]


def open_dataset(dataset: _Discharges | str | os.PathLike[str]) -> _Discharges | TrajectoryDataset:
    """Return the discharges of an argument ``dataset``, from a file if it is a path."""
    if isinstance(dataset, (str, os.PathLike)):
        return _loaded(os.fspath(dataset), os.stat(dataset).st_mtime_ns)
    return dataset


@lru_cache(maxsize=6)
def _loaded(path: str, modified_ns: int) -> TrajectoryDataset:
    return TrajectoryDataset.load(path)


@lru_cache(maxsize=6)
def _splits(
    parameters: tuple[str, ...],
    load: LoadKind,
    dt_s: float,
    mismatch: float,
    cell: CellParameters,
    path: AgingPath | None,
) -> dict[Split, TrajectoryDataset]:
    if path is not None:
        cells = TrajectoryDataset.along(path, DISCHARGES, _loads(load), SEED, dt_s)
    elif load == "paper" and len(parameters) == 1 and dt_s == 1.0 and mismatch == 0.0 and cell == NEW_CELL:
        cells = TrajectoryDataset.paper(parameters[0])
    else:
        ranges = PAPER_RANGES if load == "paper" else {"q_mobile": Q_MOBILE_RANGE_C, "r_o": R_O_RANGE_OHM}
        q_C, r_ohm, loads = ranges["q_mobile"], ranges["r_o"], _loads(load)
        cells = TrajectoryDataset.generate(parameters, DISCHARGES, loads, SEED, q_C, r_ohm, dt_s, cell=cell, mismatch=mismatch)
        cells = cells.trimmed(*PAPER_TRIM) if load == "paper" else cells
    train, test = cells.split(seed=SEED)
    return {"train": train, "test": test, "all": cells}


def _loads(load: LoadKind) -> list[Load] | LoadSampler:
    if load == "piecewise":
        return RandomPiecewise()
    if load == "random_walk":
        return RandomWalk()
    return [constant(power) for power in (PAPER_LOADS_W if load == "paper" else CONSTANT_LOADS_W)]
