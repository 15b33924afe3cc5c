"""Simulated discharges of cells of many ages under many loads: generate, split, save, load."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from numbers import Real
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import LoadUnit, check_indices, check_range, check_whole_number
from battery_env.electrochemistry import (
    NEW_CELL,
    STATE_SIZE,
    UNCERTAIN_CONSTANTS,
    CellParameters,
    PackedConstants,
    Trajectory,
    advance_in_place,
    check_cell,
    check_dt,
    initial_state,
)
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_SIZE, AgingPath
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.electrochemistry.kernels import roll_out
from battery_env.files import read_npz, replacing
from battery_env.loads import Load, LoadSampler, constant
from battery_env.parameters import Q_MOBILE, R_O, check_parameters

#: Ranges of the aged parameters in the paper's data (the authors' code), C and ohm.
PAPER_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (4000.0, 7000.0), "r_o": (0.1, 0.2)}
PAPER_LOADS_W: tuple[float, ...] = tuple(np.linspace(8.0, 16.0, 11))
PAPER_VALUES = 501
PAPER_TRIM = (0.05, 0.95)

#: Largest ``mismatch`` of :meth:`TrajectoryDataset.generate`: beyond, the constants would be another cell's.
MISMATCH_LIMIT = 0.5

_CHECKPOINT_EVERY = 64  # steps between stored states: access to a state simulates 32 steps on average
_MIN_SAMPLES = 8
_MIN_TRIMMED_SAMPLES = 4
_LEAST_DT_S = 0.01  # of a discharge that may take a day
_INDICES = ("load_start", "samples", "first", "stop", "checkpoint_start")
_TRAJECTORY_ARRAYS = ("q_mobile", "r_o", "factors", "equilibrium_V", "eod_time_s", *_INDICES)
_ARRAYS = (*_TRAJECTORY_ARRAYS, "load_values", "checkpoint")
_SETTINGS = ("load_unit", "dt_s", "thermal")
_KIND, _FORMAT = "data set of simulated discharges", 4


@dataclass(frozen=True, eq=False)
class TrajectoryDataset(Sequence[Trajectory]):
    """
    Simulated discharges of many cells, for training and tests.

    .. code-block:: python

      from battery_env import TrajectoryDataset
      from battery_env.loads import constant

      aged = TrajectoryDataset.generate("q_mobile", n=100, loads=[constant(8.0), constant(12.0)], seed=0)
      train, test = aged.split(test=0.3, seed=0)
      print(len(train), test[0].q_mobile, test[0].eod_time_s)

    Made by :meth:`generate`, :meth:`along` a path of aging cells, :meth:`paper` (the data of Unagar et al.),
    :meth:`simulated`, :meth:`from_trajectories` or :meth:`load`. ``dataset[i]`` is a
    :class:`~battery_env.electrochemistry.Trajectory`, ``dataset[:10]`` a data set.

    The data set keeps parameters, loads and a state every 64 steps. Access to other states simulates these states again, to
    the same bits.

    :param q_mobile: C, shape (n,)
    :param r_o: ohm, shape (n,)
    :param factors: factors of ``UNCERTAIN_CONSTANTS`` (kn, tDiffusion, to, tsn) of each true cell, shape (n, 4); ones if the
        constants of ``cell`` are exact
    :param equilibrium_V: additions to the equilibrium voltage of each true cell, as in an
        :class:`~battery_env.AgingPath`, V, shape (n, 8); zeros if the voltage of ``cell`` is exact
    :param eod_time_s: end of discharge, s after the first sample of the whole discharge, shape (n,); NaN where unknown
    :param load_values: all load profiles, concatenated, one value a step
    :param load_start: start of each trajectory's profile in ``load_values``, shape (n,); trajectories may share a profile
    :param samples: length of the whole discharge, shape (n,)
    :param first: first sample that counts as data, shape (n,)
    :param stop: the last sample that counts as data, plus one, shape (n,)
    :param checkpoint: states after 0, 64, 128, ... steps, of all trajectories, concatenated, shape (m, 8)
    :param checkpoint_start: start of each trajectory in ``checkpoint``, shape (n,)
    :param load_unit: ``"power"`` or ``"current"``
    :param dt_s: time step, s
    :param thermal: whether the temperature moves
    :param cell: constants of the cell, as a calibrator may know them
    """

    q_mobile: FloatArray
    r_o: FloatArray
    factors: FloatArray
    equilibrium_V: FloatArray
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
    cell: CellParameters

    @staticmethod
    def generate(
        parameters: str | Sequence[str],
        n: int,
        loads: Sequence[Load] | LoadSampler,
        seed: int,
        q_mobile_range: tuple[float, float] = (4000.0, 7600.0),
        r_o_range: tuple[float, float] = (0.1, 0.2),
        dt_s: float = 1.0,
        thermal: bool = False,
        cell: CellParameters | None = None,
        mismatch: float = 0.0,
    ) -> TrajectoryDataset:
        """
        Simulate discharges of ``n`` cells with uniformly drawn ages; a parameter that does not age is the cell's.

        :param parameters: the parameters that age, independently: ``"q_mobile"``, ``"r_o"``, or ``("q_mobile", "r_o")``
        :param n: number of discharges
        :param loads: loads to choose from at random, or a sampler of loads
        :param seed: seed of ages and loads
        :param q_mobile_range: C
        :param r_o_range: ohm
        :param dt_s: time step, s
        :param thermal: whether the temperature moves
        :param cell: constants of the cell, as a calibrator may know them; ``None``: the new cell's
        :param mismatch: error of these constants: relative standard deviation of the factors of ``UNCERTAIN_CONSTANTS`` of
            each cell, log-normal with median 1, at most 0.5. Ages and loads do not depend on it
        :raises ValueError: for values out of range
        """
        names = aged_parameters(parameters)
        n, seed = check_whole_number("n", n, 1), check_whole_number("seed", seed, 0)
        if not isinstance(mismatch, Real) or not 0.0 <= mismatch <= MISMATCH_LIMIT:
            raise ValueError(f"mismatch is a relative standard deviation within 0 .. {MISMATCH_LIMIT:g}, got {mismatch!r}")
        q_range, r_range = check_range("q_mobile_range", q_mobile_range), check_range("r_o_range", r_o_range)
        Q_MOBILE.check(q_range)
        R_O.check(r_range)
        cell = check_cell(cell, thermal)
        rng = np.random.default_rng(seed)
        q = rng.uniform(*q_range, size=n) if "q_mobile" in names else np.full(n, cell.q_mobile)
        r = rng.uniform(*r_range, size=n) if "r_o" in names else np.full(n, cell.r_o)
        cell_loads, index = _draw_loads(loads, n, rng)
        # drawn last, so that ages and loads do not depend on the mismatch
        factors = np.exp(np.sqrt(np.log1p(mismatch**2)) * rng.standard_normal((n, len(UNCERTAIN_CONSTANTS))))
        return TrajectoryDataset.simulated(q, r, cell_loads, index, dt_s, thermal, cell, factors)

    @staticmethod
    def along(
        path: AgingPath,
        n: int,
        loads: Sequence[Load] | LoadSampler,
        seed: int,
        dt_s: float = 1.0,
    ) -> TrajectoryDataset:
        """
        Simulate discharges of ``n`` cells drawn along a path, whose constants age together with ``q_mobile`` and ``r_o``;
        loads, seed and simulation as of :meth:`generate`. The ``cell`` of the data set has the constants that all ages share.

        .. code-block:: python

          path = fit_life(load_nasa_discharges("B0006"))
          cells = TrajectoryDataset.along(path, n=100, loads=[constant(2.0, "current")], seed=0)

        :raises ValueError: for values out of range
        """
        if not isinstance(path, AgingPath):
            raise TypeError(f"path must be an AgingPath, got {type(path).__name__}")
        cells = path.draw(n, seed)
        cell_loads, index = _draw_loads(loads, n, np.random.default_rng([seed, 1]))
        return TrajectoryDataset.simulated(
            cells.q_mobile,
            cells.r_o,
            cell_loads,
            index,
            dt_s,
            cell=path.cell,
            factors=cells.factors,
            equilibrium_V=cells.equilibrium_V,
        )

    @staticmethod
    def simulated(
        q_mobile: ArrayLike,
        r_o: ArrayLike,
        loads: Sequence[Load],
        load_index: ArrayLike,
        dt_s: float = 1.0,
        thermal: bool = False,
        cell: CellParameters | None = None,
        factors: ArrayLike | None = None,
        equilibrium_V: ArrayLike | None = None,
    ) -> TrajectoryDataset:
        """
        Discharge cells from full charge to the end of discharge; ``dt_s``, ``thermal`` and ``cell`` are as of
        :meth:`generate`.

        :param q_mobile: C, shape (n,)
        :param r_o: ohm, shape (n,)
        :param loads: the loads that occur, all in one unit
        :param load_index: which of them each cell gets, shape (n,)
        :param factors: what ``UNCERTAIN_CONSTANTS`` of each cell are multiplied by, shape (n, 4); ``None``: ones
        :param equilibrium_V: what is added to its equilibrium voltage, V, shape (n, 8); ``None``: nothing
        :raises ValueError: for values out of range, or a discharge of fewer than eight samples
        """
        q, r = np.broadcast_arrays(*np.atleast_1d(Q_MOBILE.check(q_mobile), R_O.check(r_o)))
        if q.ndim != 1 or q.size == 0:
            raise ValueError(f"q_mobile and r_o must be 1-D and not empty, got shape {q.shape}")
        units = {load.unit if isinstance(load, Load) else type(load).__name__ for load in loads}
        if units not in ({"power"}, {"current"}):
            raise ValueError(f"loads must be Loads, all in one unit (power or current), got {sorted(units)}")
        index = np.broadcast_to(check_indices("load_index", load_index, len(loads)), q.shape)
        factors = np.broadcast_to(1.0 if factors is None else factors, (q.size, len(UNCERTAIN_CONSTANTS)))
        added_V = np.broadcast_to(0.0 if equilibrium_V is None else equilibrium_V, (q.size, EQUILIBRIUM_SIZE))
        factors, added_V = np.array(factors, dtype=np.float64, order="C"), np.array(added_V, dtype=np.float64, order="C")
        cell = check_cell(cell, thermal)
        dt_s = _check_dt(dt_s, cell, factors)
        if dt_s < _LEAST_DT_S:
            raise ValueError(f"dt_s must be at least {_LEAST_DT_S:g} s (a day of it must fit in memory), got {dt_s!r}")
        profiles, samples, checkpoints = _simulate(q, r, loads, index, dt_s, thermal, cell, factors, added_V)
        return TrajectoryDataset(
            q_mobile=np.array(q),
            r_o=np.array(r),
            factors=factors,
            equilibrium_V=added_V,
            eod_time_s=np.asarray(samples * dt_s, dtype=np.float64),
            load_values=np.concatenate(profiles),
            load_start=_starts(np.array([len(profile) for profile in profiles]))[index],
            samples=samples,
            first=np.zeros_like(samples),
            stop=samples,
            checkpoint=np.concatenate(checkpoints),
            checkpoint_start=_starts(_checkpoints(samples)),
            load_unit=loads[0].unit,
            dt_s=dt_s,
            thermal=bool(thermal),
            cell=cell,
        )

    def trimmed(self, low: float, high: float) -> TrajectoryDataset:
        """
        Return the data set with only a part of each discharge as data, from one share of its length to another; short
        discharges keep at least four samples.

        :raises ValueError: unless 0 <= low < high <= 1
        """
        if not 0.0 <= low < high <= 1.0:
            raise ValueError(f"low and high must be two increasing shares within 0 .. 1, got {low!r} and {high!r}")
        first = np.minimum(np.ceil(low * self.samples).astype(np.int64), self.samples - _MIN_TRIMMED_SAMPLES)
        stop = np.maximum(np.floor(high * self.samples).astype(np.int64), first + _MIN_TRIMMED_SAMPLES)
        return replace(self, first=first, stop=stop)

    @classmethod
    def from_trajectories(cls, trajectories: Sequence[Trajectory]) -> TrajectoryDataset:
        """
        Make a data set of single trajectories of :func:`~battery_env.electrochemistry.simulate`.

        :param trajectories: simulated discharges or parts of them, of cells that differ only in ``q_mobile`` and ``r_o``, with
            one unit of load and one time step
        :return: the data set, with a clock that starts with each trajectory, and with exact constants. To keep a ``mismatch``
            use a :meth:`subset` instead
        :raises ValueError: for no trajectories, or trajectories that differ otherwise
        """
        if isinstance(trajectories, Trajectory):
            raise TypeError("trajectories must be a list of them, got one Trajectory")
        for trajectory in trajectories:
            if not isinstance(trajectory, Trajectory):
                raise TypeError(f"trajectories must hold Trajectory, got {type(trajectory).__name__}")
            if len(trajectory.time_s) == 0:
                raise ValueError("trajectories must hold at least one sample each, got an empty one")
        cells = {trajectory.cell.replace(q_mobile=NEW_CELL.q_mobile, r_o=NEW_CELL.r_o) for trajectory in trajectories}
        settings = {(trajectory.load_unit, trajectory.dt_s, trajectory.thermal) for trajectory in trajectories}
        if len(cells) != 1 or len(settings) != 1:
            raise ValueError(
                "trajectories must share the constants of the cell but for q_mobile and r_o, one load unit, one time step (s) "
                f"and whether they are thermal, got {len(cells)} sets of constants and {settings}"
            )
        load_unit, dt_s, thermal = settings.pop()
        samples = np.array([len(trajectory.time_s) for trajectory in trajectories], dtype=np.int64)
        checkpoints = [trajectory.state[::_CHECKPOINT_EVERY] for trajectory in trajectories]
        return cls(
            q_mobile=np.array([trajectory.q_mobile for trajectory in trajectories]),
            r_o=np.array([trajectory.r_o for trajectory in trajectories]),
            factors=np.ones((len(trajectories), len(UNCERTAIN_CONSTANTS))),
            equilibrium_V=np.zeros((len(trajectories), EQUILIBRIUM_SIZE)),
            eod_time_s=np.array([trajectory.eod_time_s - trajectory.time_s[0] for trajectory in trajectories]),
            load_values=np.concatenate([trajectory.load for trajectory in trajectories]),
            load_start=_starts(samples),
            samples=samples,
            first=np.zeros_like(samples),
            stop=samples,
            checkpoint=np.concatenate(checkpoints),
            checkpoint_start=_starts(_checkpoints(samples)),
            load_unit=load_unit,
            dt_s=dt_s,
            thermal=thermal,
            cell=cells.pop(),
        )

    @classmethod
    def paper(cls, parameter: str) -> TrajectoryDataset:
        """
        Return the data of Unagar et al. 2020 (their code): eleven constant loads of 8 to 16 W times 501 values of the
        parameter (q_mobile 4000 to 7000 C, or r_o 0.1 to 0.2 ohm), from full charge to 3 V, trimmed to 5 .. 95 %. A process
        makes them once, in seconds.

        :param parameter: the parameter that ages
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
        samples, load = self.samples[n], self.load_profile(n)
        state, columns = np.empty((samples + 1, STATE_SIZE)), np.empty((2, samples))
        voltage, current = columns
        state[0] = self.checkpoint[self.checkpoint_start[n]]
        # no cut-off, because trajectories of a user may have samples below it
        packed = _packed(self.cell, self.factors[[n]], self.equilibrium_V[[n]])
        q, r, is_power = self.q_mobile[n], self.r_o[n], self.load_unit == "power"
        if roll_out(load, q, r, self.dt_s, -np.inf, is_power, self.thermal, packed, state, columns) < samples:
            raise ValueError(f"trajectory {n} cannot be simulated again: it was made with another load or other constants")
        return Trajectory(
            time_s=self.dt_s * np.arange(samples, dtype=np.float64),
            state=state[:samples],
            voltage_V=voltage,
            current_A=current,
            load=load.copy(),
            load_unit=self.load_unit,
            cell=self._cell(n),
            dt_s=self.dt_s,
            thermal=self.thermal,
            eod_time_s=float(self.eod_time_s[n]),
        ).part(self.first[n], self.stop[n])

    def load_profile(self, n: int) -> FloatArray:
        """Return the load of an untrimmed discharge: one value a step, W or A."""
        return self.load_values[self.load_start[n] : self.load_start[n] + self.samples[n]]

    def starts_full(self, n: int) -> bool:
        """Whether an untrimmed discharge starts with a fully charged cell at rest."""
        return np.array_equal(self.checkpoint[self.checkpoint_start[n]], initial_state(self.q_mobile[n], self.cell))

    def _cell(self, n: int) -> CellParameters:
        """Return the true constants of a trajectory."""
        nominal = {name: getattr(self.cell, name) for name in UNCERTAIN_CONSTANTS}
        true = {name: factor * nominal[name] for name, factor in zip(nominal, self.factors[n].tolist(), strict=True)}
        cell = self.cell.replace(q_mobile=float(self.q_mobile[n]), r_o=float(self.r_o[n]), **true)
        return with_equilibrium(cell, self.equilibrium_V[n]) if self.equilibrium_V[n].any() else cell

    def states_at(self, index: IntArray, sample: IntArray) -> FloatArray:
        """Return the true states of trajectories at samples, counted from full charge: shape (m, 8)."""
        if len(index) > 1 and self.equilibrium_V.any():
            return np.concatenate([self.states_at(index[[k]], sample[[k]]) for k in range(len(index))])
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
            _packed(self.cell, self.factors[index], self.equilibrium_V[index]),
        )
        return state

    def subset(self, index: ArrayLike) -> TrajectoryDataset:
        """Return a data set of trajectories by number, in this order; it shares the loads of this data set."""
        rows = check_indices("index", index, len(self))
        if rows.ndim != 1 or rows.size == 0:
            raise ValueError(f"index must be 1-D and not empty, got shape {rows.shape}")
        counts = _checkpoints(self.samples[rows])
        starts = _starts(counts)
        checkpoint_rows = np.arange(counts.sum()) + np.repeat(self.checkpoint_start[rows] - starts, counts)
        changes = {name: getattr(self, name)[rows] for name in _TRAJECTORY_ARRAYS}
        changes.update(checkpoint=self.checkpoint[checkpoint_rows], checkpoint_start=starts)
        return replace(self, **changes)

    def split(
        self, test: float = 0.3, by: Literal["trajectory", "parameter"] = "trajectory", seed: int = 0
    ) -> tuple[TrajectoryDataset, TrajectoryDataset]:
        """
        Divide into training trajectories and test trajectories.

        :param test: share of the test part, greater than 0 and less than 1
        :param by: ``"trajectory"``: at random; ``"parameter"``: the most aged cells (lowest q_mobile, or highest r_o where
            q_mobile is the same) are the test part, so that it is an extrapolation
        :param seed: seed of the random division
        :return: training part, test part
        :raises ValueError: if one of the parts would be empty
        """
        if not isinstance(test, Real) or not 0.0 < test < 1.0:
            raise ValueError(f"test must be greater than 0 and less than 1, got {test!r}")
        rng, count = np.random.default_rng(check_whole_number("seed", seed, 0)), round(test * len(self))
        if by not in ("trajectory", "parameter"):
            raise ValueError(f"by must be 'trajectory' or 'parameter', got {by!r}")
        order = rng.permutation(len(self)) if by == "trajectory" else np.lexsort((self.r_o, -self.q_mobile))[::-1]
        if not 0 < count < len(self):
            raise ValueError(f"a split of {len(self)} trajectories with test = {test} leaves one part empty")
        return self.subset(np.sort(order[count:])), self.subset(np.sort(order[:count]))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """
        Save as an npz file (no pickle) that holds the arrays and, as JSON, the constants.

        :param path: the file; a missing suffix ``.npz`` is added
        :raises FileExistsError: if the file exists already
        """
        settings = {name: getattr(self, name) for name in _SETTINGS} | {"cell": asdict(self.cell)}
        target, metadata = Path(path), json.dumps({**settings, "kind": _KIND, "format": _FORMAT})
        target = target.with_name(f"{target.name.removesuffix('.npz')}.npz")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in _ARRAYS}
        with replacing(target, new=True) as temporary:
            np.savez_compressed(temporary, metadata=np.array(metadata), **arrays)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TrajectoryDataset:
        """
        Read a file of :meth:`save`.

        :param path: the npz file
        :raises ValueError: if the file is damaged, no such data set, or of another format version
        """
        arrays, settings = read_npz(path, _KIND)
        if settings["format"] != _FORMAT:
            raise ValueError(f"{path} has format {settings['format']}, this version reads {_FORMAT}: make it again")
        try:
            fields: dict[str, Any] = {name: arrays[name] for name in _ARRAYS} | {name: settings[name] for name in _SETTINGS}
            dataset = cls(**fields, cell=CellParameters.of_mapping(settings["cell"]))
            _check(dataset)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} holds no valid data set: {error}") from error
        return dataset


