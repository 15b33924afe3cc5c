"""Loads as functions of time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from battery_env.loads import Load, RandomPiecewise, constant, piecewise


def test_a_segment_holds_from_its_start_to_the_next():
    load = piecewise([2.0, 8.0, 5.0], [60.0, 30.0, 10.0])
    np.testing.assert_array_equal(load([0.0, 59.9, 60.0, 89.0, 90.0, 1e6]), [2.0, 2.0, 8.0, 8.0, 5.0, 5.0])


def test_the_first_segment_holds_at_time_zero():
    assert piecewise([2.0, 8.0], [60.0, 60.0])(0.0) == 2.0


def test_constant_load():
    assert constant(8.0)(np.arange(3.0)).tolist() == [8.0] * 3


@given(st.integers(0, 2**32 - 1))
def test_random_piecewise_stays_in_its_ranges_and_follows_its_seed(seed):
    family = RandomPiecewise(value_range=(2.0, 8.0), duration_range_s=(60.0, 140.0), total_s=1000.0)
    load, again = family(np.random.default_rng(seed)), family(np.random.default_rng(seed))
    np.testing.assert_array_equal(load.value, again.value)
    assert (load.value >= 2.0).all() and (load.value <= 8.0).all()
    assert (np.diff(load.start_s) >= 60.0).all() and (np.diff(load.start_s) <= 140.0).all()
    assert load.start_s[-1] < 1000.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Load(np.array([1.0]), np.array([2.0])), "increase from 0"),
        (lambda: Load(np.array([0.0, 0.0]), np.array([2.0, 2.0])), "increase from 0"),
        (lambda: Load(np.array([0.0]), np.array([2.0, 2.0])), "alike"),
        (lambda: constant(float("nan")), "load must lie within"),
        (lambda: constant(2000.0, "current"), "got 2000"),
        (lambda: piecewise([2.0, 3.0], [10.0, -1.0]), "durations_s"),
        (lambda: constant(2.0)(-1.0), "time_s must be at least 0"),
        (lambda: RandomPiecewise(value_range=(8.0, 2.0)), "value_range"),
        (lambda: RandomPiecewise(total_s=0.0), "total_s"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
