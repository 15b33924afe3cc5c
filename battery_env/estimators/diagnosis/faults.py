"""
What samples show that no cell does: a voltage that does not follow its current, rises, or comes back to that of the start;
currents that dropped out; and steps of the voltage by a charge that was not measured.
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

#: A voltage farther off than so many standard deviations of its noise shows an error of the model, or of the sensor.
MOST_NOISE_SD = 3.0
#: Voltages are rounded, and no model is better than this, V.
RESOLUTION_V = 1e-3
#: A cell that was at rest at the first sample falls by at least half of its ohmic drop within this time, s. So does a cell
#: whose load is switched.
START_WINDOW_S = 20.0
# A change of more than so many standard deviations of the noise is not noise. The median of three samples has this share of
# their noise.
_NOISES, _SMOOTHED_SHARE = 8.0, 0.67
# The noise is that of so many changes of the voltage at most, and at least.
_MOST_CHANGES, _LEAST_CHANGES = 32, 4
# Least resistance of a cell, ohm, up to the q_mobile of a new one; larger cells of the same electrodes have a smaller one. The
# bundled cells show 0.105 ohm and more when the load is switched on, those of the tasks have 0.1 ohm and more.
_LEAST_RESISTANCE_OHM = 0.1
# Upper bound of the ohmic time constant, s: twice the model's.
_FOLLOWS_S = 2.0 * NEW_CELL.to
# Under a steady current the voltage of a cell does not rise by so much, V.
_RISE_V = 0.05
# Smaller changes of the current than this, A, hardly show in the voltage. Where a load falls in such steps, a rise of the
# voltage by this resistance, ohm, says nothing.
_LEAST_JUMP_A, _MOST_RESISTANCE_OHM = 0.05, 0.6
# A cell from which this share of its charge was drawn does not come back to the voltage of its first sample without a charge.
_RECOVERY_SHARE = 0.2
# A change of the voltage is compared with so many before and after.
_BESIDE = 5


class Fault(NamedTuple):
    """What no cell does: its reason, since when, and by how much, in the unit of its text."""

    reason: Reason
    time_s: float
    size: float


class Dropout(NamedTuple):
    """A change of the current for a moment that the voltage does not follow: its span, s, and the charge in doubt, C."""

    begin_s: float
    end_s: float
    charge_C: float


@dataclass
class _Switch:
    """
    A switch of the load that the voltage has not followed yet.

    :param row: the first sample after it
    :param size_A: the change of the current
    :param to_follow_A: the part of it that shows in the ohmic drop
    :param before_V: the voltage before
    :param latest_row: the last row that belongs to it, as one that comes in steps has several
    :param charge_C: what it makes of the charge until then
    """

    row: int
    size_A: float
    to_follow_A: float
    before_V: float
    latest_row: int = 0
    charge_C: float = 0.0


@dataclass(frozen=True)
class SwitchResponse:
    """
    How the voltage responds to the switches of the load.

    :param faults: those that it does not follow, each with the sample that shows it
    :param dropouts: those that were taken back before the voltage followed
    :param switched_s: when the load was switched, beginning with the first sample
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
        """Those of a record, of which voltages may be missing."""
        time_s = record.time_s - record.time_s[0]
        drawn_C = np.append(0.0, np.cumsum(record.current_A[:-1] * np.diff(time_s)))
        is_measured = np.isfinite(record.voltage_V)
        columns = (time_s, record.voltage_V, record.current_A, drawn_C)
        return cls(*(column[is_measured] for column in columns))

    @cached_property
    def smoothed_V(self) -> FloatArray:
        """The median of three voltages, which is no single wild one, at all samples but the last."""
        return np.median(sliding_window_view(np.append(self.voltage_V[0], self.voltage_V), 3), axis=1)

    @cached_property
    def jump_s(self) -> FloatArray:
        """When the current jumped last, at each sample."""
        least_A = np.minimum(SWITCH_SHARE * self._largest_A, _LEAST_JUMP_A)
        jumped = np.append(False, np.abs(np.diff(self.current_A)) > least_A[1:])
        return np.maximum.accumulate(np.where(jumped, self.time_s, self.time_s[0]))

    @cached_property
    def _largest_A(self) -> FloatArray:
        return np.maximum.accumulate(np.abs(self.current_A))

    @cached_property
    def _followed_A(self) -> FloatArray:
        return lagged_current_A(self.time_s, self.current_A, _FOLLOWS_S)

    def noise_V(self, n: int) -> float:
        """What is more than noise, by the changes of the voltage up to a sample; infinite if these are too few to tell."""
        change_V = np.diff(self.voltage_V[max(n - _MOST_CHANGES, 0) : n + 1])
        if len(change_V) < _LEAST_CHANGES:
            return inf
        return _NOISES * _SMOOTHED_SHARE * float(np.median(np.abs(change_V - np.median(change_V)))) / (0.6745 * sqrt(2.0))

    def least_resistance_ohm(self, q_mobile: float, r_o: float) -> float:
        """
        The least that a cell can show: of other cells, of larger ones, and of this one, by its estimate, which a fault may
        have spoiled, or by its fall at the start.
        """
        count = max(int(np.searchsorted(self.time_s, START_WINDOW_S, side="right")), 2)
        most_A, fall_V = self.current_A[:count].max(), self.voltage_V[0] - self.voltage_V[:count].min()
        own_ohm = max(float(fall_V / most_A), r_o) if most_A > 0.0 else r_o
        return max(min(_LEAST_RESISTANCE_OHM, _LEAST_RESISTANCE_OHM * NEW_CELL.q_mobile / q_mobile, own_ohm), 0.0)

    def response(self, resistance_ohm: float) -> SwitchResponse:
        """How the voltage responds to the switches of the load, for a cell of some resistance at least."""
        time_s, current_A, last = self.time_s, self.current_A, len(self.time_s) - 1
        change_A = np.diff(current_A, prepend=current_A[0])
        # the last row alone may be wild
        rows = np.flatnonzero(np.abs(change_A[:last]) > SWITCH_SHARE * self._largest_A[:last])
        faults: list[tuple[int, Fault]] = []
        dropouts: list[Dropout] = []
        switched_s, switch = [float(time_s[0])], None
        for row in [*rows.tolist(), last]:
            if switch is not None:
                judged = min(row, int(np.searchsorted(time_s, time_s[switch.row] + START_WINDOW_S, side="right")))
                is_followed = self._follows(switch, judged, resistance_ohm)
                is_over = judged < row or row == last
                if is_over and not is_followed:
                    faults.append((judged, Fault(Reason.NOT_FOLLOWED, float(time_s[switch.row]), switch.size_A)))
                switch = None if is_over or is_followed else switch
            if row == last:
                break
            if switch is None:
                # the last row before a switch may already have the voltage after it
                before_V = self.smoothed_V[max(row - 2, 0) : row]
                switch = _Switch(row, 0.0, 0.0, float(before_V.max() if change_A[row] > 0.0 else before_V.min()))
                switched_s.append(float(time_s[row]))
            else:
                switch.charge_C += switch.size_A * float(time_s[row] - time_s[switch.latest_row])
            if switch.size_A * change_A[row] < 0.0:
                # taken back before the voltage followed: for the voltage there was no switch
                end = int(np.searchsorted(time_s, time_s[row + 1] + START_WINDOW_S, side="right"))
                end_s = float(time_s[end]) if end <= last else inf
                dropouts.append(Dropout(float(time_s[switch.row]), end_s, abs(switch.charge_C)))
                switch = None
            else:
                # steps the same way are one switch: a mean over an interval shows a switch as two
                switch.size_A, switch.latest_row = switch.size_A + float(change_A[row]), row
                # the ohmic drop must follow little after a pulse too short for it to build up
                to_follow_A = float(current_A[row] - self._followed_A[row - 1])
                switch.to_follow_A = max(min(to_follow_A, max(switch.size_A, 0.0)), min(switch.size_A, 0.0))
        return SwitchResponse(faults, dropouts, np.array(switched_s))

    def _follows(self, switch: _Switch, row: int, resistance_ohm: float) -> bool:
        """
        Whether the voltage follows a switch by half of the least ohmic drop that it can have at some row, or that drop is no
        more than noise.
        """
        since_s = float(self.time_s[row] - self.time_s[switch.row])
        drop_V = -resistance_ohm * switch.to_follow_A * expm1(-since_s / _FOLLOWS_S)
        # some loggers write a voltage a row later than its current: the first one after a switch may belong before it
        voltage_V = self.voltage_V[switch.row : row + 1]
        followed_V = switch.before_V - float(voltage_V.min() if drop_V > 0.0 else voltage_V.max())
        return drop_V == 0.0 or followed_V / drop_V >= 0.5 or abs(drop_V) <= self.noise_V(row + 1)

    def rise(self) -> tuple[int, Fault] | None:
        """The first rise of the voltage under a current that has been steady since long before."""
        rows, voltage_V, time_s = np.arange(2, len(self.smoothed_V)), self.smoothed_V, self.time_s
        before = np.minimum(np.searchsorted(time_s, time_s[rows] - START_WINDOW_S) - 1, rows - 2)
        rows, before = rows[before >= 0], before[before >= 0]
        fallen_A = np.maximum(self.current_A[before] - self.current_A[rows], 0.0)
        rise_V = voltage_V[rows] - voltage_V[before] - _MOST_RESISTANCE_OHM * fallen_A
        is_rise = (rise_V > _RISE_V) & (time_s[before] - self.jump_s[rows] >= STEADY_S)
        for n in np.flatnonzero(is_rise).tolist():
            if rise_V[n] > self.noise_V(int(rows[n]) + 1):
                return int(rows[n]), Fault(Reason.RISES, float(time_s[before[n]]), float(rise_V[n]))
        return None

    def recovery(
        self, start_V: float, most_q_C: float, resistance_ohm: float, switched_s: FloatArray
    ) -> tuple[int, Fault] | None:
        """
        The first return to the voltage of the start though a share of the largest ``q_mobile`` was drawn. Under a steady load
        the voltage at rest is higher by the ohmic drop at least.
        """
        rows = np.flatnonzero(self.drawn_C[1:] > _RECOVERY_SHARE * most_q_C)
        if not len(rows):
            return None
        current_A, voltage_V = self.current_A[rows], self.smoothed_V[rows]
        drop_V = resistance_ohm * np.maximum(current_A, 0.0)
        since_s = self.time_s[rows] - switched_s[np.searchsorted(switched_s, self.time_s[rows], side="right") - 1]
        rest_V = voltage_V + np.where(since_s > START_WINDOW_S, drop_V, 0.0)
        # on a flat curve, or with a smaller drop than that, it never was much lower; a charge that is seen raises it
        is_high = rest_V > max(start_V, float(voltage_V[0] + drop_V[0]) + _RISE_V)
        recovered = rows[is_high & (np.minimum(current_A, self._followed_A[rows]) >= -REST_CURRENT_A)]
        if not len(recovered):
            return None
        row = int(recovered[0])
        return row, Fault(Reason.RECOVERED, float(self.time_s[row]), float(self.drawn_C[row + 1]))

    def missed_C(self) -> float:
        """
        The charge that steps of the voltage show, and the current does not. Under a steady load the voltage changes from
        sample to sample as it did before and does afterwards, or in proportion to the time between them. A step beyond that
        and noise is a charge that rows were lost with, together with their time.
        """
        count = 2 * _BESIDE + 1
        rows = np.arange(count, len(self.time_s))
        is_steady = self.time_s[rows - count] - self.jump_s[rows - 1] >= STEADY_S
        rows = rows[is_steady & (self.current_A[rows] > REST_CURRENT_A)]
        if not len(rows):
            return 0.0
        change_V, interval_s = (
            sliding_window_view(np.diff(each), count)[rows - count] for each in (self.voltage_V, self.time_s)
        )
        usual_V, by_time_V = np.median(change_V, axis=1), np.median(change_V / interval_s, axis=1) * interval_s[:, _BESIDE]
        low_V, high_V = np.minimum(usual_V, by_time_V), np.maximum(usual_V, by_time_V)
        # alone and with either neighbour, which takes a single wild voltage back
        alone_V = change_V[:, _BESIDE]
        sides_V = [alone_V, *(alone_V + change_V[:, n] - usual_V for n in (_BESIDE - 1, _BESIDE + 1))]
        fall_V, rise_V = low_V - np.max(sides_V, axis=0), high_V - np.min(sides_V, axis=0)
        step_V = np.where(fall_V > 0.0, fall_V, np.minimum(rise_V, 0.0))
        missed_C = 0.0
        for n in np.flatnonzero(np.abs(step_V) > _NOISES * RESOLUTION_V).tolist():
            row, span_s = int(rows[n]), float(interval_s[n].sum())
            if abs(step_V[n]) > sqrt(2.0) / _SMOOTHED_SHARE * self.noise_V(row):
                beside_V, beside_s = float(change_V[n].sum() - alone_V[n]), span_s - float(interval_s[n, _BESIDE])
                fall_V_per_s = max(-beside_V / beside_s, RESOLUTION_V / span_s)
                missed_C = hypot(missed_C, float(self.current_A[row] * step_V[n]) / fall_V_per_s)
        return missed_C
