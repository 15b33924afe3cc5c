"""Where the load of a record begins and ends, and when it is switched."""

import numpy as np
import pytest

from battery_env.records import is_load, load_span, switches

TIME_S = 10.0 * np.arange(200)


def current_A(*parts: tuple[int, float]) -> np.ndarray:
    """Parts of so many samples under some current, and rest after them."""
    values = np.concatenate([np.full(count, ampere) for count, ampere in parts])
    return np.append(values, np.zeros(len(TIME_S) - len(values)))


@pytest.mark.parametrize(
    ("parts", "first", "last"),
    [
        ([(10, 0.0), (100, 2.0)], 10, 109),
        ([(200, 2.0)], 0, 199),
        ([(10, 0.0), (1, 0.15), (9, 0.0), (100, 2.0)], 20, 119),  # what draws next to nothing is noise
        ([(10, 0.0), (50, 0.15), (100, 2.0)], 10, 159),  # what draws more is a small load
        ([(10, 0.0), (50, 0.05), (100, 2.0)], 60, 159),  # but for an offset
        ([(10, -3.0), (10, 0.0), (50, 2.0), (20, 0.0), (50, 0.15)], 20, 139),
    ],
)
def test_a_load_is_found_with_the_small_ones_around_it(parts, first, last):
    span = load_span(TIME_S, current_A(*parts))
    assert (span.first, span.last) == (first, last) and span.rows == slice(first, last + 1)


def test_a_record_without_a_load_has_none():
    for rest_A in (np.zeros(200), np.full(200, -1.0)):
        assert not is_load(rest_A).any()
        with pytest.raises(ValueError, match="no current flows in this record"):
            load_span(TIME_S, rest_A)


@pytest.mark.parametrize(("offset_A", "noise_A"), [(0.01, 0.03), (0.05, 0.0)])
def test_noise_and_offset_at_rest_are_no_load(offset_A, noise_A):
    noisy_A = current_A((50, 0.0), (100, 2.0)) + offset_A + noise_A * np.random.default_rng(0).standard_normal(200)
    assert load_span(TIME_S, noisy_A) == (50, 149)


def test_a_drift_is_no_switch():
    assert switches(np.linspace(1.0, 2.0, 200)).tolist() == []
    assert switches(current_A((10, 0.0), (100, 2.0))).tolist() == [9, 109]
