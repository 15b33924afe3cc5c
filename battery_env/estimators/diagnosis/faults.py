"""
Faults that no cell has: a voltage that does not follow its current, rises, or returns to its start; currents that dropped out;
and steps of the voltage by a charge that was not measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import expm1, hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import NEW_CELL
from battery_env.estimates.findings import Reason
from battery_env.records import REST_CURRENT_A, STEADY_S, SWITCH_SHARE, Samples
from battery_env.records.load import lagged_current_A

#: A deviation of more than this many standard deviations of the noise is an error of the model, or of the sensor.
MOST_NOISE_SD = 3.0
#: Testers round voltages to about this, and no model is more exact, V.
RESOLUTION_V = 1e-3
#: After load-on, or a switch of the load, the voltage changes by at least half of the ohmic drop within this time, s.
START_WINDOW_S = 20.0
# A change of more than this many standard deviations of the noise is no noise. The median of three samples has this share of
# their noise.
_NOISES, _SMOOTHED_SHARE = 8.0, 0.67
# Largest and least number of changes of the voltage that give its noise.
_MOST_CHANGES, _LEAST_CHANGES = 32, 4
# Least resistance of a cell, ohm, up to a new cell's q_mobile; the resistance of larger cells of the same electrodes is
# smaller. Bundled cells show at least 0.105 ohm at load-on, and cells of the tasks have at least 0.1 ohm.
_LEAST_RESISTANCE_OHM = 0.1
# Upper bound of the ohmic time constant, s: twice the model's.
_OHMIC_TIME_CONSTANT_S = 2.0 * NEW_CELL.to
# Under a steady current the voltage of a cell rises by less than this, V.
_RISE_V = 0.05
# Changes of the current below this, A, hardly show in the voltage. A load that falls in such steps may raise the voltage by
# this resistance, ohm.
_LEAST_JUMP_A, _MOST_RESISTANCE_OHM = 0.05, 0.6
# After this share of its charge a cell does not return to the voltage of its first sample without a charge.
_RECOVERY_SHARE = 0.2
# Half width, in samples, of the window of a step of the voltage.
_HALF_WINDOW = 5


class Fault(NamedTuple):
    """A fault: its reason, its begin, s, and its size, in the unit of its text."""

    reason: Reason
    time_s: float
    size: float


class Dropout(NamedTuple):
    """A momentary change of the current that the voltage does not follow: its span, s, and its charge, C."""

    begin_s: float
    end_s: float
    charge_C: float


@dataclass
class _Switch:
    """
    A switch of the load that the voltage has not followed yet.

    :param row: the first sample after the switch
    :param size_A: the change of the current
    :param ohmic_A: the change of the current in the ohmic drop
    :param reference_V: the voltage before the switch
    :param latest_row: the last row of the switch, which may come in steps
    :param charge_C: charge of the change of the current until then
    """

    row: int
    size_A: float
    ohmic_A: float
    reference_V: float
    latest_row: int = 0
    charge_C: float = 0.0


@dataclass(frozen=True)
class SwitchResponse:
    """
    The response of the voltage to the switches of the load.

    :param faults: switches that the voltage does not follow, each with the sample that shows it
    :param dropouts: switches that the load took back before the voltage followed
    :param switched_s: times of the switches, beginning with the first sample
    """

    faults: list[tuple[int, Fault]]
    dropouts: list[Dropout]
    switched_s: FloatArray


@dataclass(frozen=True)
class MeasuredSamples:
    """Samples whose voltage was measured, with the time since the first sample and the charge drawn until then."""

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    drawn_C: FloatArray

    @classmethod
    def of(cls, record: Samples) -> MeasuredSamples:
        """Return the samples of a record that have a voltage."""
        time_s = record.time_s - record.time_s[0]
        drawn_C = np.append(0.0, np.cumsum(record.current_A[:-1] * np.diff(time_s)))
        is_measured = np.isfinite(record.voltage_V)
        columns = (time_s, record.voltage_V, record.current_A, drawn_C)
        return cls(*(column[is_measured] for column in columns))

    @cached_property
    def smoothed_V(self) -> FloatArray:
        """The median of three voltages, which ignores a single outlier, at all samples except the last."""
        return np.median(sliding_window_view(np.append(self.voltage_V[0], self.voltage_V), 3), axis=1)

    @cached_property
    def jump_s(self) -> FloatArray:
        """Time of the last jump of the current, at each sample."""
        least_A = np.minimum(SWITCH_SHARE * self._largest_A, _LEAST_JUMP_A)
        is_jump = np.append(False, np.abs(np.diff(self.current_A)) > least_A[1:])
        return np.maximum.accumulate(np.where(is_jump, self.time_s, self.time_s[0]))

    @cached_property
    def _largest_A(self) -> FloatArray:
        return np.maximum.accumulate(np.abs(self.current_A))

    @cached_property
    def _lagged_A(self) -> FloatArray:
        return lagged_current_A(self.time_s, self.current_A, _OHMIC_TIME_CONSTANT_S)

    def noise_V(self, n: int) -> float:
        """Return the largest change that may be noise, from the changes up to a sample; infinite if these are too few."""
        change_V = np.diff(self.voltage_V[max(n - _MOST_CHANGES, 0) : n + 1])
        if len(change_V) < _LEAST_CHANGES:
            return inf
        return _NOISES * _SMOOTHED_SHARE * float(np.median(np.abs(change_V - np.median(change_V)))) / (0.6745 * sqrt(2.0))

    def least_resistance_ohm(self, q_mobile: float, r_o: float) -> float:
        """
        Return the least resistance of the cell: that of other cells, of larger cells, or of this cell, by its estimate, which
        a fault may spoil, or by its fall at the start.
        """
        count = max(int(np.searchsorted(self.time_s, START_WINDOW_S, side="right")), 2)
        largest_A, fall_V = self.current_A[:count].max(), self.voltage_V[0] - self.voltage_V[:count].min()
        cell_ohm = max(float(fall_V / largest_A), r_o) if largest_A > 0.0 else r_o
        return max(min(_LEAST_RESISTANCE_OHM, _LEAST_RESISTANCE_OHM * NEW_CELL.q_mobile / q_mobile, cell_ohm), 0.0)

    def response(self, resistance_ohm: float) -> SwitchResponse:
        """Return the response of the voltage to the switches of the load, for a cell of at least this resistance."""
        time_s, current_A, last = self.time_s, self.current_A, len(self.time_s) - 1
        change_A = np.diff(current_A, prepend=current_A[0])
        # the last row may be an outlier
        rows = np.flatnonzero(np.abs(change_A[:last]) > SWITCH_SHARE * self._largest_A[:last])
        faults: list[tuple[int, Fault]] = []
        dropouts: list[Dropout] = []
        switched_s, switch = [float(time_s[0])], None
        for row in [*rows.tolist(), last]:
            if switch is not None:
                judged_row = min(row, int(np.searchsorted(time_s, time_s[switch.row] + START_WINDOW_S, side="right")))
                is_followed = self._is_followed(switch, judged_row, resistance_ohm)
                is_over = judged_row < row or row == last
                if is_over and not is_followed:
                    faults.append((judged_row, Fault(Reason.NOT_FOLLOWED, float(time_s[switch.row]), switch.size_A)))
                switch = None if is_over or is_followed else switch
            if row == last:
                break
            if switch is None:
                # the last row before a switch may already have the voltage after it
                reference_V = self.voltage_V[max(row - 2, 0) : row]
                switch = _Switch(row, 0.0, 0.0, float(reference_V.max() if change_A[row] > 0.0 else reference_V.min()))
                switched_s.append(float(time_s[row]))
            else:
                switch.charge_C += switch.size_A * float(time_s[row] - time_s[switch.latest_row])
            if switch.size_A * change_A[row] < 0.0:
                # the load took the switch back before the voltage followed: for the voltage there was no switch
                end = int(np.searchsorted(time_s, time_s[row + 1] + START_WINDOW_S, side="right"))
                end_s = float(time_s[end]) if end <= last else inf
                dropouts.append(Dropout(float(time_s[switch.row]), end_s, abs(switch.charge_C)))
                switch = None
            else:
                # steps of one sign are one switch: the mean current of an interval splits a switch in two steps
                switch.size_A, switch.latest_row = switch.size_A + float(change_A[row]), row
                # after a pulse that is too short the ohmic drop has little to follow
                ohmic_A = float(current_A[row] - self._lagged_A[row - 1])
                switch.ohmic_A = max(min(ohmic_A, max(switch.size_A, 0.0)), min(switch.size_A, 0.0))
        return SwitchResponse(faults, dropouts, np.array(switched_s))

    def _is_followed(self, switch: _Switch, row: int, resistance_ohm: float) -> bool:
        """
        Whether the voltage at a row has followed a switch by half of the least ohmic drop, or this drop is no more than noise.
        """
        since_s = float(self.time_s[row] - self.time_s[switch.row])
        drop_V = -resistance_ohm * switch.ohmic_A * expm1(-since_s / _OHMIC_TIME_CONSTANT_S)
        # some loggers write a voltage a row later than its current: the first voltage after a switch may be from before
        voltage_V = self.voltage_V[switch.row : row + 1]
        response_V = switch.reference_V - float(voltage_V.min() if drop_V > 0.0 else voltage_V.max())
        return drop_V == 0.0 or response_V / drop_V >= 0.5 or abs(drop_V) <= self.noise_V(row + 1)

    def rise(self) -> tuple[int, Fault] | None:
        """Return the first rise of the voltage under a current that has long been steady, with its sample."""
        rows, voltage_V, time_s = np.arange(2, len(self.smoothed_V)), self.smoothed_V, self.time_s
        earlier = np.minimum(np.searchsorted(time_s, time_s[rows] - START_WINDOW_S) - 1, rows - 2)
        rows, earlier = rows[earlier >= 0], earlier[earlier >= 0]
        drop_A = np.maximum(self.current_A[earlier] - self.current_A[rows], 0.0)
        rise_V = voltage_V[rows] - voltage_V[earlier] - _MOST_RESISTANCE_OHM * drop_A
        is_rise = (rise_V > _RISE_V) & (time_s[earlier] - self.jump_s[rows] >= STEADY_S)
        for n in np.flatnonzero(is_rise).tolist():
            if rise_V[n] > self.noise_V(int(rows[n]) + 1):
                return int(rows[n]), Fault(Reason.RISES, float(time_s[earlier[n]]), float(rise_V[n]))
        return None

    def recovery(
        self, start_V: float, largest_q_C: float, resistance_ohm: float, switched_s: FloatArray
    ) -> tuple[int, Fault] | None:
        """
        Return the first return to the voltage of the start after a share of the largest ``q_mobile`` was drawn. Under a steady
        load the voltage at rest is higher by at least the ohmic drop.
        """
        rows = np.flatnonzero(self.drawn_C[1:] > _RECOVERY_SHARE * largest_q_C)
        if not len(rows):
            return None
        current_A, voltage_V = self.current_A[rows], self.smoothed_V[rows]
        drop_V = resistance_ohm * np.maximum(current_A, 0.0)
        since_s = self.time_s[rows] - switched_s[np.searchsorted(switched_s, self.time_s[rows], side="right") - 1]
        rest_V = voltage_V + np.where(since_s > START_WINDOW_S, drop_V, 0.0)
        # on a flat curve, or with a small drop, the voltage never was much lower; a recorded charge raises it
        is_high = rest_V > max(start_V, float(voltage_V[0] + drop_V[0]) + _RISE_V)
        recovery_rows = rows[is_high & (np.minimum(current_A, self._lagged_A[rows]) >= -REST_CURRENT_A)]
        if not len(recovery_rows):
            return None
        row = int(recovery_rows[0])
        return row, Fault(Reason.RECOVERED, float(self.time_s[row]), float(self.drawn_C[row + 1]))

    def missed_C(self) -> float:
        """
        Return the charge of rows that were lost together with their time. Under a steady load the voltage changes from sample
        to sample as before and after, or in proportion to the interval. A step beyond these and noise is the lost charge.
        """
        count = 2 * _HALF_WINDOW + 1
        rows = np.arange(count, len(self.time_s))
        is_steady = self.time_s[rows - count] - self.jump_s[rows - 1] >= STEADY_S
        rows = rows[is_steady & (self.current_A[rows] > REST_CURRENT_A)]
        if not len(rows):
            return 0.0
        change_V, interval_s = (
            sliding_window_view(np.diff(column), count)[rows - count] for column in (self.voltage_V, self.time_s)
        )
        usual_V, rate_V_per_s = np.median(change_V, axis=1), np.median(change_V / interval_s, axis=1)
        by_time_V = rate_V_per_s * interval_s[:, _HALF_WINDOW]
        low_V, high_V = np.minimum(usual_V, by_time_V), np.maximum(usual_V, by_time_V)
        # the step and its sums with either neighbour, which cancel a single outlier
        single_V = change_V[:, _HALF_WINDOW]
        candidates_V = [single_V, *(single_V + change_V[:, n] - usual_V for n in (_HALF_WINDOW - 1, _HALF_WINDOW + 1))]
        fall_V, rise_V = low_V - np.max(candidates_V, axis=0), high_V - np.min(candidates_V, axis=0)
        step_V = np.where(fall_V > 0.0, fall_V, np.minimum(rise_V, 0.0))
        missed_C = 0.0
        for n in np.flatnonzero(np.abs(step_V) > _NOISES * RESOLUTION_V).tolist():
            row, span_s = int(rows[n]), float(interval_s[n].sum())
            if abs(step_V[n]) > sqrt(2.0) / _SMOOTHED_SHARE * self.noise_V(row):
                rest_V, rest_s = float(change_V[n].sum() - single_V[n]), span_s - float(interval_s[n, _HALF_WINDOW])
                fall_V_per_s = max(-rest_V / rest_s, RESOLUTION_V / span_s)
                missed_C = hypot(missed_C, float(self.current_A[row] * step_V[n]) / fall_V_per_s)
        return missed_C
