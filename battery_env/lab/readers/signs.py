"""The sign of a current: as words, jumps and falls of the voltage tell, or else the tester's row, or else its user."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from battery_env.arrays import FloatArray, IntArray
from battery_env.lab.readers.columns import Recognised
from battery_env.records import LOAD_SHARE, REST_CURRENT_A, SWITCH_SHARE

#: What passes more than this share of the charge, or changes the voltage by more than this share of its range, is much.
MUCH_SHARE = 0.25
# How plain the sign of the current must be, of -1 to 1.
_CLEAR = 0.5


class _Stretches(NamedTuple):
    """Rows from one switch of the load to the next."""

    begin: IntArray  # the first row
    sign: FloatArray  # of the current, 0 at rest
    before: FloatArray  # the sign of the stretch before
    charge_C: FloatArray  # without a sign
    jump_V: FloatArray  # over the switch
    fall_V: FloatArray  # from then on; 0 at rest, and where the load was reduced, as the voltage recovers then

    @classmethod
    def of(cls, rows: pd.DataFrame) -> _Stretches:
        voltage_V, current_A = rows["voltage"].to_numpy(), rows["current"].to_numpy()
        switch_A = SWITCH_SHARE * np.abs(current_A).max()
        begin = np.union1d([0], np.flatnonzero(np.abs(np.diff(current_A, prepend=current_A[0])) > switch_A))
        end = np.append(begin[1:], len(rows)) - 1
        size_A = np.maximum.reduceat(np.abs(current_A), begin)
        sign = np.where(size_A > switch_A, np.sign(np.add.reduceat(current_A, begin)), 0.0)
        passed_C = np.abs(current_A) * np.diff(rows["time"], prepend=rows["time"].iloc[0]).clip(0.0)
        # the first row may have the voltage from before, and the last one that from behind
        first = np.minimum(begin + 1, end)
        fall_V = voltage_V[first] - voltage_V[np.maximum(end - 1, first)]
        before = np.append(0.0, sign[:-1])
        is_reduced = (before == sign) & (size_A < np.append(0.0, size_A[:-1]))
        fall_V[is_reduced | (sign == 0.0)] = 0.0
        jump_V = voltage_V[first] - voltage_V[np.maximum(begin - 1, 0)]
        return cls(begin, sign, before, np.add.reduceat(passed_C, begin), jump_V, fall_V)


def with_signed_current(rows: pd.DataFrame, known: Recognised, is_negative: bool | None) -> pd.DataFrame:
    """The current of a discharge is positive."""
    current_A = rows["current"]
    rest_A = min(REST_CURRENT_A, LOAD_SHARE * float(current_A.abs().max()))
    flows = current_A.abs() > rest_A
    if not flows.any() or (current_A.abs().max() <= REST_CURRENT_A and np.ptp(rows["voltage"][flows]) <= 0.1):
        raise ValueError("no current flows, or so little that the voltage does not change by 0.1 V: there is no discharge")
    stretches = _Stretches.of(rows)
    towards = rows["state"] if "state" in rows and {1.0, -1.0} <= set(rows["state"]) else 0.0 * current_A
    if (current_A >= -rest_A).all() or (current_A <= rest_A).all():
        if towards.any():
            # a first row at rest may have the current of the step before
            towards = towards.mask((towards == 0.0) & flows).ffill()
            return rows.assign(current=current_A.abs().mask(towards < 0.0, -current_A.abs()))
        _refuse_unsigned(rows, stretches)
    if is_negative is None:
        said = (towards != 0.0) & flows
        words = float((np.sign(current_A) * towards)[said].mean()) if said.any() else 0.0
        jumps = _jumps(rows)
        evidence = [words, jumps, _falls(stretches, bool(jumps))]
        clear = [each for each in evidence if abs(each) > _CLEAR]
        by_tester = known.tester.discharge_is_negative
        if min(clear, default=0.0) < 0.0 < max(clear, default=0.0) or (not clear and by_tester is None):
            raise ValueError(
                "whether the current of a discharge is positive or negative cannot be told, as words, jumps and falls of the "
                f"voltage do not say so clearly ({', '.join(f'{each:.2f}' for each in evidence)}), or contradict each other. "
                "State it: --discharge-is-negative or --discharge-is-positive (Python: discharge_is_negative)"
            )
        is_negative = clear[0] < 0.0 if clear else by_tester
    return rows.assign(current=-current_A) if is_negative else rows


def _jumps(rows: pd.DataFrame) -> float:
    """
    How the voltage jumps against the current where that is switched, -1 to 1; rows next to the switch may mix both sides. A
    current that goes on to fall is that of a voltage that is held.
    """
    voltage_V, current_A = rows["voltage"].to_numpy(), rows["current"].to_numpy()
    jump_A, fall_A = np.diff(current_A), -np.diff(np.abs(current_A))
    held = (current_A[1:] * current_A[:-1] > 0.0) & (fall_A > 0.0) & (np.append(fall_A[1:], 0.0) > 0.0)
    n = np.flatnonzero((np.abs(jump_A) > SWITCH_SHARE * np.abs(current_A).max()) & ~held)
    wide_V = voltage_V[np.minimum(n + 2, len(voltage_V) - 1)] - voltage_V[np.maximum(n - 1, 0)]
    jump_V = voltage_V[n + 1] - voltage_V[n]
    jump_V = np.where(np.abs(wide_V) > np.abs(jump_V), wide_V, jump_V)
    return -float(np.sign(jump_A[n] * jump_V) @ np.abs(jump_A[n]) / np.abs(jump_A[n]).sum()) if len(n) else 0.0


def _falls(stretches: _Stretches, are_switched: bool) -> float:
    """
    How the voltage falls while a current of one sign flows on, -1 to 1: each stretch counts by what it changes, so that a load
    that follows the voltage, as a constant power does, tells as plainly as a constant current. Where loads are switched the
    voltage may recover from one that was larger.
    """
    is_fresh = (stretches.before != stretches.sign) & (stretches.begin > 0)
    fall_V = np.where(is_fresh | (not are_switched), stretches.fall_V, 0.0)
    whole_V = np.abs(fall_V).sum()
    return float(stretches.sign @ fall_V / whole_V) if whole_V > 0.0 else 0.0


def _refuse_unsigned(rows: pd.DataFrame, stretches: _Stretches) -> None:
    """
    Refuse a current of one sign under which the voltage rises for long, while elsewhere it falls; or with which it jumps up
    where a rest ends, while elsewhere it jumps down.
    """
    is_long = stretches.charge_C >= MUCH_SHARE * stretches.charge_C.max()
    is_after_rest = (stretches.before == 0.0) & (stretches.begin > 0) & (stretches.sign != 0.0)
    rise_V = np.where(is_long, -stretches.fall_V, 0.0)
    jump_V = np.where(is_long & is_after_rest, stretches.jump_V, 0.0)
    jumps_both = min(jump_V.max(), -jump_V.min()) > MUCH_SHARE * np.abs(jump_V).max()
    falls_V = stretches.fall_V[stretches.fall_V > 0.0].sum()
    if min(falls_V, rise_V.max()) > MUCH_SHARE * float(np.ptp(rows["voltage"])) or jumps_both:
        row = rows.index[stretches.begin[np.argmax(jump_V if jumps_both else rise_V)]] + 1
        raise ValueError(
            f"the current has no sign: from row {row} on the voltage rises, and elsewhere it falls under a current of the "
            "same sign. Leave out the charges, or name the column whose words tell them from discharges: --columns state=NAME"
        )
