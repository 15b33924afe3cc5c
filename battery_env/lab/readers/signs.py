"""The sign of a current: as words tell, or jumps of the voltage, or else the tester's row, or else its user."""

from __future__ import annotations

import numpy as np
import pandas as pd

from battery_env.lab.readers.columns import Recognised
from battery_env.records import LOAD_SHARE, REST_CURRENT_A, SWITCH_SHARE, switches
from battery_env.records.refusals import RecordError
from battery_env.records.samples import SIGNS

#: What changes the voltage by more than this share of its range is much.
MUCH_SHARE = 0.25
# How plain the sign of the current must be, of -1 to 1.
_CLEAR = 0.5
# What changes the voltage by less says nothing, V.
_LEAST_V = 1e-3


def with_signed_current(rows: pd.DataFrame, known: Recognised, is_negative: bool | None) -> pd.DataFrame:
    """The current of a discharge is positive."""
    current_A = rows["current"]
    rest_A = min(REST_CURRENT_A, LOAD_SHARE * float(current_A.abs().max()))
    flows = current_A.abs() > rest_A
    if not flows.any() or (current_A.abs().max() <= REST_CURRENT_A and np.ptp(rows["voltage"][flows]) <= 0.1):
        raise ValueError("no current flows, or so little that the voltage does not change by 0.1 V: there is no discharge")
    towards = rows["state"] if "state" in rows and {1.0, -1.0} <= set(rows["state"]) else 0.0 * current_A
    if (current_A >= -rest_A).all() or (current_A <= rest_A).all():
        if towards.any():
            # a first row at rest may have the current of the step before
            towards = towards.mask((towards == 0.0) & flows).ffill()
            return rows.assign(current=current_A.abs().mask(towards < 0.0, -current_A.abs()))
        _refuse_unsigned(rows)
    if is_negative is None:
        said = (towards != 0.0) & flows
        words = float(np.sign(current_A * towards)[said].mean()) if said.any() else 0.0
        jumps = _jumps(rows)
        clear = [each for each in (words, jumps) if abs(each) > _CLEAR]
        is_negative = clear[0] < 0.0 if clear else known.tester.discharge_is_negative
        if is_negative is None or min(clear, default=0.0) < 0.0 < max(clear, default=0.0):
            raise RecordError(
                "whether the current of a discharge is positive or negative cannot be told, as words and jumps of the voltage "
                f"do not say so clearly, or contradict each other ({words:.2f}, {jumps:.2f})",
                SIGNS,
            )
    return rows.assign(current=-current_A) if is_negative else rows


def _jumps(rows: pd.DataFrame) -> float:
    """
    How the voltage jumps against the current where that is switched, or falls all along where it is not, -1 to 1. Rows next to
    a switch may mix both sides; where the voltage is held it does not jump.
    """
    voltage_V, current_A = rows["voltage"].to_numpy(), rows["current"].to_numpy()
    n = switches(current_A)
    if not len(n):
        return float(np.sign(current_A.sum()) * (voltage_V[0] - voltage_V[-1]) / max(np.ptp(voltage_V), _LEAST_V))
    jump_V = np.diff(voltage_V)[n]
    wide_V = voltage_V[np.minimum(n + 2, len(rows) - 1)] - voltage_V[np.maximum(n - 1, 0)]
    product = np.diff(current_A)[n] * np.where(np.abs(wide_V) > np.abs(jump_V), wide_V, jump_V)
    return -float(product.sum() / max(np.abs(product).sum(), _LEAST_V * SWITCH_SHARE * np.abs(current_A).max()))


def _refuse_unsigned(rows: pd.DataFrame) -> None:
    """
    Refuse a current of one sign under which the voltage rises, over what it was at rest before, while elsewhere it falls. It
    recovers where a load is reduced.
    """
    voltage_V, size_A = rows["voltage"].to_numpy(), rows["current"].abs().to_numpy()
    begin = np.append(0, switches(size_A) + 1)
    end = np.append(begin[1:], len(rows)) - 1
    most_A = np.maximum.reduceat(size_A, begin)
    before_A = np.append(0.0, most_A[:-1])
    is_rest = most_A <= SWITCH_SHARE * size_A.max()
    # the first row may have the voltage from before, and the last one that from behind
    first = np.where(np.append(False, is_rest[:-1]), begin - 1, np.minimum(begin + 1, end))
    rise_V = voltage_V[np.maximum(end - 1, begin)] - voltage_V[first]
    rise_V[is_rest | (most_A < before_A)] = 0.0
    if min(rise_V.max(), -rise_V[rise_V < 0.0].sum()) > MUCH_SHARE * np.ptp(voltage_V):
        raise ValueError(
            f"the current has no sign: from row {rows.index[begin[np.argmax(rise_V)]] + 1} on the voltage rises, and "
            "elsewhere it falls under a current of the same sign. Leave out the charges, or name the column whose words tell "
            "them from discharges: --columns state=NAME"
        )
