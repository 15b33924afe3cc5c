"""What a record shows beside the samples under load: each piece of evidence, over its size."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from battery_env import Discharge, calibrate, load_nasa_discharges, read_discharges
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate
from battery_env.estimates.findings import Doubt
from battery_env.estimators.diagnosis.evidence import evidence_of
from battery_env.records import ChargeBefore, ChargeHistory, Samples
from battery_env.records.load import switched_charge
from tests.records import recorded
from tests.sweeps import sweep

TRUE_Q_C, TRUE_R_OHM, LOAD_A = 7000.0, 0.12, 2.0
REAL = load_nasa_discharges("B0006")[99]


def discharged(every_s: float, rest_s: float, switch_s: float, soc: float = 1.0) -> Discharge:
    """A row each so many seconds, the load switched so long after the last one at rest."""
    start = initial_state(TRUE_Q_C, soc=soc)
    record = simulate(LOAD_A, TRUE_Q_C, TRUE_R_OHM, load_unit="current", thermal=True, cut_off_V=2.6, initial=start)
    # the model starts at rest: its voltage is that of the cell before the load
    time_s = np.arange(-rest_s, record.time_s[-1], every_s) + every_s - switch_s
    current_A = np.where(time_s >= 0.0, LOAD_A, 0.0)
    voltage_V = np.interp(time_s, record.time_s, record.voltage_V)
    return Discharge(time_s - time_s[0], voltage_V, current_A)


def is_right(found) -> bool:
    """Whether each number that is settled is right, within 5 % or 3 standard deviations."""
    right_q = abs(found.q_mobile_C - TRUE_Q_C) <= max(0.05 * TRUE_Q_C, 3.0 * found.sd_q_mobile_C)
    right_r_o = abs(found.r_o_ohm - TRUE_R_OHM) <= max(0.05 * TRUE_R_OHM, 3.0 * found.sd_r_o_ohm)
    return (right_q or not found.settled_q_mobile) and (right_r_o or not found.settled_r_o)


class TestLoadOn:
    @pytest.mark.parametrize("every_s", sweep(60.0, 1.0, 10.0, 120.0, 300.0, 600.0))
    def test_its_doubt_covers_what_it_costs_however_far_apart_the_rows_are(self, every_s):
        for share in (0.02, 0.5, 0.98):
            found = calibrate(discharged(every_s, 3.0 * every_s, share * every_s))
            assert found.record.history.load_on_C == pytest.approx(LOAD_A * every_s / 12.0**0.5, rel=0.05)
            assert found.sd_q_mobile_C > found.record.history.load_on_C
            assert abs(found.q_mobile_C - TRUE_Q_C) < 2.5 * found.sd_q_mobile_C
            assert found.settled_q_mobile or every_s > 10.0, found.reason
            assert not found.settled_q_mobile or every_s < 200.0

    @pytest.mark.parametrize("lost_s", sweep(60.0, 20.0, 300.0, 900.0))
    def test_rows_that_are_lost_around_it_are_a_doubt_of_their_size_and_no_refusal(self, lost_s):
        whole = discharged(10.0, 300.0, 5.0)
        kept = (whole.time_s < 250.0) | (whole.time_s > 250.0 + lost_s)
        found = calibrate(recorded(whole, kept))
        assert found.settled_q_mobile == (lost_s < 200.0) and is_right(found)
        assert abs(found.drawn_Ah - whole.charge_C / 3600.0) * 3600.0 < 2.5 * found.record.history.load_on_C + LOAD_A * 10.0

    def test_a_row_that_mixes_rest_and_load_does_not_decide(self):
        first = int(np.argmax(REAL.current_A > 1.0))
        voltage_V = REAL.voltage_V.copy()
        voltage_V[first - 1] = voltage_V[first] + 0.002
        mixed, plain = calibrate(replace(REAL, voltage_V=voltage_V)), calibrate(REAL)
        assert mixed.settled and mixed.capacity_Ah == pytest.approx(plain.capacity_Ah)
        assert mixed.q_mobile_C == pytest.approx(plain.q_mobile_C, rel=1e-3)


class TestRest:
    @pytest.mark.parametrize("rests_after", [True, False])
    @pytest.mark.parametrize("offset_A", sweep(0.05, -0.15, -0.05, -0.01, 0.01, 0.15))
    def test_what_flows_there_is_counted_as_an_offset(self, offset_A, rests_after):
        rest_s = 20.0 * np.arange(45)
        time_s = np.concatenate([REAL.time_s[0] - 900.0 + rest_s, REAL.time_s])
        voltage_V = np.append(np.full(45, REAL.voltage_V[0]), REAL.voltage_V)
        current_A = np.append(np.zeros(45), REAL.current_A) + offset_A
        kept = slice(None if rests_after else np.flatnonzero(current_A > 1.0)[-1] + 1)
        record = Discharge(time_s[kept], voltage_V[kept], current_A[kept])
        plain, found = calibrate(REAL), calibrate(record)
        assert found.record.history.offset_A == pytest.approx(offset_A, abs=0.01)
        assert abs(found.q_mobile_C - plain.q_mobile_C) < 2.0 * found.sd_q_mobile_C
        is_large = abs(offset_A) > 0.03
        assert is_large == (f"{found.record.history.offset_A:.3g} A flow at rest" in found.reason)
        assert not (is_large and found.settled_q_mobile)

    def test_a_small_load_before_a_larger_one_is_none(self):
        drawn = replace(REAL, current_A=np.append([0.15, 0.15], REAL.current_A[2:]))
        assert drawn.loaded_part(2.7).history.offset_A == pytest.approx(0.0, abs=0.01)


def cycled(highest_V: float, last_A: float, rest_rows: int = 0, soc: float = 1.0) -> pd.DataFrame:
    """A charge with 3 A, at most so high, which ends at some current; then a discharge."""
    discharge = discharged(1.0, max(rest_rows, 1), 0.5, soc)
    rows = slice(0 if rest_rows else 1, None)
    charge_V = np.concatenate([np.linspace(3.5, highest_V, 200), np.full(200, highest_V)])
    charge_A = np.concatenate([np.full(200, -3.0), np.geomspace(-3.0, -last_A, 200)])
    time_s = np.concatenate([10.0 * np.arange(400), 3991.0 + discharge.time_s[rows]])
    columns = {
        "time_s": time_s,
        "voltage_V": np.append(charge_V, discharge.voltage_V[rows]),
        "current_A": -np.append(charge_A, discharge.current_A[rows]),
    }
    return pd.DataFrame(columns)


class TestCharge:
    @pytest.mark.parametrize(
        ("soc", "highest_V"), sweep((0.97, 4.2), (0.97, 4.25), (0.92, 4.15), (0.85, 4.1), (0.7, 4.0), (0.7, 4.2))
    )
    def test_one_that_did_not_taper_off_proves_no_full_cell(self, soc, highest_V):
        # its voltage under load is that of a full cell with a larger resistance
        (found,) = calibrate(cycled(highest_V, 3.0, soc=soc))
        assert not found.settled and f"ended at {highest_V:.2f} V, still under 3 A" in found.reason

    @pytest.mark.parametrize("rest_rows", sweep(0, 1, 100))
    def test_one_that_tapered_off_proves_a_full_cell_without_a_rest(self, rest_rows):
        table = cycled(4.2, 0.05, rest_rows)
        (found,) = calibrate(table)
        assert found.settled and is_right(found) and found.record.history.charge.is_tapered
        assert found.capacity_Ah == pytest.approx(found.drawn_Ah)
        # in whichever cycle it is counted
        counted = table.assign(cycle=np.where(table.current_A <= 0.0, 2, 1) if rest_rows == 0 else 1)
        assert len(read_discharges(counted)) == 1 and read_discharges(counted)[0].history.charge is not None

    @pytest.mark.parametrize(("last_A", "settled"), sweep((0.2, False), (0.03, True), (0.1, None), (0.3, False)))
    def test_what_a_taper_left_is_in_the_standard_deviation(self, last_A, settled):
        # about the charge that an exponential would have brought after its end
        left_C = last_A * 2000.0 / np.log(3.0 / last_A)
        (found,) = calibrate(cycled(4.2, last_A, rest_rows=1))
        assert found.record.history.charge.taper_remainder_C == pytest.approx(left_C, rel=0.15)
        assert found.sd_q_mobile_C > left_C and found.capacity_Ah == pytest.approx(found.drawn_Ah)
        assert settled is None or found.settled_q_mobile == settled == ("had some left to take" not in found.reason)

    @pytest.mark.parametrize("soc", sweep(0.98, 0.99, 0.97, 0.965))
    def test_a_charge_cut_short_left_what_the_voltage_at_rest_shows(self, soc):
        table = cycled(4.25, 3.0, rest_rows=100, soc=soc)
        (found,), (alone,) = (calibrate(each) for each in (table, table[400:]))
        left_C = found.q_mobile_C * (1.0 / soc - 1.0)
        assert found.sd_q_mobile_C == pytest.approx(np.hypot(alone.sd_q_mobile_C, left_C), rel=0.3)

    @pytest.mark.parametrize(
        ("table", "stated", "reason"),
        [
            (cycled(4.1, 0.05, soc=0.92), {}, "ended at 4.10 V"),  # too low for these constants
            (cycled(4.25, 3.0, rest_rows=100), {}, ""),  # a rest of a minute
            (cycled(4.1, 3.0, 100, soc=0.9), {"initial_soc": 0.9}, ""),
        ],
    )
    def test_a_rest_or_what_is_stated_tells_more_than_a_charge(self, table, stated, reason):
        (found,) = calibrate(table, **stated)
        assert found.settled == (not reason) and reason in found.reason and is_right(found)

    @pytest.mark.parametrize(
        ("share", "is_tapered"), [(0.0999, True), (0.1003, True), (0.104, True), (0.11, False), (0.2, False)]
    )
    def test_one_that_ended_at_a_tenth_by_a_reading_before_it_tapered_off(self, share, is_tapered):
        current_A = -np.append(np.full(50, 3.0), 3.0 * np.linspace(share + 0.02, share, 50))
        voltage_V = np.append(np.linspace(3.8, 4.2, 50), np.full(50, 4.2))
        assert ChargeBefore.of(10.0 * np.arange(100), voltage_V, current_A).is_tapered == is_tapered

    def test_noise_at_its_end_is_no_taper(self):
        voltage_V, current_A = np.append(np.linspace(3.8, 4.1, 50), 4.0), -np.append(np.full(50, 3.0), 0.02)
        assert not ChargeBefore.of(10.0 * np.arange(51), voltage_V, current_A).is_tapered

    def test_nothing_is_known_of_other_records(self):
        assert REAL.history == ChargeHistory() and REAL.loaded_part(2.7).history.charge is None


class TestCutOff:
    @pytest.mark.parametrize("above_V", sweep(1e-3, 8e-6, 2e-3, 4e-3))
    def test_a_load_that_ends_within_its_last_fall_of_it_ends_there(self, above_V):
        whole = REAL.until(REAL.eod_time_s(2.7) + 5.0)
        lowest_V = float(whole.voltage_V[-1])
        over, plain = calibrate(whole, cut_off_V=lowest_V - above_V), calibrate(whole, cut_off_V=lowest_V)
        assert not over.in_progress and over.method == plain.method == "least-squares"
        assert over.capacity_Ah == pytest.approx(plain.capacity_Ah, rel=1e-3)
        assert over.r_o_ohm == pytest.approx(plain.r_o_ohm, rel=1e-3)

    @pytest.mark.parametrize("stop_V", sweep(2.7003, 2.6997, 2.703))
    @pytest.mark.parametrize("later_A", sweep([1.0], [1.0, 0.3]))
    def test_capacity_is_that_of_the_first_load_that_ends_there(self, stop_V, later_A):
        """Rate steps: each smaller load draws some more."""
        parts, state, now_s = [([0.0], [4.19], [0.0])], None, 10.0
        for load_A in (3.0, *(A for later in later_A for A in (0.0, later))):
            until_s = 86_400.0 if load_A else 900.0
            made = simulate(load_A, 6800.0, 0.12, until_s, load_unit="current", cut_off_V=stop_V, initial=state)
            kept = np.append(np.arange(0, len(made.time_s) - 1, 5), len(made.time_s) - 1)
            parts.append((now_s + made.time_s[kept], made.voltage_V[kept], np.full(len(kept), load_A)))
            state, now_s = made.state[-1], now_s + made.time_s[-1] + 1.0
        found = calibrate(Discharge(*map(np.concatenate, zip(*parts, strict=True))))
        first_C = 3.0 * (parts[1][0][-1] - 10.0)
        assert 3600.0 * found.capacity_Ah == pytest.approx(first_C, rel=3e-3)

    def test_an_earlier_end_is_none(self):
        assert calibrate(REAL.until(REAL.time_s[200])).in_progress
        fall_V = float(REAL.voltage_V[199] - REAL.voltage_V[200])
        assert np.isnan(REAL.until(REAL.time_s[200]).eod_time_s(float(REAL.voltage_V[200]) - 1.5 * fall_V))
        # nor is a drop of the load
        low = replace(REAL, current_A=np.where(np.arange(len(REAL.time_s)) % 2, REAL.current_A, 0.3 * REAL.current_A))
        assert np.isnan(low.until(low.time_s[201]).eod_time_s(float(low.voltage_V[201]) - 0.001))

    def test_a_load_that_was_switched_off_is_over_and_has_the_method_of_a_whole_one(self):
        off = np.arange(len(REAL.time_s)) > 200
        record = replace(REAL, current_A=np.where(off, 0.0, REAL.current_A), voltage_V=np.where(off, 3.7, REAL.voltage_V))
        with pytest.warns(UserWarning, match=r"the load ends at .* no further, state cut_off_V \(--cut-off\)"):
            assert calibrate(record).method == "least-squares"


class TestGaps:
    def test_short_ones_on_a_flat_curve_say_nothing_where_a_logger_has_the_habit(self):
        """Intervals of 5 s between bursts: the voltage of iron phosphate falls in them by less than it is rounded by."""
        burst_s, fall_V = 0.1 * np.arange(12), np.where(np.arange(30) < 6, 0.01, 2e-4)
        time_s = (np.cumsum(np.full(30, 6.1))[:, None] + burst_s).ravel()
        model_V = 3.3 - np.repeat(np.cumsum(fall_V), 12)
        wander_V = 8e-4 * np.repeat(np.random.default_rng(0).choice([0.0, 1.0], 30), 12)
        record = Samples(time_s, model_V + wander_V, np.full(360, 4.4))
        seen = evidence_of(record, NEW_CELL, None, (3900.0, 0.03), ChargeHistory(), model_V)
        assert not seen.charges_C[Doubt.GAP] and seen.fault is None


class TestSwitches:
    def test_like_ones_add_up_and_others_in_quadrature(self):
        """Errors of rows that meet a load at the same place each time do not cancel."""
        time_s, one_C = 10.0 * np.arange(41), 10.0 / np.sqrt(12.0)
        like = np.where(np.arange(41) // 2 % 2, 2.0, 1.0)
        assert switched_charge(time_s, like) == pytest.approx((one_C * np.hypot(10.0, 10.0), one_C * np.sqrt(20.0), 20))
        growing = 1.0 + np.cumsum(np.where(np.arange(41) % 2, 1.0, -1.0) * 1.3 ** (np.arange(41) / 4.0))
        sizes = np.abs(np.diff(growing))
        assert switched_charge(time_s, growing)[:2] == pytest.approx([one_C * np.sqrt((sizes**2).sum())] * 2)
        assert switched_charge(time_s, np.linspace(1.0, 2.0, 41)) == (0.0, 0.0, 0)

    def test_a_count_of_the_tester_leaves_none(self):
        current_A = np.where(np.arange(len(REAL.time_s)) // 3 % 2, REAL.current_A, 0.3 * REAL.current_A)
        pulsed = replace(REAL, current_A=current_A)
        counted = replace(pulsed, history=ChargeHistory(is_counted=True))
        # but of the moment at which the load came on
        assert pulsed.sd_charge_C > 0.02 * pulsed.charge_C and 0.0 < counted.sd_charge_C < 0.02 * pulsed.sd_charge_C
        sure, unsure = (
            evidence_of(Samples.of(each), NEW_CELL, 1.0, (6000.0, 0.1), each.history) for each in (counted, pulsed)
        )
        assert unsure.sd_charge_C == pytest.approx(np.hypot(sure.sd_charge_C, pulsed.sd_charge_C), rel=0.01)
