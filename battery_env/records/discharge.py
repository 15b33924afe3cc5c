"""Recorded discharges of real cells, and those that come with the package."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache
from importlib.resources import as_file, files
from math import hypot
from numbers import Real
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from battery_env.arrays import FloatArray
from battery_env.checks import check_positive
from battery_env.parameters import Q_MOBILE
from battery_env.records.history import ChargeHistory
from battery_env.records.load import (
    REST_CURRENT_A,
    SWITCH_SHARE,
    LoadSpan,
    integrate_load,
    load_on_sd_C,
    load_span,
    rest_current_A,
    switch_times_s,
    switched_charge,
)
from battery_env.records.refusals import Advice, RecordError
from battery_env.records.samples import MILLIAMPERE, check_column, check_drawn_charge, check_samples, drawn_charge_C

#: How to cite the bundled data.
NASA_CITATION = (
    "B. Saha and K. Goebel (2007). Battery Data Set, NASA Ames Prognostics Data Repository, "
    "NASA Ames Research Center, Moffett Field, CA."
)
#: Cells whose discharges come with the package.
BUNDLED_CELLS: tuple[str, ...] = ("B0005", "B0006")

#: Least number of samples of a discharge.
LEAST_SAMPLES = 5
_COLUMNS = ("time_s", "voltage_V", "current_A")
# columns of cycles.csv that go into ``meta``
_META_COLUMNS = ("test_id", "start_time", "ambient_temperature_C", "capacity_Ah", "Re_ohm", "Rct_ohm")
_DURATION_LIMITS_S = (10.0, 1e6)
#: Units of a clock: the symbol on the command line, and the unit in s.
CLOCKS = {
    "seconds": ("s", 1.0),
    "milliseconds": ("ms", 1e-3),
    "microseconds": ("us", 1e-6),
    "nanoseconds": ("ns", 1e-9),
    "minutes": ("min", 60.0),
    "hours": ("h", 3600.0),
    "days": ("d", 86400.0),
}
# A voltage that changes by this from one sample to the next, and back, without its load is a fault of the sensor, V.
_JUMP_V = 0.05
# Under a load that varies, a fault of the sensor spans at most this number of samples below the cut-off.
_MOST_DIP_SAMPLES = 3


@dataclass(frozen=True, eq=False)
class Discharge:
    """
    One recorded discharge of one cell, checked on construction, with read-only arrays.

    :param time_s: times of the samples, strictly increasing, s, shape (T,)
    :param voltage_V: terminal voltage, V, shape (T,)
    :param current_A: current, positive in discharge, A, shape (T,)
    :param temperature_C: temperature of the cell, degC, shape (T,); ``None`` if not measured. Models read only the first
        value, and :func:`battery_env.calibrate` takes this value for the surroundings: ``LeastSquares`` computes its own
        temperature from there, and the model of ``PolicyEstimator`` is isothermal
    :param meta: other data, e.g. ``cell``, ``cycle``, ``capacity_Ah``, ``start_time``, ``source``
    :param starts_at_rest: whether the first voltage is the voltage at rest, and the first current the current of the load
        that is then switched on, as in a :meth:`loaded_part`. Calibrators use this voltage to check whether the cell was full
    :param history: the history of the charge: the charge before shows whether the cell was full
    :raises ValueError: for arrays of different shapes, or invalid values; the message says what to do
    """

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    temperature_C: FloatArray | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    starts_at_rest: bool = False
    history: ChargeHistory = field(default_factory=ChargeHistory)
    #: see :func:`battery_env.records.check_record`
    is_checked: ClassVar[bool] = True

    def __post_init__(self) -> None:
        samples = check_samples(self.time_s, self.voltage_V, self.current_A, LEAST_SAMPLES)
        columns = dict(zip(_COLUMNS, samples, strict=True))
        if self.temperature_C is not None:
            columns["temperature_C"] = check_column("temperature_C", self.temperature_C, LEAST_SAMPLES)
            if len(self.temperature_C) != len(columns["time_s"]):
                raise ValueError(f"temperature_C has {len(self.temperature_C)} samples, but time_s has {len(self.time_s)}")
        for name, array in columns.items():
            object.__setattr__(self, name, array)
        self._check_extent()

    def _check_extent(self) -> None:
        """Refuse a discharge of too few samples, or over a time or with a charge that no cell has."""
        if len(self.time_s) < LEAST_SAMPLES:
            raise ValueError(f"a discharge needs at least {LEAST_SAMPLES} samples, got {len(self.time_s)}")
        duration_s = self.time_s[-1] - self.time_s[0]
        least_s, most_s = _DURATION_LIMITS_S
        if not least_s <= duration_s <= most_s:
            units = [
                Advice(f"Give the time in seconds: {ticks_s:.0f} s if it is in {unit}", "units", {"time": symbol}, "time")
                for unit, (symbol, tick_s) in CLOCKS.items()
                if least_s <= (ticks_s := tick_s * duration_s) <= most_s
            ]
            raise RecordError(
                f"time_s must span {least_s:g} .. {most_s:g} s, got {duration_s:g} s, too "
                f"{'short' if duration_s < least_s else 'long'} for a discharge",
                units,
            )
        check_drawn_charge(drawn_charge_C(self))
        if self.charge_C > Q_MOBILE.limits[1]:
            raise RecordError(
                f"this record draws {self.charge_C:.3g} C, more than the {Q_MOBILE.limits[1]:g} C that a cell may hold",
                [MILLIAMPERE],
            )

    def _derived(self, **changes: Any) -> Discharge:
        """Return a copy with other columns, unchecked: each column was checked when it came from outside."""
        derived = object.__new__(Discharge)
        for name, value in {**{column.name: getattr(self, column.name) for column in fields(self)}, **changes}.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(derived, name, value)
        derived._check_extent()
        return derived

    def without_temperature(self) -> Discharge:
        """Return the discharge without its temperature."""
        return self._derived(temperature_C=None)

    @cached_property
    def load(self) -> LoadSpan:
        """The first and the last sample under load."""
        return load_span(self.time_s, self.current_A)

    @property
    def charge_C(self) -> float:
        """The charge drawn from the first sample to the last, C."""
        return drawn_charge_C(self)

    @property
    def sd_charge_C(self) -> float:
        """Standard deviation of the charge drawn, C: from the moments of switches, the tester's counter, and an offset."""
        history, (first, last) = self.history, self.load
        start = max(first - 1, 0)  # a counter covers the load only
        uncounted = [slice(start, first + 1), slice(last, last + 2)] if history.is_counted else [slice(start, None)]
        switched_C = [switched_charge(self.time_s[stretch], self.current_A[stretch]).sd_C for stretch in uncounted]
        return hypot(history.load_on_C, history.offset_A * float(np.ptp(self.time_s)), history.sd_counter_C, *switched_C)

    @property
    def load_on_time_s(self) -> float:
        """
        When the load was switched on, s: midway between the last sample at rest and the first sample under load, but at most
        one interval of the samples under load before these, because testers often log a rest more seldom than a load.
        """
        if not (first := self.load.first):
            return float(self.time_s[0])
        return float(switch_times_s(self.time_s, self.current_A, np.array([first - 1]))[0])

    def _first_below(self, cut_off_V: float) -> int | None:
        """Return the first sample under load that is at the cut-off or below."""
        if not isinstance(cut_off_V, Real) or np.isnan(cut_off_V):
            raise ValueError(f"cut_off_V must be a voltage in V, got {cut_off_V!r}")
        first, last = self.load
        below_rows = np.flatnonzero(self.voltage_V[first : last + 1] <= cut_off_V) + first
        # one sample after the switch the voltage may still be of the load before
        for row in self._ends_of_loads(first, int(below_rows[0]) - 2 if len(below_rows) else last):
            if self._ends_at(cut_off_V, row):
                return row
        if not len(below_rows):
            return None
        start = int(below_rows[0])
        above_rows = np.flatnonzero(self.voltage_V[start : last + 1] > cut_off_V) + start
        if start > 0 and len(above_rows):
            self._refuse_dip(start, int(above_rows[0]), cut_off_V)
        return start

    def _ends_of_loads(self, first: int, last: int) -> list[int]:
        """Return the last samples, within ``first`` .. ``last``, of loads after which the discharge has only smaller loads."""
        current_A = np.append(self.current_A[first : self.load.last + 1], 0.0)
        largest_later_A = np.maximum.accumulate(current_A[:0:-1])[::-1]
        ends = np.flatnonzero(largest_later_A < (1.0 - SWITCH_SHARE) * current_A[:-1]) + first
        return [int(end) for end in ends if end <= last]

    def _ends_at(self, cut_off_V: float, last: int) -> bool:
        """Whether the last voltage is within its last fall of the cut-off: testers may omit the reading that stops them."""
        first, _ = self.load
        interval_s = float(np.median(np.diff(self.time_s[first : last + 1]))) if last > first else 0.0
        # the row of the end may come just after a regular row
        previous = max(int(np.searchsorted(self.time_s, self.time_s[last] - 0.5 * interval_s)) - 1, 0)
        is_steady = abs(self.current_A[last] - self.current_A[previous]) <= SWITCH_SHARE * self.current_A.max()
        fall_V = self.voltage_V[previous] - self.voltage_V[last]
        return bool(is_steady and fall_V > 0.0 and self.voltage_V[last] - cut_off_V <= fall_V)

    def _refuse_dip(self, dip_row: int, recovery_row: int, cut_off_V: float) -> None:
        """Refuse a voltage that falls below the cut-off in one step and returns in another, if the load explains neither."""
        voltage_V, current_A = self.voltage_V, self.current_A
        # an ohmic drop takes at most the whole voltage above the cut-off at the largest current
        largest_A = current_A.max()
        largest_ohm = max(float(voltage_V.max()) - cut_off_V, 0.0) / largest_A
        changed_A = np.ptp(current_A[dip_row - 1 : recovery_row + 1])
        if recovery_row - dip_row > _MOST_DIP_SAMPLES and changed_A > SWITCH_SHARE * largest_A:
            return

        def unexplained_V(high_row: int, low_row: int) -> float:
            # the tester may log voltage and current one sample apart
            step_A = float(current_A[max(low_row - 1, 0) : low_row + 1].max() - current_A[high_row])
            explained_V = largest_ohm * max(step_A, 0.0)
            return float(voltage_V[high_row] - voltage_V[low_row]) - explained_V

        falls_V, returns_V = unexplained_V(dip_row - 1, dip_row), unexplained_V(recovery_row, recovery_row - 1)
        if min(falls_V, returns_V) > _JUMP_V and unexplained_V(recovery_row, dip_row - 1) < _JUMP_V:
            raise ValueError(
                f"the voltage falls to {voltage_V[dip_row]:.2f} V at {self.time_s[dip_row]:g} s and is back at "
                f"{self.time_s[recovery_row]:g} s, and the load explains neither: a fault of the sensor, or another discharge."
                f" Remove these samples ({recovery_row - dip_row}), or give each discharge alone, or number them in a column "
                "of the cycle"
            )

    def eod_time_s(self, cut_off_V: float) -> float:
        """
        When the voltage under load first fell to the cut-off, interpolated between two samples. A load that stops above the
        cut-off, by no more than the fall over its last interval, ends there.

        :param cut_off_V: cut-off voltage, V
        :return: the end of discharge on the clock of ``time_s``, s; NaN if the record does not reach it
        :raises ValueError: if the voltage is at the cut-off by a fault of the sensor
        """
        n = self._first_below(cut_off_V)
        if n is None:
            return float("nan")
        if n == self.load.first or self.voltage_V[n] > cut_off_V:
            return float(self.time_s[n])
        share = (self.voltage_V[n - 1] - cut_off_V) / (self.voltage_V[n - 1] - self.voltage_V[n])
        return float(self.time_s[n - 1] + share * (self.time_s[n] - self.time_s[n - 1]))

    def loaded_part(self, cut_off_V: float) -> Discharge:
        """
        Return the part for the comparison with a model: from load-on to the cut-off, or to the last sample under load if the
        cut-off is not reached. Its first sample is the moment of switching, with the voltage at rest and the current under
        load; its last sample, at the cut-off, is interpolated.

        :param cut_off_V: cut-off voltage, V
        :return: the part, on the same clock
        :raises ValueError: if it has too few samples, or the voltage is below the cut-off by a fault of the sensor
        """
        first, last = self.load
        start_s, end_s = self.load_on_time_s, self.eod_time_s(cut_off_V)
        if np.isnan(end_s):
            end_s = float(self.time_s[last])
        time_s = np.concatenate([[start_s], self.time_s[(self.time_s > start_s) & (self.time_s < end_s)], [end_s]])
        if len(time_s) < LEAST_SAMPLES:
            under_load_V = self.voltage_V[first : last + 1]
            if (above := int((under_load_V > cut_off_V).sum())) + LEAST_SAMPLES <= len(under_load_V):
                exception = f", but for {above} samples," if above else ""
                least_V = float(f"{under_load_V[under_load_V > 0.0].min(initial=cut_off_V):.4g}")
                raise RecordError(
                    f"all of the voltage under load{exception} lies below the cut-off of {cut_off_V:g} V",
                    [Advice("State where the discharge ends", "cut_off_V", least_V)],
                )
            raise ValueError(
                f"only {len(time_s)} samples lie between load-on at {start_s:g} s and {cut_off_V:g} V or the end of the load; "
                f"at least {LEAST_SAMPLES} are needed"
            )
        names = ("voltage_V", "current_A") if self.temperature_C is None else ("voltage_V", "current_A", "temperature_C")
        columns = {name: np.interp(time_s, self.time_s, getattr(self, name)) for name in names}
        # the last row before a load may already have the voltage under load: then the row before it is the last at rest
        is_mixed = first > 1 and bool(
            abs(self.voltage_V[first - 1] - self.voltage_V[first]) < abs(self.voltage_V[first - 1] - self.voltage_V[first - 2])
        )
        rest_row = max(first - 1 - is_mixed, 0)
        columns["voltage_V"][0], columns["current_A"][0] = self.voltage_V[rest_row], self.current_A[first]
        starts_at_rest, history = self.starts_at_rest, self.history
        if first:
            starts_at_rest = bool(abs(self.current_A[rest_row]) <= REST_CURRENT_A)
            load_on_C = load_on_sd_C(self.time_s, self.current_A, first, start_s)
            history = history._replace(rest_s=float(self.time_s[rest_row] - self.time_s[0]), load_on_C=load_on_C)
        if (offset_A := rest_current_A(self.current_A)) is not None:
            history = history._replace(offset_A=offset_A)
        return self._derived(time_s=time_s, **columns, starts_at_rest=starts_at_rest, history=history)

    def averaged(self, dt_s: float) -> Discharge:
        """
        Return the discharge with one sample for each stretch of time: the means of voltage and temperature over its samples,
        and the mean current, which keeps the charge drawn. The first and the last sample stay as they are. A load that is
        switched within a stretch is switched in two steps.

        :param dt_s: length of a stretch, s
        :return: at most ``2 + (last time - first time) / dt_s`` samples, rounded up
        :raises ValueError: for a ``dt_s`` that is not positive, or leaves too few samples
        """
        check_positive("dt_s", dt_s)
        inner = slice(1, len(self.time_s) - 1)
        stretch = ((self.time_s[inner] - self.time_s[0]) / dt_s).astype(np.int64)
        firsts = np.flatnonzero(np.diff(stretch, prepend=-1))
        counts = np.diff(np.append(firsts, len(stretch)))

        def mean(values: FloatArray) -> FloatArray:
            return np.concatenate([values[:1], np.add.reduceat(values[inner], firsts) / counts, values[-1:]])

        time_s = mean(self.time_s)
        # edges midway between means, so that the stretches cover the charge exactly once
        edges_s = np.concatenate([time_s[:1], 0.5 * (time_s[1:] + time_s[:-1]), time_s[-1:]])
        current_A = np.diff(integrate_load(self.time_s, self.current_A, edges_s)) / np.diff(edges_s)
        current_A[[0, -1]] = self.current_A[[0, -1]]
        temperature_C = None if self.temperature_C is None else mean(self.temperature_C)
        return self._derived(time_s=time_s, voltage_V=mean(self.voltage_V), current_A=current_A, temperature_C=temperature_C)

    def until(self, time_s: float) -> Discharge:
        """Return the samples up to a time on the clock of the record, s; a ``ValueError`` if these are too few."""
        if not isinstance(time_s, Real) or np.isnan(time_s):
            raise ValueError(f"time_s must be a time in s, got {time_s!r}")
        n = int(np.searchsorted(self.time_s, time_s, side="right"))
        names = ("time_s", "voltage_V", "current_A", "temperature_C")
        return self._derived(**{name: None if (column := getattr(self, name)) is None else column[:n] for name in names})


