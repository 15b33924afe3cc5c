"""What policies state of their estimates: standard deviations that hold, and why they are not sure."""

import re

import numpy as np
import pytest

from battery_env import NEW_CELL, PolicyEstimator, RandomSensorErrors, evaluate, simulate
from battery_env.records import Samples
from battery_env.tasks.data import standard_dataset
from tests.policies import Step
from tests.records import recorded
from tests.sweeps import sweep

ENV_ID = "BatteryVoltageJoint-v0"
OPTIONS = {"nuisance": 0.2, "reading_s": 2.0}


def whole_discharge(q_mobile=6000.0, **more):
    current_A = np.where(np.arange(30_000) // 90 % 2, 2.25, 1.5)
    return Samples.of(recorded(simulate(current_A, q_mobile, 0.15, load_unit="current", cut_off_V=2.8, **more), noise_V=0.002))


WHOLE = whole_discharge()
SAMPLE = np.arange(len(WHOLE.time_s))


def estimator(policy=None, **options):
    return PolicyEstimator(policy or Step(), ENV_ID, **{**OPTIONS, **options})


@pytest.mark.attacks
def test_two_standard_deviations_cover_nineteen_of_twenty_estimates_of_cells_with_other_constants():
    data = standard_dataset(("q_mobile", "r_o"), "piecewise", "test", mismatch=0.2)[:24]
    scores = evaluate(PolicyEstimator.pretrained(), data, RandomSensorErrors((0.001, 0.030), 0.010), seed=1)
    for name in ("q_mobile", "r_o"):
        # 100 discharges had 95 to 98 %
        assert 90.0 < scores[f"{name}_coverage_percent"].mean() < 99.9
    assert np.isfinite(scores["settled_time_s"]).mean() > 0.9


def test_the_last_of_a_trace_is_the_estimate():
    estimate, trace = estimator().estimate(WHOLE), estimator().trace([WHOLE])[0]
    assert estimate.settled and estimate.q_mobile == pytest.approx(6000.0, rel=0.01)
    for name in ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled", "settled_q_mobile", "settled_r_o", "reason"):
        assert getattr(estimate, name) == getattr(trace, name)[-1]
    assert trace.sd_q_mobile[-1] < 0.05 * trace.sd_q_mobile[0] and not trace.settled[0]
    assert (trace.settled == (trace.reason == "")).all()


def test_a_policy_that_sees_no_fit_states_nothing_and_is_never_sure():
    estimate = PolicyEstimator(Step(columns=slice(0, 2)), ENV_ID).estimate(WHOLE)
    assert not estimate.settled and estimate.reason.startswith("The policy states no uncertainty")
    assert np.isnan([estimate.sd_q_mobile, estimate.sd_r_o]).all()


def shifted(volts) -> Samples:
    return Samples(WHOLE.time_s, WHOLE.voltage_V + volts, WHOLE.current_A)


def without(lost) -> Samples:
    return Samples(*(column[~lost] for column in WHOLE))


@pytest.mark.parametrize(
    ("record", "options", "message"),
    [
        (whole_discharge(q_mobile=9500.0), {}, "q_max is at a bound of its search"),
        (shifted(0.035), {}, "The record starts at 4.2. V under 1.5 A, where a full cell"),
        (shifted(-0.035), {}, "The offset of the voltage is ... times the largest"),
        (whole_discharge(cell=NEW_CELL.replace(kn=6.0 * NEW_CELL.kn)), {}, "The distance from the constants .* is"),
        (whole_discharge(cell=NEW_CELL.replace(U0p=NEW_CELL.U0p + 0.1)), {}, "The record starts at .* another kind of cell"),
        (shifted(0.02 * np.sin(WHOLE.time_s / 300.0)), {}, "farther off than noise"),
        (WHOLE.first(500), {}, "q_max is not known to 2 % yet"),
        (WHOLE.first(9), {}, "These are too few samples"),
        # away from the fit its constants belong to none
        (WHOLE, {"policy": Step(beyond=0.15)}, "farther off than noise"),
        (Samples(*(column[900:] for column in WHOLE)), {}, "The record starts at 3"),
        (without(SAMPLE % 3 != 0), {}, "farther off than noise"),
    ],
    ids=["range", "sensor", "offset", "constant", "another cell", "misfit", "in progress", "few", "distrust", "late",
         "switched between samples"],
)  # fmt: skip
def test_what_it_is_not_sure_of_is_said(record, options, message):
    estimate = estimator(**options).estimate(record)
    assert not estimate.settled
    assert re.search(message, estimate.reason), estimate.reason


STEADY = simulate(np.full(30_000, 2.0), 6000.0, 0.15, load_unit="current", cut_off_V=2.8)


@pytest.mark.parametrize("apart_s", sweep(10, 1, 3, 17, 30, 60))
def test_it_reads_where_the_samples_are(apart_s):
    """However far apart, and whether the others are not in the record or have no voltage."""
    record = Samples.of(recorded(STEADY, noise_V=0.002, seed=1))
    kept = np.arange(len(record.time_s)) % apart_s == 0
    stream, missing_V = estimator(), np.where(kept, record.voltage_V, np.nan)
    for voltage_V, current_A in zip(missing_V.tolist(), record.current_A.tolist(), strict=True):
        streamed = stream.update(voltage_V, current_A, 1.0)
    estimate = estimator().estimate(Samples(*(column[kept] for column in record)))
    for each in (estimate, streamed):
        assert each.settled and abs(each.q_mobile - 6000.0) < 3.0 * each.sd_q_mobile + 6.0 < 200.0
    assert streamed.q_mobile == pytest.approx(estimate.q_mobile, rel=2e-3)


def test_a_stream_states_nothing_before_its_first_decision():
    assert estimator().update(4.19, 1.5, 1.0).reason.startswith("The policy states no uncertainty: it does from its first")
