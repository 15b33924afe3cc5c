"""Simulated discharges of cells of many ages under many loads: generate, split, save, load."""

from __future__ import annotations

import hashlib
import json
import operator
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import version
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from battery_env.electrochemistry import (
    NEW_CELL,
    STATE_NAMES,
    STATE_SIZE,
    UNCERTAIN_CONSTANTS,
    CellParameters,
    FloatArray,
    LoadUnit,
    Trajectory,
    advance_in_place,
    check_dt,
    check_load,
    check_q_mobile,
    check_r_o,
    initial_state,
)
from battery_env.files import replacing
from battery_env.kernels import PackedConstants, roll_out
from battery_env.loads import Load, LoadSampler, checked_range, constant

IntArray = NDArray[np.int64]
AgedParameter = Literal["q_mobile", "r_o", "joint"]

#: Ranges of the aged parameters in the paper's data (the authors' code), C and ohm.
PAPER_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (4000.0, 7000.0), "r_o": (0.1, 0.2)}
PAPER_LOADS_W: tuple[float, ...] = tuple(np.linspace(8.0, 16.0, 11))
PAPER_VALUES = 501
PAPER_TRIM = (0.05, 0.95)

#: Largest ``mismatch`` of :meth:`TrajectoryDataset.generate`: beyond, the constants would be another cell's.
MISMATCH_LIMIT = 0.5

FORMAT_VERSION = 2
_CHECKPOINT_EVERY = 64  # steps between stored states: a window starts with 32 steps of re-simulation on average
_MIN_SAMPLES = 8
_LEAST_DT_S = 0.01  # of a discharge that may take a day
_INDICES = ("load_start", "samples", "first", "stop", "checkpoint_start")
_PER_TRAJECTORY = ("q_mobile", "r_o", "factors", "eod_time_s", *_INDICES)
_ARRAYS = (*_PER_TRAJECTORY, "load_values", "checkpoint")
_SETTINGS = ("load_unit", "dt_s", "thermal", "description")
_ROWS_PER_GROUP = 1_000_000  # of a Parquet file: a reader that wants some columns holds this many rows at a time


