"""Records with one fault each: no calibrator is sure of an answer that is far off."""

import pandas as pd
import pytest
from attacks import FAULTS, UNOBSERVABLE, attack, broken, calibrators, counts, drawn, outcome
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(fault=st.sampled_from([fault for fault in FAULTS if fault not in UNOBSERVABLE]), seed=st.integers(0, 10_000))
def test_no_calibrator_is_sure_of_a_wrong_answer(fault, seed):
    rng = default_rng(seed)
    case = broken(drawn(rng, ("B0005", "B0006")), fault, rng)
    for name, make in calibrators(case).items():
        found, estimate = outcome(case, make)
        assert found != "wrong", f"{name}: {estimate}, but q_mobile is {case.q_mobile:.0f} C and r_o {case.r_o:.4f} ohm"


def test_attacks_are_counted_by_calibrator_and_fault():
    table = counts(attack(10, ("B0005",)))
    assert isinstance(table, pd.DataFrame) and table.to_numpy().sum() == 30
    assert set(table.index.get_level_values("fault")) == set(FAULTS)
