"""A cell over its discharges: what is carried on is as sure as it says."""

import numpy as np
import pandas as pd
import pytest

from battery_env import Discharge, LeastSquares, Settings, load_nasa_discharges, track_life
from battery_env.lab.life import life_of


def followed(q_mobile_C, **columns):
    table = pd.DataFrame({"q_mobile_C": q_mobile_C, "valid": True, "reason": ""})
    known = {"cycle": np.arange(len(table)) + 1, "capacity_Ah": table["q_mobile_C"] / 3780.0, "lasted_share": 1.0}
    return life_of(table.assign(**{**known, **columns}))


def walk(seed, count=150, step=0.01, noise=0.002, drift=-0.002):
    rng = np.random.default_rng(seed)
    level = np.cumsum(drift + step * rng.standard_normal(count))
    return 7000.0 * np.exp(level + noise * rng.standard_normal(count))


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
        reasons = ["It rests at 3.85 V.", "Cut at 2.90 V.", "Cut at 2.80 V."]
        with pytest.raises(ValueError, match=r"no discharge determines q_mobile\. Of 2 of 3: Cut at 2\.90 V\."):
            followed(walk(2, 3), valid=False, reason=reasons)
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
        pd.testing.assert_frame_equal(by_default.table, held.table)
        # free constants explain a part of the error, and which they are is one more doubt
        np.testing.assert_allclose(unsure.table["q_mobile_C"], held.table["q_mobile_C"], rtol=0.002)
        assert by_default.sd_share == unsure.sd_share == by_default.after(2).sd_share > 1.2 * held.sd_share

    def test_what_contradicts_is_left_out_and_the_others_count(self):
        first, second, third, fourth = self.discharges
        late = Discharge(*(column[second.time_s > 900.0] for column in (second.time_s, second.voltage_V, second.current_A)))
        dip = np.where(np.arange(len(third.time_s)) == 50, 2.0, third.voltage_V)
        broken = Discharge(third.time_s, dip, third.current_A)
        life = track_life([first, late, broken, fourth.until(2000.0), fourth], cut_off_V=3.2)
        assert life.table["valid"].tolist() == [True, False, False, False, True]
        starts, falls, short = life.table["reason"].iloc[1:4]
        assert "The record starts at 3" in starts and "the voltage falls to 2.00 V" in falls and "not known to 2 %" in short
        assert life.prior_q_mobile_C[0] == pytest.approx(track_life([first, fourth], 3.2).prior_q_mobile_C[0], rel=0.002)
        with pytest.raises(ValueError, match=r"Of 1 of 1: the voltage falls to 2\.00 V"):
            track_life([broken], cut_off_V=3.2)
