"""The state of charge that a discharge starts with: stated, or told from the voltage of the rest before the load."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import NEW_CELL, CellParameters, initial_state, voltage
from battery_env.estimates import Finding
from battery_env.estimates.findings import Reason, reason_of
from battery_env.records import REST_CURRENT_A, STEADY_S, ChargeBefore, DischargeStart, Record, Stream

#: What a state of charge can be given as: a number, or (mean, standard deviation).
InitialSoc = float | tuple[float, float]

#: A full cell may rest so far below and above the model's voltage, V. Real ones of the bundled kind rest at 4.17 to 4.23 V,
#: the model's at 4.19 V, which falls by 11 mV with each percent of the charge: a cell that lacks 4 % or more is noticed. Where
#: that share makes less, on a flat curve, a cell may rest no farther below.
BELOW_REST_V, ABOVE_REST_V, LACKING_SHARE = 0.04, 0.06, 0.04
# Two running means of the resting voltage, over 20 s and 60 s. It is expected to move on by ten times their difference.
_MEMORIES_S, _STILL_TO_COME = (20.0, 60.0), 10.0
# States of charge to choose from, where it is told from a voltage, and how far to each side the slope of the voltage is taken.
_SOC_GRID, _SLOPE_SPAN = np.linspace(0.02, 1.0, 1961), 0.01
#: Sensor and model are not taken to be better than this where nothing is stated of them, V.
LEAST_ERROR_V = 0.005

_UNKNOWN = (Finding.of(Reason.START_UNKNOWN),)


class Start(NamedTuple):
    """
    How a discharge starts.

    :param soc: state of charge
    :param sd_soc: its standard deviation
    :param samples: how many samples at rest it was told from; 0 where it was stated
    :param findings: why it could not be told, empty if it could
    """

    soc: float
    sd_soc: float
    samples: int = 0
    findings: tuple[Finding, ...] = ()

    @property
    def reason(self) -> str:
        """The findings as one text."""
        return reason_of(self.findings)


def check_initial_soc(initial_soc: InitialSoc) -> tuple[float, float]:
    """Refuse what is no state of charge."""
    try:
        mean, sd = (float(initial_soc), 0.0) if np.ndim(initial_soc) == 0 else map(float, initial_soc)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        mean = sd = np.nan
    if not (_SOC_GRID[0] <= mean <= 1.0 and 0.0 <= sd < 1.0):
        raise ValueError(
            f"initial_soc is a state of charge within 0.02 .. 1, or (mean, standard deviation), got {initial_soc!r}. "
            "battery_env.soc_from_rest tells both from the rest before the load."
        )
    return mean, sd


def soc_from_rest(
    record: Record,
    cell: CellParameters | None = None,
    mismatch_V: float = 0.0,
    voltage_noise_V: float | None = None,
    dt_s: float = 1.0,
) -> Start:
    """
    Compute the state of charge at the start of a record from the voltage of at least a minute of rest before the load, with
    the open-circuit voltage of the model. A voltage that still relaxes widens the standard deviation.

    .. code-block:: python

      start = soc_from_rest(record, mismatch_V=0.05)
      estimate = LeastSquares(mismatch_V=0.05, initial_soc=(start.soc, start.sd_soc)).estimate(record)

    :param record: one discharge, with the rest before its load
    :param cell: constants of the model; ``None``: the new cell's
    :param mismatch_V: error to expect of the model, V; at least 0.005 V are taken
    :param voltage_noise_V: standard deviation of the noise of the voltage sensor, V; ``None``: as ``mismatch_V``
    :param dt_s: time between the samples of simulated records, whose current is taken as it is, s
    :return: the state of charge. If it has ``findings``, the rest does not tell it, and no estimate that relies on it is
        settled
    :raises ValueError: if the record cannot be used
    """
    stream, cell = Stream.of(record, dt_s), NEW_CELL if cell is None else cell
    loaded = np.flatnonzero(np.abs(stream.current_A) > REST_CURRENT_A)
    count = int(loaded[0]) if len(loaded) else len(stream.time_s)
    if not count:
        return Start(1.0, 0.0, 0, _UNKNOWN)
    fast_V, slow_V = (_running_mean_V(stream, count, memory_s) for memory_s in _MEMORIES_S)
    rest_V = _rest_voltages_V(cell)
    if not (np.diff(rest_V) > 0.0).all():
        return Start(1.0, 0.0, count, _UNKNOWN)
    soc = float(np.interp(fast_V, rest_V, _SOC_GRID))
    around = np.clip([soc - _SLOPE_SPAN, soc + _SLOPE_SPAN], _SOC_GRID[0], _SOC_GRID[-1])
    slope_V = float(np.diff(np.interp(around, _SOC_GRID, rest_V))[0] / np.diff(around)[0])
    model_sd_V = max(LEAST_ERROR_V, mismatch_V)
    sensor_sd_V = model_sd_V if voltage_noise_V is None else voltage_noise_V
    sd_V = np.hypot(np.hypot(sensor_sd_V, model_sd_V), _STILL_TO_COME * (fast_V - slow_V))
    rest_s = float(stream.time_s[count - 1] - stream.time_s[0])
    return Start(soc, float(sd_V / slope_V), count, () if rest_s >= STEADY_S else _UNKNOWN)


def starting_alike(records: Sequence[Record]) -> list[Record]:
    """Those of some discharges of a cell, each a record from load-on, that start alike, if these are most of them."""
    starts = [DischargeStart.of(record) for record in records]
    groups = [[n for n, each in enumerate(starts) if _is_like(each, other)] for other in starts]
    largest = max(groups, key=len, default=[])
    return [records[n] for n in largest] if 2 * len(largest) > len(records) else []


def usual_start(records: Sequence[Record]) -> DischargeStart | None:
    """How most discharges of a cell start, which is what counts as full of it; ``None`` if they do not start alike."""
    starts = [DischargeStart.of(record) for record in starting_alike(records)]
    if not starts:
        return None
    voltages_V, charges = [each.voltage_V for each in starts], [each.charge for each in starts if each.charge is not None]
    charge = ChargeBefore._make(np.median(charges, axis=0).tolist()) if len(charges) == len(starts) else None
    return DischargeStart(float(np.mean(voltages_V)), starts[0].current_A, float(np.std(voltages_V)), charge)


def _is_like(start: DischargeStart, other: DischargeStart) -> bool:
    is_like = start.is_of_current(other) and abs(start.voltage_V - other.voltage_V) <= BELOW_REST_V
    return is_like and start.is_charged_like(other, BELOW_REST_V) is not False


def _running_mean_V(stream: Stream, count: int, memory_s: float) -> float:
    """Average the first voltages, each the less the longer it is over."""
    mean_V = float(stream.voltage_V[0])
    for voltage_V, since_s in zip(stream.voltage_V[:count].tolist(), stream.dt_s[:count].tolist(), strict=True):
        mean_V += -np.expm1(-since_s / memory_s) * (voltage_V - mean_V)
    return mean_V


def _rest_voltages_V(cell: CellParameters) -> FloatArray:
    """Return the voltage of a cell at rest at each state of charge of the grid."""
    full, empty = (initial_state(cell=cell, soc=soc) for soc in (1.0, 0.0))
    states = empty + _SOC_GRID[:, None] * (full - empty)
    return np.asarray(voltage(states, cell=cell))


@lru_cache(maxsize=64)
def rest_voltage_V(cell: CellParameters, soc: float = 1.0) -> float:
    """The voltage of a cell at rest."""
    return float(voltage(initial_state(cell=cell, soc=soc), cell=cell))


def low_rest_voltage_V(cell: CellParameters, soc: float = 1.0) -> float:
    """The voltage below which a cell at rest lacks charge."""
    expected_V = rest_voltage_V(cell, soc)
    fall_V = expected_V - rest_voltage_V(cell, 1.0 - LACKING_SHARE)
    # another charge was stated by whoever knows it, and constants of one load need not have a curve that rises
    return expected_V - (min(BELOW_REST_V, fall_V) if soc == 1.0 and fall_V > 0.0 else BELOW_REST_V)