def load_nasa_discharges(cell: str) -> list[Discharge]:
    """
    Load all discharges of one cell of NASA's battery data set, in their order. Cite it as ``NASA_CITATION``.

    .. code-block:: python

      from battery_env import load_nasa_discharges

      discharges = load_nasa_discharges("B0005")  # or "B0006"
      print([(each.meta["cycle"], each.meta["capacity_Ah"]) for each in discharges[::40]])
      first = discharges[0].loaded_part(cut_off_V=2.7)  # what estimators take

    Their ``meta`` holds ``cell``, ``cycle`` (1, 2, ... over the discharges), ``source``, ``start_time``,
    ``ambient_temperature_C``, ``capacity_Ah`` (charge to 2.7 V), ``Re_ohm`` and ``Rct_ohm`` (of the impedance test nearest in
    time) and ``test_id`` (position among all tests of the cell).

    :param cell: a cell of the package (``BUNDLED_CELLS``). For NASA's own files of other cells, such as ``B0018.mat``, use
        :func:`battery_env.read_discharges`
    :return: the discharges
    :raises FileNotFoundError: if there is no such cell
    """
    if cell not in BUNDLED_CELLS:
        raise FileNotFoundError(
            f"no cell {str(cell)!r} comes with the package, but {', '.join(BUNDLED_CELLS)}; read_discharges reads files"
        )
    return [discharge._derived(meta=dict(discharge.meta)) for discharge in _bundled(cell)]


@lru_cache
def _bundled(cell: str) -> list[Discharge]:
    with as_file(files("battery_env.records.nasa_cells")) as folder:
        samples = pd.read_csv(folder / f"{cell}_discharge.csv.gz", usecols=["cycle", *_COLUMNS, "temperature_C"])
        tests = pd.read_csv(folder / "cycles.csv").query("battery_id == @cell").set_index("cycle")[list(_META_COLUMNS)]
    test_meta, cycles = tests.to_dict(orient="index"), samples["cycle"].to_numpy()
    discharges = []
    for cycle in np.unique(cycles).tolist():
        rows = samples[cycles == cycle]
        time_s, voltage_V, current_A, temperature_C = (rows[name].to_numpy() for name in (*_COLUMNS, "temperature_C"))
        meta = {"cell": cell, "cycle": cycle, "source": NASA_CITATION, **test_meta[cycle]}
        discharges.append(Discharge(time_s, voltage_V, current_A, temperature_C, meta))
    return discharges
