"""The sign of a current: by words, by jumps of the voltage, or else by the tester or the user."""

from __future__ import annotations

import numpy as np
import pandas as pd

from battery_env.lab.readers.columns import TableHeader
from battery_env.records import LOAD_SHARE, REST_CURRENT_A, SWITCH_SHARE, switches
from battery_env.records.refusals import RecordError
from battery_env.records.samples import SIGNS

#: A change of the voltage is large above this share of its range.
LARGE_SHARE = 0.25
# Least magnitude of a clear sign, of 0 to 1.
_CLEAR_SIGN = 0.5
# Smaller changes of the voltage show nothing, V.
_LEAST_V = 1e-3


def with_signed_current(rows: pd.DataFrame, header: TableHeader, is_negative: bool | None) -> pd.DataFrame:
    """Return the rows with a positive current of discharge."""
    current_A = rows["current"]
    rest_A = min(REST_CURRENT_A, LOAD_SHARE * float(current_A.abs().max()))
    is_flowing = current_A.abs() > rest_A
    if not is_flowing.any() or (current_A.abs().max() <= REST_CURRENT_A and np.ptp(rows["voltage"][is_flowing]) <= 0.1):
        raise ValueError("no current flows, or so little that the voltage does not change by 0.1 V: there is no discharge")
    directions = rows["state"] if "state" in rows and {1.0, -1.0} <= set(rows["state"]) else 0.0 * current_A
    if (current_A >= -rest_A).all() or (current_A <= rest_A).all():
        if directions.any():
            # a first row at rest may have the current of the previous step
            directions = directions.mask((directions == 0.0) & is_flowing).ffill()
            return rows.assign(current=current_A.abs().mask(directions < 0.0, -current_A.abs()))
        _refuse_unsigned(rows)
    if is_negative is None:
        is_labelled = (directions != 0.0) & is_flowing
        label_sign = float(np.sign(current_A * directions)[is_labelled].mean()) if is_labelled.any() else 0.0
        jump_sign = _jumps(rows)
        clear_signs = [sign for sign in (label_sign, jump_sign) if abs(sign) > _CLEAR_SIGN]
        is_negative = clear_signs[0] < 0.0 if clear_signs else header.tester.discharge_is_negative
        if is_negative is None or min(clear_signs, default=0.0) < 0.0 < max(clear_signs, default=0.0):
            raise RecordError(
                "whether the current of a discharge is positive or negative cannot be told, as words and jumps of the voltage "
                f"do not say so clearly, or contradict each other ({label_sign:.2f}, {jump_sign:.2f})",
                SIGNS,
            )
    return rows.assign(current=-current_A) if is_negative else rows


def _jumps(rows: pd.DataFrame) -> float:
    """Return the sign of the current, -1 to 1, by jumps of the voltage at switches, or without switches by its fall."""
    voltage_V, current_A = rows["voltage"].to_numpy(), rows["current"].to_numpy()
    n = switches(current_A)
    if not len(n):
        return float(np.sign(current_A.sum()) * (voltage_V[0] - voltage_V[-1]) / max(np.ptp(voltage_V), _LEAST_V))
    jump_V = np.diff(voltage_V)[n]
    # rows next to a switch may mix both sides
    wide_V = voltage_V[np.minimum(n + 2, len(rows) - 1)] - voltage_V[np.maximum(n - 1, 0)]
    product = np.diff(current_A)[n] * np.where(np.abs(wide_V) > np.abs(jump_V), wide_V, jump_V)
    return -float(product.sum() / max(np.abs(product).sum(), _LEAST_V * SWITCH_SHARE * np.abs(current_A).max()))


def _refuse_unsigned(rows: pd.DataFrame) -> None:
    """Refuse a current of one sign if the voltage rises in places, other than after a reduced load, and falls in others."""
    voltage_V, size_A = rows["voltage"].to_numpy(), rows["current"].abs().to_numpy()
    begin = np.append(0, switches(size_A) + 1)
    end = np.append(begin[1:], len(rows)) - 1
    largest_A = np.maximum.reduceat(size_A, begin)
    previous_A = np.append(0.0, largest_A[:-1])
    is_rest = largest_A <= SWITCH_SHARE * size_A.max()
    # the first row may have the voltage before the switch, and the last row the voltage after the next switch
    first = np.where(np.append(False, is_rest[:-1]), begin - 1, np.minimum(begin + 1, end))
    rise_V = voltage_V[np.maximum(end - 1, begin)] - voltage_V[first]
    rise_V[is_rest | (largest_A < previous_A)] = 0.0
    if min(rise_V.max(), -rise_V[rise_V < 0.0].sum()) > LARGE_SHARE * np.ptp(voltage_V):
        raise ValueError(
            f"the current has no sign: from row {rows.index[begin[np.argmax(rise_V)]] + 1} on the voltage rises, and "
            "elsewhere it falls under a current of the same sign. Leave out the charges, or name the column whose words tell "
            "them from discharges: --columns state=NAME"
        )
