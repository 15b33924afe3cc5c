"""
What a Kalman filter is told, and what it remembers of a discharge: tables with named columns, which compiled code (numba)
reads and writes in place. A single filter has tables of one row, a batch one row a cell.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from battery_env.electrochemistry import NEW_CELL, STATE_SIZE
from battery_env.estimators.gaps import HABIT

#: A row of a table, whose columns numba knows and type checkers do not.
Row = Any

#: What a filter estimates: ``q_mobile`` (C), ``r_o`` (ohm) and the offset of the voltage (V).
Q, R, OFFSET = range(3)
#: As many voltages are kept.
KEPT = 32


class Settings(NamedTuple):
    """
    What a filter is told, with pairs for ``q_mobile`` and ``r_o``.

    :param dt_s: longest time step of the model, s
    :param thermal: whether the temperature of the model moves
    :param noise_V2: variance of the voltage noise, V^2
    :param mismatch_V2: variance of the error of the model, V^2
    :param searched: whether each is searched for
    :param variance: of each before the discharge, 0 where it is held, C^2 and ohm^2
    :param growth: of the variance of each, C^2/s and ohm^2/s
    :param offset_growth: of the variance of the offset, V^2/s
    :param bounds: where each stays, C and ohm
    :param carried: mean and standard deviation of each from an earlier discharge; zeros where none was given
    :param scale_sd: standard deviations of what scales each and does not show in the voltage, as shares
    :param cell_q_mobile: of the model's cell, C
    """

    dt_s: float
    thermal: bool
    noise_V2: float
    mismatch_V2: float
    searched: tuple[bool, bool]
    variance: tuple[float, float]
    growth: tuple[float, float]
    offset_growth: float
    bounds: tuple[tuple[float, float], tuple[float, float]]
    carried: tuple[tuple[float, float], tuple[float, float]]
    scale_sd: tuple[float, float]
    cell_q_mobile: float


def _table(columns: str | list[tuple[Any, ...]]) -> np.dtype[np.void]:
    """The type of a row: numbers by their names, or names with types."""
    return np.dtype([(name, "f8") for name in columns.split()] if isinstance(columns, str) else columns, align=True)


#: One sample of one cell.
SAMPLE = _table("voltage_V current_A dt_s temperature_K")

#: What is said after a sample; ``code`` is one of :class:`~battery_env.estimators.monitor.Verdict`.
ESTIMATE = _table([("q_mobile", "f8"), ("r_o", "f8"), ("sd", "f8", 2), ("code", "i8")])

# Sums over the charge drawn, of the derivative of the voltage by q_mobile (V) and of products with that by r_o (V^2/C, V A,
# A^2 C), and that charge (C)
_INFORMATION = _table("q qq qr rr charge_C")

#: One filter of a bank, with a model of its own at its estimate.
FILTER = _table(
    [
        ("state", "f8", (1, STATE_SIZE)),
        ("tangents", "f8", (1, 2, STATE_SIZE)),  # derivatives of the state with respect to q_mobile and r_o
        ("mean", "f8", 3),
        ("covariance", "f8", (3, 3)),
        ("log_weight", "f8"),  # -inf: given up
        ("shown_V2", "f8"),  # variance of the noise that the last innovation showed
        ("innovation", "f8"),  # the last one over its standard deviation, within the gate
        ("expected_V", "f8"),  # voltage of the model at the last sample before it was taken in, with the offset
        ("told", _INFORMATION),
    ]
)

# What a bank remembers beside its filters.
_BANK = _table(
    [
        # after the last sample: moments of the mixture of all filters, the standard deviation of q_mobile that an error of the
        # model leaves which is common to the discharge, the voltage that was expected, and whether the model cell has one
        ("mean", "f8", 2),
        ("sd", "f8", 2),
        ("common_sd_q", "f8"),
        ("expected_V", "f8"),
        ("has_voltage", "b1"),
        # of innovations: the noise that they showed in the mean; the last ones, averaged; the sum of the products of each one
        # with those before it, its variance, and how many standard deviations it has been above 0 at most: infinite once
        # something else has shown that the filter does not follow its cell
        ("noise_V2", "f8"),
        ("last", "f8"),
        ("products", "f8"),
        ("variance", "f8"),
        ("trend_sd", "f8"),
        # r_o stays in this range unless an earlier estimate was wrong. q_mobile has none: the error of the model moves it at
        # the knee
        ("least_r", "f8"),
        ("most_r", "f8"),
        # prior variance of the offset, which grows with time
        ("offset_V2", "f8"),
    ]
)

# The start: the first sample, and within the start window the largest current and the least voltage.
_START = _table([("at_rest", "b1"), *((name, "f8") for name in ("first_V", "first_A", "most_A", "least_V"))])

# The two voltages before the one at hand, and time and current of the last of them: the middle one of three is examined.
_BEFORE = _table("voltage_2_V voltage_1_V time_1_s current_1_A")

# The last sample that was examined, the current that the ohmic drop stands for then, the largest magnitude of the current, and
# when the current last jumped.
_EXAMINED = _table(
    [("count", "i8"), *((f, "f8") for f in ("time_s", "voltage_V", "current_A", "lagging_A", "largest_A", "jump_s"))]
)

# The last switch of the load: the part of its size that the voltage has to follow, the voltages before and since.
_SWITCH = _table("time_s size_A to_follow_A before_V lowest_V highest_V samples")

# Some samples of the last minute, and the last changes of the voltage from sample to sample, in rings.
_RING = _table(
    [
        *(("n_kept", "i8"), ("time_s", "f8", KEPT), ("voltage_V", "f8", KEPT), ("current_A", "f8", KEPT)),
        *(("n_changes", "i8"), ("change_V", "f8", KEPT)),
    ]
)

# What was expected before a gap: the last interval, the voltage, by how much cell and model part and how fast the voltage
# falls, both in the mean; the longest intervals under load that were not in doubt, in their order.
_USUAL = _table(
    [*((name, "f8") for name in ("interval_s", "expected_V", "parted_V", "fall_V_per_s")), ("longest_s", "f8", HABIT)]
)

# The first fault that was found: its code, when, and how large it is.
_FAULT = _table([("code", "i8"), *((name, "f8") for name in ("time_s", "since_s", "size"))])

# The last gap, pending until the voltages after it were seen: its charge, the fall of the model within it, the voltage of the
# model after it, the first voltages then, and how many; 0: none is pending.
_GAP = _table("length_s end_s charge_C fall_V model_V after_V next_V samples")

#: All that is remembered of a discharge but for the filters: of the cell, of their bank, and what the samples showed.
CELL = _table(
    [
        ("samples", "i8"),
        ("time_s", "f8"),
        ("current_A", "f8"),  # since the last sample
        ("drawn_C", "f8"),
        ("ambient_K", "f8"),  # the model's surroundings, and what follows from them: constants and voltage at the start
        ("constants", "f8", NEW_CELL.packed.constants.shape),
        ("start_V", "f8"),
        ("bank", _BANK),
        ("start", _START),
        ("before", _BEFORE),
        ("examined", _EXAMINED),
        ("switch", _SWITCH),
        ("ring", _RING),
        ("usual", _USUAL),
        ("gap", _GAP),
        ("doubt_C", "f8"),  # charge of gaps that are in doubt
        ("fault", _FAULT),
    ]
)
