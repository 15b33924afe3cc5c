"""The state of charge at the start of a discharge, stated or from the voltage of the rest before the load."""

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

#: A state of charge: a number, or (mean, standard deviation).
InitialSoc = float | tuple[float, float]

#: Largest distances of a full cell at rest below and above the model's voltage, V. Real cells of the bundled kind rest at 4.17
#: to 4.23 V, the model at 4.19 V, and 1 % of the charge is 11 mV: a cell that lacks 4 % or more is noticed. On a flat curve
#: the voltage of this share is the limit below.
BELOW_REST_V, ABOVE_REST_V, LACKING_SHARE = 0.04, 0.06, 0.04
# Time constants of two running means of the voltage at rest, s. Ten times their difference estimates the further relaxation.
_TIME_CONSTANTS_S, _RELAXATION_FACTOR = (20.0, 60.0), 10.0
# Grid of states of charge, and half width of the difference quotient of the voltage.
_SOC_GRID, _SLOPE_SPAN = np.linspace(0.02, 1.0, 1961), 0.01
#: Least error of sensor and model, V.
LEAST_ERROR_V = 0.005

_UNKNOWN = (Finding.of(Reason.START_UNKNOWN),)


class Start(NamedTuple):
    """
    The state of charge at the start of a discharge.

    :param soc: state of charge
    :param sd_soc: its standard deviation
    :param samples: number of samples at rest; 0 for a stated value
    :param findings: why the rest does not determine it, empty if the rest does
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
    """Refuse an invalid state of charge."""
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
    :param mismatch_V: expected error of the model, V; 0.005 V if smaller
    :param voltage_noise_V: standard deviation of the noise of the voltage sensor, V; ``None``: as ``mismatch_V``
    :param dt_s: time between the samples of simulated records, s
    :return: the state of charge. If it has ``findings``, the rest does not determine it, and estimates with it never settle
    :raises ValueError: if the record cannot be used
    """
    stream, cell = Stream.of(record, dt_s), NEW_CELL if cell is None else cell
    load_rows = np.flatnonzero(np.abs(stream.current_A) > REST_CURRENT_A)
    count = int(load_rows[0]) if len(load_rows) else len(stream.time_s)
    if not count:
        return Start(1.0, 0.0, 0, _UNKNOWN)
    fast_V, slow_V = (_running_mean_V(stream, count, time_constant_s) for time_constant_s in _TIME_CONSTANTS_S)
    rest_V = _rest_voltages_V(cell)
    if not (np.diff(rest_V) > 0.0).all():
        return Start(1.0, 0.0, count, _UNKNOWN)
    soc = float(np.interp(fast_V, rest_V, _SOC_GRID))
    soc_range = np.clip([soc - _SLOPE_SPAN, soc + _SLOPE_SPAN], _SOC_GRID[0], _SOC_GRID[-1])
    slope_V = float(np.diff(np.interp(soc_range, _SOC_GRID, rest_V))[0] / np.diff(soc_range)[0])
    model_sd_V = max(LEAST_ERROR_V, mismatch_V)
    sensor_sd_V = model_sd_V if voltage_noise_V is None else voltage_noise_V
    sd_V = np.hypot(np.hypot(sensor_sd_V, model_sd_V), _RELAXATION_FACTOR * (fast_V - slow_V))
    rest_s = float(stream.time_s[count - 1] - stream.time_s[0])
    return Start(soc, float(sd_V / slope_V), count, () if rest_s >= STEADY_S else _UNKNOWN)


def starting_alike(records: Sequence[Record]) -> list[Record]:
    """Return the discharges of a cell that start alike, if they are the majority; records start at load-on."""
    starts = [DischargeStart.of(record) for record in records]
    groups = [[n for n, start in enumerate(starts) if _is_like(start, other)] for other in starts]
    largest = max(groups, key=len, default=[])
    return [records[n] for n in largest] if 2 * len(largest) > len(records) else []


def usual_start(records: Sequence[Record]) -> DischargeStart | None:
    """Return the start of most discharges of a cell, which counts as full; ``None`` if they do not start alike."""
    starts = [DischargeStart.of(record) for record in starting_alike(records)]
    if not starts:
        return None
    voltages_V, charges = [start.voltage_V for start in starts], [start.charge for start in starts if start.charge is not None]
    charge = ChargeBefore._make(np.median(charges, axis=0).tolist()) if len(charges) == len(starts) else None
    return DischargeStart(float(np.mean(voltages_V)), starts[0].current_A, float(np.std(voltages_V)), charge)


def _is_like(start: DischargeStart, other: DischargeStart) -> bool:
    is_like = start.is_of_current(other) and abs(start.voltage_V - other.voltage_V) <= BELOW_REST_V
    return is_like and start.is_charged_like(other, BELOW_REST_V) is not False


def _running_mean_V(stream: Stream, count: int, time_constant_s: float) -> float:
    """Return the exponential moving average of the first voltages."""
    mean_V = float(stream.voltage_V[0])
    for voltage_V, since_s in zip(stream.voltage_V[:count].tolist(), stream.dt_s[:count].tolist(), strict=True):
        mean_V += -np.expm1(-since_s / time_constant_s) * (voltage_V - mean_V)
    return mean_V


def _rest_voltages_V(cell: CellParameters) -> FloatArray:
    """Return the voltage of a cell at rest at each state of charge of the grid."""
    full, empty = (initial_state(cell=cell, soc=soc) for soc in (1.0, 0.0))
    states = empty + _SOC_GRID[:, None] * (full - empty)
    return np.asarray(voltage(states, cell=cell))


@lru_cache(maxsize=64)
def rest_voltage_V(cell: CellParameters, soc: float = 1.0) -> float:
    """Return the voltage of a cell at rest."""
    return float(voltage(initial_state(cell=cell, soc=soc), cell=cell))


def low_rest_voltage_V(cell: CellParameters, soc: float = 1.0) -> float:
    """Return the voltage below which a cell at rest lacks charge."""
    expected_V = rest_voltage_V(cell, soc)
    fall_V = expected_V - rest_voltage_V(cell, 1.0 - LACKING_SHARE)
    # a user who states another charge knows it, and the curve of constants fitted to one load need not rise

    return expected_V - (min(BELOW_REST_V, fall_V) if soc == 1.0 and fall_V > 0.0 else BELOW_REST_V)
