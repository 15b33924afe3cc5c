"""A cell over its discharges: what is carried on is as sure as it says."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from battery_env import Discharge, LeastSquares, Settings, calibrate, fit_cell, load_nasa_discharges, track_life
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.estimates import Finding
from battery_env.lab.life import life_of
from battery_env.lab.running import forecast_end
from battery_env.records import ChargeBefore, ChargeHistory
from tests.records import recorded
from tests.sweeps import sweep


def followed(q_mobile_C, **columns):
    table = pd.DataFrame({"q_mobile_C": q_mobile_C, "valid": True, "reason": ""})
    known = {
        "cycle": np.arange(len(table)) + 1,
        "findings": [()] * len(table),
        "capacity_Ah": table["q_mobile_C"] / 3780.0,
        "mean_current_A": 2.0,
        "least_current_A": 2.0,
        "most_current_A": 2.0,
        "lasted_share": 1.0,
    }
    return life_of(table.assign(**{**known, **columns}))


def walk(seed, count=150):
    """Charges that fall by 0.2 % a discharge, in steps of 1 %, each known to 0.2 %."""
    rng = np.random.default_rng(seed)
    level = np.cumsum(-0.002 + 0.01 * rng.standard_normal(count))
    return 7000.0 * np.exp(level + 0.002 * rng.standard_normal(count))


class TestSeries:
    def test_sizes_are_found(self):
        lives = [followed(walk(seed)) for seed in range(12)]
        assert np.mean([life.step_share for life in lives]) == pytest.approx(0.01, rel=0.15)
        assert np.mean([life.drift_share for life in lives]) == pytest.approx(-0.002, abs=0.0007)

    def test_the_next_one_lies_inside_as_often_as_said(self):
        inside = []
        for seed in range(6):
            table = followed(walk(seed)).table.iloc[1:]
            error = (table["q_mobile_C"] - table["expected_q_mobile_C"]).abs()
            inside.append((error <= 1.645 * table["expected_sd_C"]).mean())
        assert 0.84 <= np.mean(inside) <= 0.96

    def test_the_end_of_life_lies_inside_as_often_as_said(self):
        inside = []
        for seed in range(14):
            q_C = walk(seed, count=400)
            end = np.flatnonzero(q_C < 3780.0 * 1.4)[0]
            if end > 25:
                low, _, high = followed(q_C[:20]).remaining_discharges(1.4)
                inside.append(low <= end + 1 - 20 <= high)
        assert np.mean(inside) >= 0.8

    @pytest.mark.parametrize("numbers", [(1, 40), (1, 20, 40), (1, 2, 3)])
    def test_the_last_number_far_ahead_lies_inside_as_often_as_said(self, numbers):
        inside = []
        for seed in range(40):
            q_C = walk(seed, 90)
            life = followed(q_C[np.array(numbers) - 1], cycle=numbers)
            mean_C, sd_C = life.later_q_mobile_C(80 - numbers[-1])
            inside.append(abs(q_C[79] - mean_C) <= 1.645 * sd_C)
            assert sd_C > 3.0 * life.next_q_mobile_C[1] > 0.0
        assert 0.8 <= np.mean(inside)

    def test_numbers_that_do_not_go_on_count_as_the_next(self):
        q_C = walk(0, 6)
        plain, anew = followed(q_C), followed(q_C, cycle=[7, 8, 9, 1, 2, 3])
        assert plain.prior_q_mobile_C == anew.prior_q_mobile_C == followed(q_C, cycle=["a"] * 6).prior_q_mobile_C
        assert [plain.discharges_until(cycle) for cycle in (None, 3, 7, 46)] == [1, 1, 1, 40]

    def test_estimates_that_are_not_valid_are_left_aside(self):
        q_C, valid = walk(0, 30), np.arange(30) != 17
        lives = [followed(np.where(valid, q_C, wrong), valid=valid) for wrong in (1000.0, 20_000.0, np.nan)]
        assert lives[0].prior_q_mobile_C == lives[1].prior_q_mobile_C == lives[2].prior_q_mobile_C
        expected = [life.table["expected_q_mobile_C"] for life in lives]
        pd.testing.assert_series_equal(*expected[:2])
        pd.testing.assert_series_equal(*expected[1:])

    def test_one_discharge_is_enough_for_a_prior(self):
        mean_C, sd_C = followed(np.array([7000.0])).prior_q_mobile_C
        assert mean_C == pytest.approx(7000.0) and 0.005 < sd_C / mean_C < 0.03

    def test_a_prior_makes_up_for_a_model_that_ends_early(self):
        q_C = walk(3, 5)
        plain, early, short = (followed(q_C, lasted_share=[1.0] * 4 + [last]) for last in (1.0, 1.02, np.nan))
        assert early.prior_q_mobile_C == pytest.approx(1.02 * np.array(plain.prior_q_mobile_C))
        assert short.prior_q_mobile_C == plain.prior_q_mobile_C

    def test_an_estimate_at_another_load_tells_less_of_this_one(self):
        running = Discharge(np.arange(6) * 300.0, np.linspace(4.1, 3.6, 6), np.array([0.0] + [2.0] * 5))
        q_C = 7000.0 * np.exp(-0.002 * np.arange(7))
        off_C, other_A = q_C * np.where(np.arange(7) == 5, 1.03, 1.0), np.where(np.arange(7) == 5, 4.0, 2.0)
        loads = {name: other_A for name in ("mean_current_A", "least_current_A", "most_current_A")}
        lives = [followed(q_C), followed(off_C, **loads), followed(off_C)]
        right, told, not_told = (replace(life, sd_share=0.02).prior_for(running)[0] for life in lives)
        assert told == pytest.approx(right, rel=2e-3) and not_told > 1.005 * right

    def test_a_lower_threshold_is_reached_later(self):
        life = followed(walk(1, 60))
        now_Ah = float(life.table["capacity_Ah"].iloc[-1])
        left = [life.remaining_discharges(share * now_Ah) for share in (1.2, 0.9, 0.8)]
        assert (left[0] <= left[1]).all() and (left[1] < left[2]).all() and left[0][1] == 1.0
        assert np.isinf(life.remaining_discharges(1e-9 * now_Ah)).all()

    def test_what_cannot_be_meant_is_refused(self):
        life = followed(walk(2, 10))
        with pytest.raises(ValueError, match="threshold_Ah must be a positive"):
            life.remaining_discharges(0.0)
        with pytest.raises(ValueError, match=r"count must lie within 1 \.\. 10, got 11"):
            life.after(11)
        said = ["It rests at 3.85 V.", "Cut at 2.90 V.", "Cut at 2.80 V."]
        codes = ["start_unlike", "other", "other"]
        found = [(Finding(code, measured={"message": each}),) for code, each in zip(codes, said, strict=True)]
        with pytest.raises(ValueError, match=r"no discharge determines q_mobile\. Of 2 of 3: Cut at 2\.90 V\."):
            followed(walk(2, 3), valid=False, findings=found)
        with pytest.raises(ValueError, match="must have no prior"):
            track_life(TestRealCell.discharges, 2.7, LeastSquares(prior_q_mobile_C=(7000.0, 70.0)))
        with pytest.raises(ValueError, match="at least one discharge"):
            track_life([], 2.7)


class TestRealCell:
    discharges = load_nasa_discharges("B0005")[:4]

    def test_a_life_is_followed(self):
        life = track_life(self.discharges, cut_off_V=2.7)
        assert list(life.table["cycle"]) == [1, 2, 3, 4] and life.table["settled"].all()
        measured_Ah = [discharge.meta["capacity_Ah"] for discharge in self.discharges]
        np.testing.assert_allclose(life.table["capacity_Ah"], measured_Ah, rtol=0.02)
        assert life.prior_q_mobile_C[0] == pytest.approx(life.table["q_mobile_C"].iloc[-1], rel=0.01)
        earlier = track_life(self.discharges[:3], cut_off_V=2.7)
        assert life.after(3).prior_q_mobile_C == pytest.approx(earlier.prior_q_mobile_C)

    def test_an_error_that_all_discharges_share_hides_no_step(self):
        life = track_life(self.discharges, cut_off_V=3.4)
        assert not life.table["settled"].any() and life.table["valid"].all()
        mean_C, sd_C = life.prior_q_mobile_C
        assert (life.table["sd_q_mobile_C"] > 0.03 * mean_C).all() and sd_C < 0.03 * mean_C
        assert mean_C == pytest.approx(track_life(self.discharges, cut_off_V=2.7).prior_q_mobile_C[0], rel=0.03)

    def test_constants_are_held_over_a_life_and_their_doubt_counts_at_other_loads(self):
        known = Settings(method="least-squares", cell_rates_sd={})
        held = track_life(self.discharges, 2.7, known.calibrator())
        unsure = track_life(self.discharges, 2.7, Settings(method="least-squares").calibrator())
        by_default = track_life(self.discharges, 2.7)
        # but those of the resistance, which ages along with it
        aging = [name for name in held.table if "resistance" in name]
        pd.testing.assert_frame_equal(by_default.table.drop(columns=aging), held.table.drop(columns=aging))
        pd.testing.assert_frame_equal(by_default.table[aging], unsure.table[aging])
        assert (by_default.table["resistance_10s_ohm"] != held.table["resistance_10s_ohm"]).all()
        # which constants they are is one more doubt
        pd.testing.assert_frame_equal(unsure.table, by_default.table)
        assert by_default.sd_share == unsure.sd_share == by_default.after(2).sd_share > 1.2 * held.sd_share

    @pytest.mark.parametrize("share", sweep(0.5, 0.25, 0.75))
    def test_what_the_model_missed_before_it_misses_again(self, share):
        kind = with_equilibrium(NEW_CELL.replace(kn=1500.0, tDiffusion=5e6), [-0.1, 0.0, 0.0, 0.0, 0.05, 0.0, 0.05])
        lived = [
            simulate(2.0, q_C, 0.12, load_unit="current", cell=kind, thermal=True, cut_off_V=2.5) for q_C in (7100.0, 7000.0)
        ]
        before, running = (Discharge(each.time_s[::10], each.voltage_V[::10], each.current_A[::10]) for each in lived)
        life, end_s = track_life([before], 2.7), running.eod_time_s(2.7)
        life = replace(life, state=np.log(7000.0 / 7100.0) * np.array([1.0, 0.0]) + life.state)
        forgetful = replace(life, model_errors=())
        seen = running.until(share * end_s)
        ends = [forecast_end(seen, life=each) for each in (life, forgetful)]
        errors = [abs(each.eod_quantile_s(0.5) / end_s - 1.0) for each in ends]
        assert errors[0] < 0.001 < errors[1]
        # the voltage to come, too, in its median
        middle_s = np.linspace(seen.time_s[-1], share * end_s + 0.8 * (1.0 - share) * end_s, 20)
        measured_V = np.interp(middle_s, running.time_s, running.voltage_V)
        errors_V = [np.abs(np.interp(middle_s, each.time_s, each.voltage_V[1]) - measured_V).max() for each in ends]
        assert errors_V[0] < 0.005 < 0.02 < errors_V[1]

    def test_a_dropout_of_the_logger_is_no_error_of_the_model(self):
        sound = self.discharges[0]
        current_A = np.where(np.arange(len(sound.time_s)) == 80, 0.0, sound.current_A)
        lives = [track_life([each], 2.7) for each in (sound, replace(sound, current_A=current_A))]
        most_V = [np.abs(life.model_errors[0].error_V[20:-20]).max() for life in lives]
        assert most_V[1] == pytest.approx(most_V[0], abs=0.01)

    def test_what_contradicts_is_left_out_and_the_others_count(self):
        first, second, third, fourth = self.discharges
        late = recorded(second, second.time_s > 900.0)
        broken = replace(third, voltage_V=np.where(np.arange(len(third.time_s)) == 50, 2.0, third.voltage_V))
        life = track_life([first, late, broken, fourth.until(2000.0), fourth], cut_off_V=3.2)
        assert life.table["valid"].tolist() == [True, False, False, False, True]
        starts, falls, short = life.table["reason"].iloc[1:4]
        assert "The record starts at 3" in starts and "the voltage falls to 2.00 V" in falls and "not known to 2 %" in short
        assert life.prior_q_mobile_C[0] == pytest.approx(track_life([first, fourth], 3.2).prior_q_mobile_C[0], rel=0.002)
        with pytest.raises(ValueError, match=r"Of 1 of 1: the voltage falls to 2\.00 V"):
            track_life([broken], cut_off_V=3.2)


def partly_charged(soc, charge_V=None, load_A=2.0, rest_rows=20, q_mobile_C=7000.0, seed=0):
    """A discharge from some charge on, after a charge with 1.5 A to some voltage without a taper, if that was recorded."""
    record = simulate(load_A, q_mobile_C, 0.12, load_unit="current", cut_off_V=2.6, initial=initial_state(q_mobile_C, soc=soc))
    time_s = np.arange(-10.0 * rest_rows, record.time_s[-1], 10.0)
    noise_V = 0.002 * np.random.default_rng(seed).standard_normal(len(time_s))
    voltage_V = np.interp(time_s if rest_rows else time_s + 30.0, record.time_s, record.voltage_V) + noise_V
    charge = None if charge_V is None else ChargeBefore(charge_V, 1.5, 1.5, 0.0)
    current_A = np.where(time_s < 0.0, 0.0, load_A)
    return Discharge(time_s - time_s[0], voltage_V, current_A, history=ChargeHistory(charge=charge))


def regular_life(soc, charge_V=None, rest_rows=20, count=5):
    q_C = 7000.0 * np.exp(-0.003 * np.arange(count))
    return [partly_charged(soc, charge_V, 2.0, rest_rows, q_mobile_C, n) for n, q_mobile_C in enumerate(q_C.tolist())]


class TestStart:
    @pytest.mark.parametrize(("charge_V", "rest_rows"), sweep((None, 20), (4.11, 0), (4.11, 20)))
    @pytest.mark.parametrize("soc", sweep(0.88, 0.8, 0.95))
    def test_a_life_that_starts_and_lasts_alike_says_itself_what_is_full(self, soc, charge_V, rest_rows):
        *before, last = regular_life(soc, charge_V, rest_rows)
        life = track_life(before, cut_off_V=2.7)
        start_s, end_s = last.load_on_time_s, last.eod_time_s(2.7)
        seen = last.until(start_s + 0.5 * (end_s - start_s))
        assert life.table["valid"].all() and life.usual_start.voltage_V == pytest.approx(last.voltage_V[0], abs=0.01)
        found = forecast_end(seen, life=life)
        low_s, median_s, high_s = found.eod_quantile_s()
        assert low_s < end_s < high_s and median_s == pytest.approx(end_s, abs=0.02 * (end_s - start_s))
        assert not any("discharges of its life" in note for note in found.notes)

    @pytest.mark.parametrize("rest_rows", sweep(20, 0))
    @pytest.mark.parametrize("soc", sweep(0.72, 1.0))
    def test_one_that_starts_otherwise_is_told_so(self, soc, rest_rows):
        life = track_life(regular_life(0.86, None, rest_rows), cut_off_V=2.7)
        running = partly_charged(soc, None, 2.0, rest_rows).until(1500.0)
        notes = " ".join(forecast_end(running, life=life).notes)
        assert "where the discharges of its life, or of its fit, do at" in notes and "fit constants" not in notes
        assert track_life([*regular_life(0.86, None, rest_rows), running], 2.7).table["valid"].iloc[-1] == np.False_

    @pytest.mark.parametrize("charge_V", sweep(4.11, 3.98))
    def test_at_another_load_without_a_rest_the_charge_before_tells(self, charge_V):
        life = track_life(regular_life(0.88, 4.11, 0), cut_off_V=2.7)
        running = partly_charged(0.88, charge_V, 3.0, 0).until(1000.0)
        notes = " ".join(forecast_end(running, life=life).notes)
        assert ("discharges of its life" in notes) == (charge_V != 4.11)

    def test_a_life_that_starts_or_lasts_otherwise_each_time_tells_nothing(self):
        starts = [partly_charged(soc, seed=n) for n, soc in enumerate((0.95, 0.8, 0.7, 0.6))]
        with pytest.raises(ValueError, match="a full cell at rest shows"):
            track_life(starts, cut_off_V=2.7)
        lasts = [partly_charged(0.88, q_mobile_C=q_C) for q_C in (7000.0, 6000.0, 7000.0, 6000.0)]
        with pytest.raises(ValueError, match="a full cell at rest shows"):
            track_life(lasts, cut_off_V=2.7)

    @pytest.mark.parametrize(("charge_V", "rest_rows"), sweep((None, 20), (4.11, 0)))
    def test_no_fit_rejects_its_own_discharges(self, charge_V, rest_rows, recwarn):
        own = regular_life(0.88, charge_V, rest_rows, count=2)
        fit = fit_cell(own)
        for each in (*own, regular_life(0.88, charge_V, rest_rows)[-1]):
            found = calibrate(each, cell=fit)
            assert "tarts at" not in found.reason and found.capacity_Ah == pytest.approx(found.drawn_Ah)
            assert "tarts at" not in fit.calibrator().estimate(each.loaded_part(2.7)).reason
        lower = calibrate(partly_charged(0.7, None, 2.0, rest_rows), cell=fit)
        assert "where the discharges of its life, or of its fit, do at" in lower.reason and np.isnan(lower.capacity_Ah)
        # a fit of an older release does not tell
        old = replace(fit, usual_start=None)
        assert calibrate(own[0], cell=old).reason != calibrate(own[0], cell=fit).reason or not charge_V

    def test_bundled_lives_start_as_full_cells_do(self):
        for cell in ("B0005", "B0006"):
            life = load_nasa_discharges(cell)[:40:8]
            known = track_life(life, 2.7)
            assert known.usual_start.voltage_V == pytest.approx(4.19, abs=0.02) and known.table["valid"].all()
