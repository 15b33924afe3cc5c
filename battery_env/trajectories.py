"""Simulated discharges of cells of many ages under many loads: generate, split, save, load."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from battery_env.electrochemistry import (
    NEW_CELL,
    CellParameters,
    FloatArray,
    LoadUnit,
    Trajectory,
    advance_in_place,
    check_dt,
    check_load,
    check_q_mobile,
    check_r_o,
    simulate,
)
from battery_env.files import replacing
from battery_env.loads import Load, LoadSampler, constant

IntArray = NDArray[np.int64]
AgedParameter = Literal["q_mobile", "r_o", "joint"]

#: Ranges of the aged parameters in the paper's data (the authors' code), C and ohm.
PAPER_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (4000.0, 7000.0), "r_o": (0.1, 0.2)}
PAPER_LOADS_W: tuple[float, ...] = tuple(np.linspace(8.0, 16.0, 11))
PAPER_VALUES = 501

FORMAT_VERSION = 1
_CHECKPOINT_EVERY = 64  # steps between stored states: a window starts with 32 steps of re-simulation on average
_MIN_SAMPLES = 8
_ARRAYS = ("q_mobile", "r_o", "load_values", "load_start", "samples", "first", "stop", "checkpoint", "checkpoint_start")


@dataclass(frozen=True, eq=False)
class TrajectoryDataset(Sequence[Trajectory]):
    """
    Simulated discharges, kept as their parameters, loads and a state every 64 steps; everything between is simulated
    again when it is asked for, to the same bits, which costs less than reading it from memory would gain.

    Made by :meth:`generate`, :meth:`paper` or :meth:`load`. ``dataset[i]`` is a
    :class:`~battery_env.electrochemistry.Trajectory`.

    :param q_mobile: C, shape (n,)
    :param r_o: ohm, shape (n,)
    :param load_values: all load profiles end to end, one value a step
    :param load_start: where in ``load_values`` each trajectory's profile starts, shape (n,); trajectories may share a profile
    :param samples: length of the whole discharge, shape (n,)
    :param first: first sample that counts as data, shape (n,)
    :param stop: one past the last sample that does, shape (n,)
    :param checkpoint: states after 0, 64, 128, ... steps, all trajectories end to end, shape (*, 8)
    :param checkpoint_start: where in ``checkpoint`` each trajectory starts, shape (n,)
    :param load_unit: ``"power"`` or ``"current"``
    :param dt_s: time step, s
    :param thermal: whether the temperature moves
    :param parameters: constants of the cell
    :param description: how the data set was made; saved with it
    """

    q_mobile: FloatArray
    r_o: FloatArray
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
        :param parameters: constants of the cell
        :param description: how the data set was made
        :return: the data set
        :raises ValueError: for values out of range, or a discharge of fewer than eight samples
        """
        q, r = np.broadcast_arrays(*np.atleast_1d(check_q_mobile(q_mobile), check_r_o(r_o)))
        index = np.broadcast_to(np.asarray(load_index, dtype=np.int64), q.shape)
        if q.ndim != 1 or q.size == 0:
            raise ValueError(f"q_mobile, r_o and load_index must be 1-D and not empty, got shape {q.shape}")
        if not 0.0 <= trim[0] < trim[1] <= 1.0:
            raise ValueError(f"trim must be two increasing shares within 0 .. 1, got {trim!r}")
        if len({load.unit for load in loads}) != 1:
            raise ValueError(f"loads must be all in one unit (power or current), got {[load.unit for load in loads]}")
        unit = loads[0].unit
        dt_s = check_dt(dt_s, parameters)

        day = np.arange(round(86_400 / dt_s)) * dt_s
        profiles = [check_load(load(day), unit) for load in loads]
        samples = np.empty(q.size, dtype=np.int64)
        longest = np.zeros(len(loads), dtype=np.int64)
        checkpoints = []
        for n in range(q.size):
            whole = simulate(profiles[index[n]], q[n], r[n], "eod", dt_s, unit, thermal, parameters)
            samples[n] = len(whole.time_s)
            if samples[n] < _MIN_SAMPLES:
                raise ValueError(
                    f"trajectory {n} (q_mobile {q[n]:g} C, r_o {r[n]:g} ohm) ends after {samples[n]} samples, at least "
                    f"{_MIN_SAMPLES} are needed: lower its load ({loads[index[n]].value[0]:g}) or r_o"
                )
            if not np.isfinite(whole.eod_time_s):
                raise ValueError(f"trajectory {n} does not reach the end of discharge within a day: raise its load")
            checkpoints.append(whole.state[::_CHECKPOINT_EVERY])
            longest[index[n]] = max(longest[index[n]], samples[n])
        first = np.ceil(trim[0] * samples).astype(np.int64)
        return cls(
            q_mobile=np.array(q),
            r_o=np.array(r),
            load_values=np.concatenate([profile[:steps] for profile, steps in zip(profiles, longest, strict=True)]),
            load_start=_starts(longest)[index],
            samples=samples,
            first=first,
            stop=np.maximum(np.floor(trim[1] * samples).astype(np.int64), first + _MIN_SAMPLES // 2),
            checkpoint=np.concatenate(checkpoints),
            checkpoint_start=_starts(np.array([len(states) for states in checkpoints])),
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
        :param parameters: constants of the cell
        :return: the data set
        :raises ValueError: for values out of range
        """
        if parameter not in ("q_mobile", "r_o", "joint"):
            raise ValueError(f"parameter must be 'q_mobile', 'r_o' or 'joint', got {parameter!r}")
        if n < 1:
            raise ValueError(f"n must be at least 1, got {n}")
        if not callable(loads) and len(loads) == 0:
            raise ValueError("loads must not be empty")
        rng = np.random.default_rng(seed)
        q = np.full(n, parameters.q_mobile) if parameter == "r_o" else rng.uniform(*q_mobile_range, size=n)
        r = np.full(n, parameters.r_o) if parameter == "q_mobile" else rng.uniform(*r_o_range, size=n)
        if callable(loads):
            drawn, index = [loads(rng) for _ in range(n)], np.arange(n)
        else:
            drawn, index = list(loads), rng.integers(len(loads), size=n)
        description = {"made_by": "generate", "parameter": parameter, "n": n, "seed": seed, "trim": list(trim)}
        return cls.simulated(q, r, drawn, index, trim, dt_s, thermal, parameters, description)

    @classmethod
    def from_trajectories(cls, trajectories: Sequence[Trajectory]) -> TrajectoryDataset:
        """
        A data set of trajectories made one by one with :func:`~battery_env.electrochemistry.simulate`, isothermal, with a new
        cell's constants.

        :param trajectories: simulated discharges or parts of them, in one unit of load and one time step
        :return: the data set; its clock starts with each trajectory
        :raises ValueError: if there are none, or their units or time steps differ
        """
        units = {trajectory.load_unit for trajectory in trajectories}
        steps = {round(float(dt), 9) for trajectory in trajectories for dt in np.diff(trajectory.time_s[:2])}
        if len(units) != 1 or len(steps) != 1:
            raise ValueError(f"trajectories must share one load unit and one time step, got units {units} and steps {steps} s")
        samples = np.array([len(trajectory.time_s) for trajectory in trajectories])
        checkpoints = [trajectory.state[::_CHECKPOINT_EVERY] for trajectory in trajectories]
        return cls(
            q_mobile=np.array([trajectory.q_mobile for trajectory in trajectories]),
            r_o=np.array([trajectory.r_o for trajectory in trajectories]),
            load_values=np.concatenate([trajectory.load for trajectory in trajectories]),
            load_start=_starts(samples),
            samples=samples,
            first=np.zeros_like(samples),
            stop=samples,
            checkpoint=np.concatenate(checkpoints),
            checkpoint_start=_starts(np.array([len(states) for states in checkpoints])),
            load_unit=units.pop(),
            dt_s=steps.pop(),
            thermal=False,
            parameters=NEW_CELL,
            description={"made_by": "from_trajectories"},
        )

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
        whole = simulate(
            self.load_values[self.load_start[n] : self.load_start[n] + self.samples[n]],
            self.q_mobile[n],
            self.r_o[n],
            dt=self.dt_s,
            load_unit=self.load_unit,
            thermal=self.thermal,
            parameters=self.parameters,
            initial=self.checkpoint[self.checkpoint_start[n]],
            cut_off_V=-np.inf,
        )
        return Trajectory(**{**whole.part(self.first[n], self.stop[n]).__dict__, "eod_time_s": self.samples[n] * self.dt_s})

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[n] for n in range(len(self)))

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
            self.parameters.packed,
        )
        return state

    def subset(self, index: ArrayLike) -> TrajectoryDataset:
        """
        Some of the trajectories.

        :param index: which, shape (m,), in the order wanted
        :return: a data set of them; the loads are shared with this one
        """
        chosen = np.asarray(index, dtype=np.int64)
        if chosen.ndim != 1 or chosen.size == 0:
            raise ValueError(f"index must be 1-D and not empty, got shape {chosen.shape}")
        counts = (self.samples[chosen] - 1) // _CHECKPOINT_EVERY + 1
        starts = _starts(counts)
        rows = np.arange(counts.sum()) + np.repeat(self.checkpoint_start[chosen] - starts, counts)
        changes = {name: getattr(self, name)[chosen] for name in ("q_mobile", "r_o", "load_start", "samples", "first", "stop")}
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
        if not 0.0 < test < 1.0:
            raise ValueError(f"test must be greater than 0 and less than 1, got {test!r}")
        rng = np.random.default_rng(seed)
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
        target = Path(path)
        target = target if target.suffix == ".npz" else target.with_name(target.name + ".npz")
        if target.exists():
            raise FileExistsError(f"{target} exists already; delete it or choose another name")
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        metadata = {
            "format": FORMAT_VERSION,
            "load_unit": self.load_unit,
            "dt_s": self.dt_s,
            "thermal": self.thermal,
            "parameters": asdict(self.parameters),
            "description": self.description,
            "versions": {"python": platform.python_version(), "numpy": np.__version__, "numba": version("numba")},
            "sha256": _checksum(arrays),
        }
        with replacing(target) as part:
            np.savez_compressed(part, allow_pickle=False, metadata=np.array(json.dumps(metadata)), **arrays)
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TrajectoryDataset:
        """
        Read what :meth:`save` wrote.

        :param path: the npz file
        :return: the data set
        :raises ValueError: if the file is damaged, no such data set, or of another format version
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                metadata = json.loads(str(file["metadata"]))
                arrays = {name: file[name] for name in _ARRAYS}
        except FileNotFoundError:
            raise
        except Exception as error:
            raise ValueError(f"{path} is damaged, or no data set saved by TrajectoryDataset.save: {error}") from error
        if metadata.get("format") != FORMAT_VERSION:
            found = metadata.get("format")
            raise ValueError(f"{path} has format {found}, this version reads {FORMAT_VERSION}: generate it again")
        if _checksum(arrays) != metadata["sha256"]:
            raise ValueError(f"{path} is damaged: its contents do not match their checksum")
        constants: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in metadata["parameters"].items()}
        return cls(
            **arrays,
            load_unit=metadata["load_unit"],
            dt_s=metadata["dt_s"],
            thermal=metadata["thermal"],
            parameters=CellParameters(**constants),
            description=metadata["description"],
        )


def _starts(lengths: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)


def _checksum(arrays: dict[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
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
        trim=(0.05, 0.95),
        description={"made_by": "paper", "parameter": parameter},
    )
