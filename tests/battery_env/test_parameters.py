"""One table says what can be calibrated."""

from dataclasses import fields

import numpy as np
import pytest

from battery_env.electrochemistry import CellParameters
from battery_env.estimates import Estimate
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS, Q_MOBILE, R_O, check_parameters


def test_every_parameter_is_a_constant_of_the_cell_and_a_part_of_an_estimate():
    for kind in (CellParameters, Estimate):
        assert set(PARAMETER_NAMES) <= {field.name for field in fields(kind)}
    assert {f"sd_{name}" for name in PARAMETERS} <= {field.name for field in fields(Estimate)}


def test_values_within_the_limits_are_taken_with_the_limits():
    np.testing.assert_array_equal(Q_MOBILE.check(Q_MOBILE.limits), [100.0, 1e6])
    assert R_O.check(0.0) == 0.0 and R_O.check([[0.1]]).shape == (1, 1)


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: Q_MOBILE.check(2.1), "q_mobile must lie within 100 .. 1e.06 C, got 2.1. Ampere-hours"),
        (lambda: R_O.check([0.1, 117.0]), "r_o must lie within 0 .. 5 ohm, got 117. Milliohms"),
        (lambda: R_O.check("0.1 ohm"), "r_o must be a number or an array of numbers in ohm"),
        (lambda: R_O.check_bounds("search_range", (0.2, 0.1)), "search_range must be .lower, upper. with lower < upper"),
        (lambda: R_O.check_bounds("search_range", (0.2,)), "search_range must be .lower, upper."),
        (lambda: check_parameters(("q_mobile", "kn")), "one or both of .'q_mobile', 'r_o'."),
    ],
)
def test_what_cannot_be_meant_is_refused(check, message):
    with pytest.raises((TypeError, ValueError), match=message):
        check()