def _checkpoints(samples: IntArray) -> IntArray:
    return (samples - 1) // _CHECKPOINT_EVERY + 1


def _packed(cell: CellParameters, factors: FloatArray, equilibrium_V: FloatArray) -> PackedConstants:
    """Return the true constants of cells of one equilibrium voltage: one row a cell, or one row of ``cell``."""
    if equilibrium_V.any():
        if (equilibrium_V != equilibrium_V[0]).any():
            raise ValueError("the cells have equilibrium voltages of their own, and only one at a time can be followed")
        cell = with_equilibrium(cell, equilibrium_V[0])
    return cell.packed if (factors == 1.0).all() else cell.packed_with(factors)


def _draw_loads(loads: Sequence[Load] | LoadSampler, n: int, rng: np.random.Generator) -> tuple[list[Load], IntArray]:
    """Return the loads, and the index of the load of each of n cells."""
    if isinstance(loads, Load) or not (callable(loads) or isinstance(loads, Sequence)):
        raise TypeError(f"loads must be a list of Loads or a sampler of them, got {type(loads).__name__}")
    if callable(loads):
        return [loads(rng) for _ in range(n)], np.arange(n)
    if len(loads) == 0:
        raise ValueError("loads must not be empty")
    return list(loads), rng.integers(len(loads), size=n)


