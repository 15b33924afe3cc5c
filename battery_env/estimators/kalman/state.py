"""
What a Kalman filter is told, and what it remembers of a discharge: tables with named columns, which compiled code (numba)
reads and writes in place.
"""

from __future__ import annotations

from typing import NamedTuple

from battery_env.electrochemistry import NEW_CELL, STATE_SIZE
from battery_env.estimators.diagnosis.evidence import EVIDENCE
from battery_env.estimators.diagnosis.faults import table
from battery_env.estimators.verdict import Assumptions

#: What a filter estimates: ``q_mobile`` (C), ``r_o`` (ohm) and the offset of the voltage (V).
Q, R, OFFSET = range(3)


class FilterSettings(NamedTuple):
    """What a filter is told, with pairs for ``q_mobile`` and ``r_o``."""

    dt_s: float  # longest time step of the model, s
    thermal: bool  # whether the temperature of the model moves
    noise_V2: float  # variance of the voltage noise, V^2
    mismatch_V2: float  # variance of the error of the model, V^2
    searched: tuple[bool, bool]  # whether each is searched for
    variance: tuple[float, float]  # of each before the discharge, 0 where it is held, C^2 and ohm^2
    growth: tuple[float, float]  # of the variance of each, C^2/s and ohm^2/s
    offset_growth: float  # of the variance of the offset, V^2/s
    bounds: tuple[tuple[float, float], tuple[float, float]]  # where each stays, C and ohm
    carried: tuple[tuple[float, float], tuple[float, float]]  # mean and sd of each from an earlier discharge; 0: none
    cell_q_mobile: float  # of the model's cell, C
    known: Assumptions  # what is taken for known, and does not show in the voltage


#: One sample; its current is the mean until the next one, and was read at its time.
SAMPLE = table("voltage_V current_A dt_s temperature_K read_A")

# Sums over the charge drawn, of the derivative of the voltage by q_mobile (V) and of products with that by r_o (V^2/C, V A,
# A^2 C), and that charge (C); and of products of both with the derivative by q_mobile over the charge, as that by a charge at
# the start is
_INFORMATION = table("q qq qr rr charge_C by_q by_r")

#: One filter of a bank, with a model of its own at its estimate.
FILTER = table(
    [
        ("state", "f8", (1, STATE_SIZE)),
        ("tangents", "f8", (1, 2, STATE_SIZE)),  # derivatives of the state with respect to q_mobile and r_o
        ("mean", "f8", 3),
        ("covariance", "f8", (3, 3)),
        ("log_weight", "f8"),  # -inf: given up
        ("noise_V2", "f8"),  # variance of the noise that the last innovation showed
        ("innovation", "f8"),  # the last one over its standard deviation, within the gate
        ("expected_V", "f8"),  # voltage of the model at the last sample before it was taken in, with the offset
        ("information", _INFORMATION),
    ]
)

# What a bank remembers beside its filters.
_BANK = table(
    [
        # after the last sample: moments of the mixture of all filters, the standard deviations that an error of the model
        # leaves which is common to the discharge, what a share of q_mobile that nobody counted makes of r_o, the voltage that
        # was expected, and whether the model cell has one
        ("mean", "f8", 2),
        ("sd", "f8", 2),
        ("common_sd", "f8", 2),
        ("r_by_share", "f8"),
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

#: All that is remembered of a discharge but for the filters.
CELL = table(
    [
        ("ambient_K", "f8"),  # the model's surroundings, and the constants that follow from them
        ("constants", "f8", NEW_CELL.packed.constants.shape),
        ("bank", _BANK),
        ("evidence", EVIDENCE),
    ]
)