@dataclass(frozen=True, eq=False)
class TrajectoryDataset(Sequence[Trajectory]):
    """
    Simulated discharges, kept as their parameters, loads and a state every 64 steps; everything between is simulated
    again when it is asked for, to the same bits, which costs less than reading it from memory would gain.

    Made by :meth:`generate`, :meth:`paper`, :meth:`simulated` or :meth:`load`. ``dataset[i]`` is a
    :class:`~battery_env.electrochemistry.Trajectory`.

    :param q_mobile: C, shape (n,)
    :param r_o: ohm, shape (n,)
    :param factors: what ``UNCERTAIN_CONSTANTS`` (kn, tDiffusion, to, tsn) of each true cell are multiplied by, shape (n, 4);
        ones where the constants in ``parameters`` are exact
    :param eod_time_s: end of discharge, s after the first sample of the whole discharge, shape (n,); NaN where unknown
    :param load_values: all load profiles end to end, one value a step
    :param load_start: where in ``load_values`` each trajectory's profile starts, shape (n,); trajectories may share a profile
    :param samples: length of the whole discharge, shape (n,)
    :param first: first sample that counts as data, shape (n,)
    :param stop: one past the last sample that does, shape (n,)
    :param checkpoint: states after 0, 64, 128, ... steps, all trajectories end to end, shape (m, 8)
    :param checkpoint_start: where in ``checkpoint`` each trajectory starts, shape (n,)
    :param load_unit: ``"power"`` or ``"current"``
    :param dt_s: time step, s
    :param thermal: whether the temperature moves
    :param parameters: constants of the cell, as a calibrator may know them
    :param description: how the data set was made, as JSON may hold it; saved with it
    :raises ValueError: for arrays that do not fit together, or values out of range
    """

    q_mobile: FloatArray
    r_o: FloatArray
    factors: FloatArray
    eod_time_s: FloatArray
    load_values: FloatArray
    load_start: IntArray
    samples: IntArray
    first: IntArray
    stop: IntArray
    checkpoint: FloatArray
    checkpoint_start: IntArray
    load_unit: LoadUnit
    dt_s: float
    thermal: bool
    parameters: CellParameters
    description: dict[str, Any]

    def __post_init__(self) -> None:
        n = np.size(self.q_mobile)
        shapes = dict.fromkeys(_PER_TRAJECTORY, (n,)) | {
            "factors": (n, len(UNCERTAIN_CONSTANTS)),
            "load_values": (np.size(self.load_values),),
            "checkpoint": (np.size(self.checkpoint) // STATE_SIZE, STATE_SIZE),
        }
        for name, shape in shapes.items():
            array, dtype = getattr(self, name), np.int64 if name in _INDICES else np.float64
            if not isinstance(array, np.ndarray) or array.dtype != dtype or array.shape != shape or n == 0:
                found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                raise ValueError(f"{name} must be an array of {dtype.__name__} of shape {shape}, not empty, got {found}")
        check_q_mobile(self.q_mobile)
        check_r_o(self.r_o)
        check_load(self.load_values, self.load_unit)
        _check_factors(self.factors)
        _check_cell(self.parameters, self.thermal)
        _check_dt(self.dt_s, self.parameters, self.factors)
        if not np.isfinite(self.checkpoint).all():
            raise ValueError("checkpoint must be finite, got NaN or infinity")
        fits = {
            "first and stop": (self.first >= 0) & (self.first < self.stop) & (self.stop <= self.samples),
            "load_start": (self.load_start >= 0) & (self.load_start + self.samples <= len(self.load_values)),
            "checkpoint_start": (self.checkpoint_start >= 0)
            & (self.checkpoint_start + _checkpoints(self.samples) <= len(self.checkpoint)),
        }
        for name, each in fits.items():
            if not each.all():
                raise ValueError(f"{name} of trajectory {np.flatnonzero(~each)[0]} lie outside its data")

    @classmethod
    def simulated(
        cls,
        q_mobile: ArrayLike,
        r_o: ArrayLike,
        loads: Sequence[Load],
        load_index: ArrayLike,
        trim: tuple[float, float] = (0.0, 1.0),
        dt_s: float = 1.0,
        thermal: bool = False,
        parameters: CellParameters = NEW_CELL,
        description: dict[str, Any] | None = None,
        factors: ArrayLike | None = None,
    ) -> TrajectoryDataset:
        """
        Discharge cells from full charge to the end of discharge.

        :param q_mobile: C, shape (n,)
        :param r_o: ohm, shape (n,)
        :param loads: the loads that occur, all in one unit
        :param load_index: which of them each cell gets, shape (n,)
        :param trim: the part of each discharge that counts as data, as shares of its length
        :param dt_s: time step, s
        :param thermal: whether the temperature moves
        :param parameters: constants of the cell, as a calibrator may know them
        :param description: how the data set was made, as JSON may hold it
        :param factors: what ``UNCERTAIN_CONSTANTS`` of each cell are multiplied by, shape (n, 4); ``None``: ones
        :return: the data set
        :raises ValueError: for values out of range, or a discharge of fewer than eight samples
        """
        q, r = np.broadcast_arrays(*np.atleast_1d(check_q_mobile(q_mobile), check_r_o(r_o)))
        if q.ndim != 1 or q.size == 0:
            raise ValueError(f"q_mobile and r_o must be 1-D and not empty, got shape {q.shape}")
        low, high = checked_range("trim", trim)
        if not 0.0 <= low < high <= 1.0:
            raise ValueError(f"trim must be two increasing shares within 0 .. 1, got {trim!r}")
        units = {load.unit if isinstance(load, Load) else type(load).__name__ for load in loads}
        if units not in ({"power"}, {"current"}):
            raise ValueError(f"loads must be Loads, all in one unit (power or current), got {sorted(units)}")
        unit = loads[0].unit
        index = np.broadcast_to(_indices("load_index", load_index, len(loads)), q.shape)
        multiples = np.ones((q.size, len(UNCERTAIN_CONSTANTS))) if factors is None else np.array(factors, dtype=np.float64)
        if multiples.shape != (q.size, len(UNCERTAIN_CONSTANTS)):
            raise ValueError(f"factors must hold one value per cell and each of {UNCERTAIN_CONSTANTS}, got {multiples.shape}")
        _check_factors(multiples)
        _check_cell(parameters, thermal)
        dt_s = _check_dt(dt_s, parameters, multiples)
        if dt_s < _LEAST_DT_S:
            raise ValueError(f"dt_s must be at least {_LEAST_DT_S:g} s (a day of it must fit in memory), got {dt_s!r}")

        day = dt_s * np.arange(round(86_400 / dt_s), dtype=np.float64)
        start = initial_state(q, parameters)
        samples = np.empty(q.size, dtype=np.int64)
        profiles = []
        checkpoints: dict[int, FloatArray] = {}
        # one place to simulate in, for all cells in turn
        state, voltage, current = np.empty((len(day) + 1, STATE_SIZE)), np.empty(len(day)), np.empty(len(day))
        for k, load in enumerate(loads):
            profile = load.on_grid(day)
            cells = np.flatnonzero(index == k)
            for n in cells:
                state[0] = start[n]
                packed = _packed(parameters, multiples[[n]])
                run = (profile, q[n], r[n], dt_s, parameters.VEOD, unit == "power", thermal)
                samples[n] = roll_out(*run, *packed, state, voltage, current)
                if samples[n] < _MIN_SAMPLES:
                    raise ValueError(
                        f"trajectory {n} (q_mobile {q[n]:g} C, r_o {r[n]:g} ohm) ends after {samples[n]} samples, at least "
                        f"{_MIN_SAMPLES} are needed: lower its load ({load.value[0]:g}), r_o or dt_s ({dt_s:g})"
                    )
                if samples[n] == len(day):
                    raise ValueError(f"trajectory {n} does not reach the end of discharge within a day: raise its load")
                checkpoints[int(n)] = state[: samples[n] : _CHECKPOINT_EVERY].copy()
            profiles.append(profile[: samples[cells].max(initial=0)].copy())
        # short discharges keep four samples, whatever is trimmed
        first = np.minimum(np.ceil(low * samples).astype(np.int64), samples - _MIN_SAMPLES // 2)
        return cls(
            q_mobile=np.array(q),
            r_o=np.array(r),
            factors=multiples,
            eod_time_s=np.asarray(samples * dt_s, dtype=np.float64),
            load_values=np.concatenate(profiles),
            load_start=_starts(np.array([len(profile) for profile in profiles]))[index],
            samples=samples,
            first=first,
            stop=np.maximum(np.floor(high * samples).astype(np.int64), first + _MIN_SAMPLES // 2),
            checkpoint=np.concatenate([checkpoints[n] for n in range(q.size)]),
            checkpoint_start=_starts(_checkpoints(samples)),
            load_unit=unit,
            dt_s=dt_s,
            thermal=thermal,
            parameters=parameters,
            description=description or {},
        )

    @classmethod
    def generate(
        cls,
        parameter: AgedParameter,
        n: int,
        loads: Sequence[Load] | LoadSampler,
        seed: int,
        q_mobile_range: tuple[float, float] = (4000.0, 7600.0),
        r_o_range: tuple[float, float] = (0.1, 0.2),
        trim: tuple[float, float] = (0.0, 1.0),
        dt_s: float = 1.0,
        thermal: bool = False,
        parameters: CellParameters = NEW_CELL,
        mismatch: float = 0.0,
    ) -> TrajectoryDataset:
        """
        Discharges of ``n`` cells whose age is drawn uniformly; the parameter that does not age is the new cell's.

        :param parameter: what ages: ``"q_mobile"``, ``"r_o"`` or ``"joint"`` (both, independently)
        :param n: number of discharges
        :param loads: loads to choose from at random, or a sampler of loads
        :param seed: seed of ages and loads
        :param q_mobile_range: C
        :param r_o_range: ohm
        :param trim: the part of each discharge that counts as data, as shares of its length
        :param dt_s: time step, s
        :param thermal: whether the temperature moves
        :param parameters: constants of the cell, as a calibrator may know them
        :param mismatch: how wrong they are: relative standard deviation of the factors, log-normal with median 1, that each
            of ``UNCERTAIN_CONSTANTS`` of each cell is multiplied by, at most 0.5. Ages and loads do not depend on it
        :return: the data set
        :raises ValueError: for values out of range
        """
        if parameter not in ("q_mobile", "r_o", "joint"):
            raise ValueError(f"parameter must be 'q_mobile', 'r_o' or 'joint', got {parameter!r}")
        n, seed = _whole_number("n", n), _whole_number("seed", seed)
        if n < 1 or seed < 0:
            raise ValueError(f"n must be at least 1 and seed at least 0, got n = {n} and seed = {seed}")
        if not isinstance(mismatch, Real) or not 0.0 <= mismatch <= MISMATCH_LIMIT:
            raise ValueError(f"mismatch is a relative standard deviation within 0 .. {MISMATCH_LIMIT:g}, got {mismatch!r}")
        if isinstance(loads, Load) or not (callable(loads) or isinstance(loads, Sequence)):
            raise TypeError(f"loads must be a list of Loads or a sampler of them, got {type(loads).__name__}")
        if not callable(loads) and len(loads) == 0:
            raise ValueError("loads must not be empty")
        low, high = checked_range("trim", trim)
        q_range, r_range = checked_range("q_mobile_range", q_mobile_range), checked_range("r_o_range", r_o_range)
        check_q_mobile(q_range)
        check_r_o(r_range)
        _check_cell(parameters, thermal)
        rng = np.random.default_rng(seed)
        q = np.full(n, parameters.q_mobile) if parameter == "r_o" else rng.uniform(*q_range, size=n)
        r = np.full(n, parameters.r_o) if parameter == "q_mobile" else rng.uniform(*r_range, size=n)
        if callable(loads):
            drawn, index = [loads(rng) for _ in range(n)], np.arange(n)
        else:
            drawn, index = list(loads), rng.integers(len(loads), size=n)
        # drawn last, so that all else is the same with and without a mismatch
        factors = np.exp(np.sqrt(np.log1p(mismatch**2)) * rng.standard_normal((n, len(UNCERTAIN_CONSTANTS))))
        asked = {"parameter": parameter, "n": n, "seed": seed, "trim": [low, high], "mismatch": float(mismatch)}
        return cls.simulated(q, r, drawn, index, trim, dt_s, thermal, parameters, {"made_by": "generate", **asked}, factors)

    @classmethod
    def from_trajectories(cls, trajectories: Sequence[Trajectory]) -> TrajectoryDataset:
        """
        A data set of trajectories made one by one with :func:`~battery_env.electrochemistry.simulate`, isothermal, with a new
        cell's constants.

        :param trajectories: simulated discharges or parts of them, in one unit of load and one time step
        :return: the data set; its clock starts with each trajectory
        :raises ValueError: if there are none, their units or time steps differ, or they were simulated in another way
        """
        if isinstance(trajectories, Trajectory):
            raise TypeError("trajectories must be a list of them, got one Trajectory")
        for trajectory in trajectories:
            if not isinstance(trajectory, Trajectory):
                raise TypeError(f"trajectories must hold Trajectory, got {type(trajectory).__name__}")
            if len(trajectory.time_s) == 0:
                raise ValueError("trajectories must hold at least one sample each, got an empty one")
        units = {trajectory.load_unit for trajectory in trajectories}
        steps = {round(float(dt), 9) for trajectory in trajectories for dt in np.diff(trajectory.time_s[:2])}
        if len(units) != 1 or len(steps) != 1:
            raise ValueError(f"trajectories must share one load unit and one time step, got units {units} and steps {steps} s")
        samples = np.array([len(trajectory.time_s) for trajectory in trajectories], dtype=np.int64)
        checkpoints = [trajectory.state[::_CHECKPOINT_EVERY] for trajectory in trajectories]
        dataset = cls(
            q_mobile=np.array([trajectory.q_mobile for trajectory in trajectories]),
            r_o=np.array([trajectory.r_o for trajectory in trajectories]),
            factors=np.ones((len(trajectories), len(UNCERTAIN_CONSTANTS))),
            eod_time_s=np.array([trajectory.eod_time_s - trajectory.time_s[0] for trajectory in trajectories]),
            load_values=np.concatenate([trajectory.load for trajectory in trajectories]),
            load_start=_starts(samples),
            samples=samples,
            first=np.zeros_like(samples),
            stop=samples,
            checkpoint=np.concatenate(checkpoints),
            checkpoint_start=_starts(_checkpoints(samples)),
            load_unit=units.pop(),
            dt_s=steps.pop(),
            thermal=False,
            parameters=NEW_CELL,
            description={"made_by": "from_trajectories"},
        )
        for n, trajectory in enumerate(trajectories):
            if not np.allclose(dataset[n].state[-1], trajectory.state[-1], rtol=1e-6):
                raise ValueError(
                    f"trajectory {n} is not an isothermal simulation with a new cell's constants; make data sets of others "
                    "with TrajectoryDataset.simulated"
                )
        return dataset

    @classmethod
    def paper(cls, parameter: Literal["q_mobile", "r_o"]) -> TrajectoryDataset:
        """
        The data of Unagar et al. 2020 (their code): eleven constant loads of 8 to 16 W times 501 values of the parameter
        (q_mobile 4000 to 7000 C, or r_o 0.1 to 0.2 ohm), from full charge to 3 V, trimmed to 5 .. 95 %. Made once per
        process, in seconds.

        :param parameter: what ages
        :return: the data set of 5511 trajectories
        """
        if parameter not in PAPER_RANGES:
            raise ValueError(f"parameter must be 'q_mobile' or 'r_o', got {parameter!r}")
        return _paper(parameter)

    def __len__(self) -> int:
        return len(self.q_mobile)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...

    @overload
    def __getitem__(self, index: slice) -> TrajectoryDataset: ...

    def __getitem__(self, index: int | slice) -> Trajectory | TrajectoryDataset:
        if isinstance(index, slice):
            return self.subset(np.arange(len(self))[index])
        n = range(len(self))[index]
        samples = self.samples[n]
        load = self.load_values[self.load_start[n] : self.load_start[n] + samples]
        state, voltage, current = np.empty((samples + 1, STATE_SIZE)), np.empty(samples), np.empty(samples)
        state[0] = self.checkpoint[self.checkpoint_start[n]]
        # no cut-off: a data set of recorded trajectories may hold samples below it
        run = (load, self.q_mobile[n], self.r_o[n], self.dt_s, -np.inf, self.load_unit == "power", self.thermal)
        if roll_out(*run, *self.packed(np.array([n])), state, voltage, current) < samples:
            raise ValueError(f"trajectory {n} cannot be simulated again: it was made with another load or other constants")
        return Trajectory(
            time_s=self.dt_s * np.arange(samples, dtype=np.float64),
            state=state[:samples],
            voltage_V=voltage,
            current_A=current,
            load=load.copy(),
            load_unit=self.load_unit,
            q_mobile=float(self.q_mobile[n]),
            r_o=float(self.r_o[n]),
            eod_time_s=float(self.eod_time_s[n]),
        ).part(self.first[n], self.stop[n])

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[n] for n in range(len(self)))

    def packed(self, index: IntArray) -> PackedConstants:
        """
        The true constants of some trajectories, for the unchecked functions of :mod:`battery_env.electrochemistry`.

        :param index: which trajectories, shape (m,)
        :return: one row a cell; or the one row that all share, if their constants are those of ``parameters``
        """
        return _packed(self.parameters, self.factors[index])

    def states_at(self, index: IntArray, sample: IntArray) -> FloatArray:
        """
        True states of some trajectories at some samples.

        :param index: which trajectories, shape (m,)
        :param sample: which of their samples, counted from full charge, shape (m,)
        :return: shape (m, 8)
        """
        block, steps = np.divmod(sample, _CHECKPOINT_EVERY)
        state = self.checkpoint[self.checkpoint_start[index] + block]
        advance_in_place(
            state,
            self.load_values,
            self.load_start[index] + block * _CHECKPOINT_EVERY,
            steps,
            self.q_mobile[index],
            self.r_o[index],
            self.dt_s,
            self.load_unit,
            self.thermal,
            self.packed(index),
        )
        return state

    def subset(self, index: ArrayLike) -> TrajectoryDataset:
        """
        Some of the trajectories.

        :param index: which, shape (m,), in the order wanted
        :return: a data set of them; the loads are shared with this one
        """
        chosen = _indices("index", index, len(self))
        if chosen.ndim != 1 or chosen.size == 0:
            raise ValueError(f"index must be 1-D and not empty, got shape {chosen.shape}")
        counts = _checkpoints(self.samples[chosen])
        starts = _starts(counts)
        rows = np.arange(counts.sum()) + np.repeat(self.checkpoint_start[chosen] - starts, counts)
        changes = {name: getattr(self, name)[chosen] for name in _PER_TRAJECTORY}
        changes.update(checkpoint=self.checkpoint[rows], checkpoint_start=starts)
        return TrajectoryDataset(**{**self.__dict__, **changes})

    def split(
        self, test: float = 0.3, by: Literal["trajectory", "load", "parameter"] = "trajectory", seed: int = 0
    ) -> tuple[TrajectoryDataset, TrajectoryDataset]:
        """
        Divide into trajectories to train on and trajectories to test on.

        :param test: share of the test part, greater than 0 and less than 1
        :param by: ``"trajectory"``: at random; ``"load"``: whole load profiles at random, so that the test loads are new;
            ``"parameter"``: the most aged cells (lowest q_mobile, or highest r_o where q_mobile is the same) are the test
            part, so that it is an extrapolation
        :param seed: seed of the random divisions
        :return: training part, test part
        :raises ValueError: if one of the parts would be empty
        """
        if not isinstance(test, Real) or not 0.0 < test < 1.0:
            raise ValueError(f"test must be greater than 0 and less than 1, got {test!r}")
        rng = np.random.default_rng(_whole_number("seed", seed))
        if by == "trajectory":
            order = rng.permutation(len(self))
            is_test = np.zeros(len(self), dtype=bool)
            is_test[order[: round(test * len(self))]] = True
        elif by == "load":
            profiles = np.unique(self.load_start)
            is_test = np.isin(self.load_start, rng.permutation(profiles)[: max(1, round(test * len(profiles)))])
        elif by == "parameter":
            order = np.lexsort((self.r_o, -self.q_mobile))
            is_test = np.zeros(len(self), dtype=bool)
            is_test[order[len(self) - round(test * len(self)) :]] = True
        else:
            raise ValueError(f"by must be 'trajectory', 'load' or 'parameter', got {by!r}")
        if is_test.all() or not is_test.any():
            raise ValueError(f"a split of {len(self)} trajectories by {by} with test = {test} leaves one part empty")
        return self.subset(np.flatnonzero(~is_test)), self.subset(np.flatnonzero(is_test))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Save as an npz file (no pickle) that holds the arrays and, as JSON, constants, description, versions and a checksum.
        The file is written beside its place and renamed, so that it is never there in part.

        :param path: where to; ``.npz`` is added if it is missing
        :return: the file
        :raises FileExistsError: if the file exists already
        """
        target = _new_file(path, ".npz")
        arrays, metadata = self._arrays(), self._metadata()
        checksum = np.array(_checksum(metadata, arrays))
        with replacing(target) as part:
            np.savez_compressed(part, allow_pickle=False, metadata=np.array(metadata), checksum=checksum, **arrays)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TrajectoryDataset:
        """
        Read what :meth:`save` wrote.

        :param path: the npz file
        :return: the data set
        :raises ValueError: if the file is damaged, no such data set, or of another format version
        """
        with Path(path).open("rb") as stream:
            try:
                with np.load(stream, allow_pickle=False) as file:
                    text, found, arrays, checksum = _read(file)
            except Exception as error:  # numpy and zipfile raise whatever the damage leads them to
                raise ValueError(f"{path} is damaged, or no data set saved by TrajectoryDataset.save: {error}") from error
        if found != FORMAT_VERSION:
            raise ValueError(f"{path} has format {found}, this version reads {FORMAT_VERSION}: generate it again")
        if _checksum(text, arrays) != checksum:
            raise ValueError(f"{path} is damaged: its contents do not match their checksum")
        try:
            metadata = json.loads(text)
            constants: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in metadata["parameters"].items()}
            settings: dict[str, Any] = {name: metadata[name] for name in _SETTINGS}
            return cls(**arrays, **settings, parameters=CellParameters(**constants))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no valid data set: {error}") from error

    def to_frame(self) -> pd.DataFrame:
        """
        All samples as one table: ``trajectory`` (its number), ``time_s``, ``voltage_V``, ``current_A``, ``load`` (W or A),
        the states under their names (K, V, C), and the true ``q_mobile`` (C) and ``r_o`` (ohm). Every trajectory is
        simulated for it; the paper's 5511 are 7 million rows (0.9 GB).

        :return: one row per sample, in the order of trajectories and time
        """
        return self._frame(0, len(self))

    def _frame(self, start: int, stop: int) -> pd.DataFrame:
        trajectories = [self[n] for n in range(start, stop)]
        lengths = self.stop[start:stop] - self.first[start:stop]
        columns = {"trajectory": np.repeat(np.arange(start, stop), lengths)}
        for name in ("time_s", "voltage_V", "current_A", "load"):
            columns[name] = np.concatenate([getattr(trajectory, name) for trajectory in trajectories])
        state = np.concatenate([trajectory.state for trajectory in trajectories])
        columns |= dict(zip(STATE_NAMES, state.T, strict=True))
        columns |= {name: np.repeat(getattr(self, name)[start:stop], lengths) for name in ("q_mobile", "r_o")}
        return pd.DataFrame(columns)

    def summary(self) -> pd.DataFrame:
        """
        The trajectories as one table: ``trajectory`` (its number), the true ``q_mobile`` (C), ``r_o`` (ohm) and, as
        ``kn_factor`` etc., what the uncertain constants are multiplied by; ``samples`` and ``start_time_s`` of its data;
        ``load_mean``, ``load_lowest`` and ``load_highest`` over its data (W or A); ``eod_time_s``.

        :return: one row per trajectory
        """
        begin, end = self.load_start + self.first, self.load_start + self.stop
        loads = [self.load_values[a:b] for a, b in zip(begin, end, strict=True)]
        return pd.DataFrame(
            {
                "trajectory": np.arange(len(self)),
                "q_mobile": self.q_mobile,
                "r_o": self.r_o,
                **{f"{name}_factor": self.factors[:, k] for k, name in enumerate(UNCERTAIN_CONSTANTS)},
                "samples": self.stop - self.first,
                "start_time_s": self.first * self.dt_s,
                "load_mean": [load.mean() for load in loads],
                "load_lowest": [load.min() for load in loads],
                "load_highest": [load.max() for load in loads],
                "eod_time_s": self.eod_time_s,
            }
        )

    def to_parquet(self, path: str | os.PathLike[str]) -> Path:
        """
        Write :meth:`to_frame` to a Parquet file, for programs other than this one; :meth:`save` is far smaller. Its schema
        holds, as JSON under ``battery_env``, constants, description, versions and the checksum of the data set.

        :param path: where to; ``.parquet`` is added if it is missing
        :return: the file
        :raises FileExistsError: if the file exists already
        :raises ImportError: without the extra ``parquet``
        """
        try:
            pyarrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
        except ImportError as error:
            raise ImportError("to_parquet needs pyarrow: pip install 'battery_env[parquet]'") from error
        target = _new_file(path, ".parquet")
        text = self._metadata()
        metadata = {"battery_env": json.dumps({**json.loads(text), "checksum": _checksum(text, self._arrays())})}
        rows = np.cumsum(self.stop - self.first)
        group = (rows - 1) // _ROWS_PER_GROUP
        starts = [0, *(np.flatnonzero(np.diff(group)) + 1), len(self)]
        schema = pyarrow.Schema.from_pandas(self._frame(0, 1), preserve_index=False).with_metadata(metadata)
        with replacing(target) as part, parquet.ParquetWriter(part, schema) as writer:
            for start, stop in pairwise(starts):
                frame = self._frame(int(start), int(stop))
                writer.write_table(pyarrow.Table.from_pandas(frame, schema=schema, preserve_index=False))
        return target

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {name: getattr(self, name) for name in _ARRAYS}

    def _metadata(self) -> str:
        versions = {"python": platform.python_version(), "numpy": np.__version__, "numba": version("numba")}
        settings = {name: getattr(self, name) for name in _SETTINGS}
        return json.dumps({"format": FORMAT_VERSION, **settings, "parameters": asdict(self.parameters), "versions": versions})


def _new_file(path: str | os.PathLike[str], suffix: str) -> Path:
    target = Path(path)
    target = target if target.suffix == suffix else target.with_name(target.name + suffix)
    if target.exists():
        raise FileExistsError(f"{target} exists already; delete it or choose another name")
    return target


def _checkpoints(samples: IntArray) -> IntArray:
    return (samples - 1) // _CHECKPOINT_EVERY + 1


def _read(file: Mapping[str, NDArray[Any]]) -> tuple[str, int, dict[str, Any], str]:
    """Metadata, format version, and the arrays and checksum of this version; another may have other arrays."""
    text = str(file["metadata"])
    found = json.loads(text)["format"]
    if found != FORMAT_VERSION:
        return text, found, {}, ""
    return text, found, {name: np.asarray(file[name]) for name in _ARRAYS}, str(file["checksum"])


def _packed(parameters: CellParameters, factors: FloatArray) -> PackedConstants:
    return parameters.packed if (factors == 1.0).all() else parameters.packed_with(factors)


def _check_factors(factors: FloatArray) -> None:
    good = np.isfinite(factors) & (factors > 0.0)
    if not good.all():
        raise ValueError(f"factors must be finite and greater than 0, got {factors[~good][0]:g}")


def _check_dt(dt_s: float, parameters: CellParameters, factors: FloatArray) -> float:
    # explicit Euler must be stable for the cell whose constants are fastest
    fastest = dict(zip(UNCERTAIN_CONSTANTS, factors.min(axis=0), strict=True))
    return check_dt(dt_s, parameters.replace(to=parameters.to * fastest["to"], tsn=parameters.tsn * fastest["tsn"]))


def _whole_number(name: str, value: int) -> int:
    try:
        return operator.index(value)
    except TypeError as error:
        raise TypeError(f"{name} must be a whole number, got {value!r}") from error


def _indices(name: str, values: ArrayLike, size: int) -> IntArray:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise TypeError(f"{name} must hold whole numbers, got {values!r}") from error
    if array.size == 0:
        return array.astype(np.int64)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{name} must hold whole numbers (of a mask, give np.flatnonzero), got {array.dtype} values")
    if not ((array >= 0) & (array < size)).all():
        raise ValueError(f"{name} must lie within 0 .. {size - 1}, got {array.min()} .. {array.max()}")
    return array.astype(np.int64)


def _check_cell(parameters: CellParameters, thermal: bool) -> None:
    if not isinstance(parameters, CellParameters):
        raise TypeError(f"parameters must be CellParameters, got {parameters!r}")
    if not isinstance(thermal, bool):
        raise TypeError(f"thermal must be True or False, got {thermal!r}")


def _starts(lengths: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)


def _checksum(metadata: str, arrays: dict[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(metadata.encode())
    for name in _ARRAYS:
        digest.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


@lru_cache(maxsize=2)
def _paper(parameter: str) -> TrajectoryDataset:
    value = np.tile(np.linspace(*PAPER_RANGES[parameter], PAPER_VALUES), len(PAPER_LOADS_W))
    fixed = np.full_like(value, NEW_CELL.r_o if parameter == "q_mobile" else NEW_CELL.q_mobile)
    return TrajectoryDataset.simulated(
        q_mobile=value if parameter == "q_mobile" else fixed,
        r_o=fixed if parameter == "q_mobile" else value,
        loads=[constant(power) for power in PAPER_LOADS_W],
        load_index=np.repeat(np.arange(len(PAPER_LOADS_W)), PAPER_VALUES),
        trim=PAPER_TRIM,
        description={"made_by": "paper", "parameter": parameter},
    )