def aged_parameters(parameters: str | Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that age, from one name or several, in the order of ``PARAMETER_NAMES``."""
    return tuple(sorted(check_parameters([parameters] if isinstance(parameters, str) else parameters)))


def _simulate(
    q_mobile: FloatArray,
    r_o: FloatArray,
    loads: Sequence[Load],
    load_index: IntArray,
    dt_s: float,
    thermal: bool,
    cell: CellParameters,
    factors: FloatArray,
    equilibrium_V: FloatArray,
) -> tuple[list[FloatArray], IntArray, list[FloatArray]]:
    """Return the profile of each load up to its last sample, and for each cell the number of samples and its checkpoints."""
    is_power = loads[0].unit == "power"
    day = dt_s * np.arange(round(86_400 / dt_s), dtype=np.float64)
    start = initial_state(q_mobile, cell)
    samples = np.empty(q_mobile.size, dtype=np.int64)
    profiles, checkpoints = [], {}
    # one buffer for all cells
    state, columns = np.empty((len(day) + 1, STATE_SIZE)), np.empty((2, len(day)))
    for k, load in enumerate(loads):
        profile = load(day)
        cells = np.flatnonzero(load_index == k)
        for n in cells.tolist():
            state[0] = start[n]
            packed = _packed(cell, factors[[n]], equilibrium_V[[n]])
            samples[n] = roll_out(profile, q_mobile[n], r_o[n], dt_s, cell.VEOD, is_power, thermal, packed, state, columns)
            if samples[n] < _MIN_SAMPLES:
                raise ValueError(
                    f"trajectory {n} (q_mobile {q_mobile[n]:g} C, r_o {r_o[n]:g} ohm) ends after {samples[n]} samples, at "
                    f"least {_MIN_SAMPLES} are needed: lower its load ({load.value[0]:g}), r_o or dt_s ({dt_s:g})"
                )
            if samples[n] == len(day):
                raise ValueError(f"trajectory {n} does not reach the end of discharge within a day: raise its load")
            checkpoints[n] = state[: samples[n] : _CHECKPOINT_EVERY].copy()
        profiles.append(profile[: samples[cells].max(initial=0)].copy())
    return profiles, samples, [checkpoints[n] for n in range(q_mobile.size)]


def _check(data: TrajectoryDataset) -> None:
    """Refuse inconsistent arrays of a file, because compiled loops do not check indices."""
    n = np.size(data.q_mobile)
    shapes = dict.fromkeys(_TRAJECTORY_ARRAYS, (n,)) | {
        "factors": (n, len(UNCERTAIN_CONSTANTS)),
        "equilibrium_V": (n, EQUILIBRIUM_SIZE),
        "load_values": (np.size(data.load_values),),
        "checkpoint": (np.size(data.checkpoint) // STATE_SIZE, STATE_SIZE),
    }
    for name, shape in shapes.items():
        array, dtype = getattr(data, name), np.int64 if name in _INDICES else np.float64
        if array.dtype != dtype or array.shape != shape or n == 0:
            raise ValueError(
                f"{name} must be an array of {dtype.__name__} of shape {shape}, not empty, got {array.dtype} {array.shape}"
            )
    is_valid = {
        "first and stop": (data.first >= 0) & (data.first < data.stop) & (data.stop <= data.samples),
        "load_start": (data.load_start >= 0) & (data.load_start + data.samples <= len(data.load_values)),
        "checkpoint_start": (data.checkpoint_start >= 0)
        & (data.checkpoint_start + _checkpoints(data.samples) <= len(data.checkpoint)),
    }
    for name, is_inside in is_valid.items():
        if not is_inside.all():
            raise ValueError(f"{name} of trajectory {np.flatnonzero(~is_inside)[0]} lie outside its data")


def _check_dt(dt_s: float, cell: CellParameters, factors: FloatArray) -> float:
    # explicit Euler must be stable for the cell with the fastest constants
    fastest = dict(zip(UNCERTAIN_CONSTANTS, factors.min(axis=0), strict=True))
    return check_dt(dt_s, cell.replace(to=cell.to * fastest["to"], tsn=cell.tsn * fastest["tsn"]))


def _starts(lengths: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)


@lru_cache(maxsize=2)
def _paper(parameter: str) -> TrajectoryDataset:
    value = np.tile(np.linspace(*PAPER_RANGES[parameter], PAPER_VALUES), len(PAPER_LOADS_W))
    fixed = np.full_like(value, NEW_CELL.r_o if parameter == "q_mobile" else NEW_CELL.q_mobile)
    dataset = TrajectoryDataset.simulated(
        q_mobile=value if parameter == "q_mobile" else fixed,
        r_o=fixed if parameter == "q_mobile" else value,
        loads=[constant(power) for power in PAPER_LOADS_W],
        load_index=np.repeat(np.arange(len(PAPER_LOADS_W)), PAPER_VALUES),
    )
    return dataset.trimmed(*PAPER_TRIM)
