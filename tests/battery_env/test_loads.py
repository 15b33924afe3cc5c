"""Loads as functions of time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from battery_env.loads import BlockBootstrap, Cycle, Load, RandomPiecewise, RandomWalk, constant
from battery_env.records import Samples


def piecewise(values, durations_s):
    """One value after the other, each for its duration; the last one goes on."""
    return Load(np.append(0.0, np.cumsum(durations_s)[:-1]), values)


def blocks(values, dt_s, block_s):
    """Blocks of a record, drawn at random."""
    record = Samples(dt_s * np.arange(len(values)), np.full(len(values), 4.0), values)
    return BlockBootstrap(record, "current", block_s, dt_s, total_s=200.0)(np.random.default_rng(0))


def test_a_segment_holds_from_its_start_to_the_next():
    load = piecewise([2.0, 8.0, 5.0], [60.0, 30.0, 10.0])
    np.testing.assert_array_equal(load([0.0, 59.9, 60.0, 89.0, 90.0, 1e6]), [2.0, 2.0, 8.0, 8.0, 5.0, 5.0])
    assert load(0.0) == 2.0 and constant(8.0)(np.arange(3.0)).tolist() == [8.0] * 3


@pytest.mark.parametrize(
    "load",
    [
        piecewise([3.0, -1.0, 8.0, 2.0], [0.37, 0.2, 7.0, 1.0]),
        Cycle(piecewise([3.0, -1.0, 8.0], [0.37, 0.2, 7.0]), 1.1),
        blocks(np.random.default_rng(0).uniform(0.5, 9.0, 12), 0.7, block_s=3.5),
    ],
)
@pytest.mark.parametrize("dt_s", [0.25, 1.0, 4.0])
def test_the_mean_over_steps_draws_what_the_load_does(load, dt_s):
    starts_s, parts = dt_s * np.arange(5, 25), 4000
    middles_s = starts_s[:, None] + dt_s * (np.arange(parts) + 0.5) / parts
    # a switch within a part counts for all of it
    error = 8.0 * np.ceil(dt_s / 0.2) / parts
    np.testing.assert_allclose(load.mean(starts_s, dt_s), load(middles_s).mean(axis=1), atol=error)


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 30.0))
def test_random_loads_stay_in_their_bounds_and_follow_their_seed(seed, largest_step):
    steps = RandomPiecewise(value_range=(2.0, 8.0), duration_range_s=(60.0, 140.0), total_s=1000.0)
    walk = RandomWalk(value_range=(2.0, 8.0), largest_step=largest_step, segment_s=30.0, total_s=1000.0)
    for family in (steps, walk):
        load, again = family(np.random.default_rng(seed)), family(np.random.default_rng(seed))
        np.testing.assert_array_equal(load.value, again.value)
        assert (load.value >= 2.0).all() and (load.value <= 8.0).all() and load.start_s[-1] < 1000.0
        if family is walk:
            assert (np.abs(np.diff(load.value)) <= largest_step * (1.0 + 1e-9)).all()
            np.testing.assert_array_equal(load.start_s, np.arange(0.0, 1000.0, 30.0))
        else:
            assert (np.diff(load.start_s) >= 60.0).all() and (np.diff(load.start_s) <= 140.0).all()


def test_a_random_walk_visits_all_values_alike_and_remembers():
    rng = np.random.default_rng(0)
    walks = np.array([RandomWalk()(rng).value for _ in range(1000)])
    for segment in (0, 5, -1):  # were the walk cut off at its bounds instead of reflected, it would dwell there
        shares, _ = np.histogram(walks[:, segment], bins=6, range=(2.0, 8.0))
        np.testing.assert_allclose(shares / 1000.0, 1.0 / 6.0, atol=0.04)
    assert np.corrcoef(walks[:, 0], walks[:, 1])[0, 1] > 0.7


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Load(np.array([1.0]), np.array([2.0])), "increase from 0"),
        (lambda: Load(np.array([0.0]), np.array([2.0, 2.0])), "alike"),
        (lambda: constant(float("nan")), "load must lie within"),
        (lambda: constant(2000.0, "current"), "got 2000"),
        (lambda: constant(2.0)(-1.0), "time_s must be at least 0"),
        (lambda: RandomPiecewise(value_range=(8.0, 2.0)), "value_range"),
        (lambda: Cycle(constant(1.0), 0.0), "period_s must be a positive"),
        (lambda: RandomPiecewise(duration_range_s=(60.0, np.inf)), "duration_range_s must be finite"),
        (lambda: RandomPiecewise(duration_range_s=(1e-3, 1.0)), "more than 1e.06 segments, got 20000.0 and 0.001"),
        (lambda: RandomWalk(value_range=(2.0, 2.0)), "width of value_range"),
        (lambda: RandomWalk(value_range=(2.0, 8000.0)), "got 8000.*unit of the load is power"),
        (lambda: RandomWalk(largest_step=-1.0), "largest_step must be a positive, finite number, got -1.0"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()
