"""Forecasts are the model's where everything is known, and as wide as what is not known where it is not."""

import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from battery_env import NEW_CELL, Estimate, RecordModel, forecast, initial_state, load_nasa_discharges, simulate, track_life
from battery_env.__main__ import calibrate
from battery_env.electrochemistry.cell import new_cell_of
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.electrochemistry.model_error import UNFITTED_ERROR_RATIO
from battery_env.estimates import Finding
from battery_env.lab.calibrate import calibrate as calibrate_record
from battery_env.lab.running import calibrate_running, forecast_end, read_load
from battery_env.lab.settings import Settings
from battery_env.loads import BlockBootstrap, Cycle, Load, RandomPiecewise, constant, steadier_unit
from battery_env.records import Samples, resample_current
from tests.records import recorded, table_of
from tests.sweeps import sweep
from tests.terminal import write

TRUTH = Estimate(6000.0, 0.15)
# short discharges of few steps
MODEL = RecordModel(dt_s=4.0)


def discharged(load, q_mobile=6000.0, r_o=0.15, **keywords):
    return simulate(load, q_mobile, r_o, dt=4.0, **keywords)


def half(record):
    return record.part(0, len(record.time_s) // 2)


HALF = half(discharged(4.0, load_unit="current"))


def certain(record, load=None, **keywords):
    return forecast(record, TRUTH, load, model=MODEL, mismatch_V=0.0, samples=3, **keywords)


class TestLoads:
    @pytest.mark.parametrize("cut_off_V", [3.2, 2.7])
    def test_a_constant_current_is_the_forecast_of_the_model(self, cut_off_V):
        found = certain(HALF, cut_off_V=cut_off_V)
        assert found.load_name == "4 A"
        np.testing.assert_allclose(found.eod_time_s, MODEL.forecast(HALF, TRUTH, cut_off_V).eod_time_s, atol=1e-6)

    def test_a_recorded_cell_ends_at_the_same_voltage_as_everywhere(self):
        found = forecast(HALF, TRUTH, samples=3)
        assert found.cut_off_V == Settings().resolved.cut_off_V == 2.7

    def test_a_known_profile_ends_when_the_cell_does(self):
        record = discharged(RandomPiecewise((4.0, 12.0))(np.random.default_rng(3)))
        last = len(half(record).time_s) - 1
        found = certain(half(record), Load(record.time_s[last:] - record.time_s[last], record.load[last:], record.load_unit))
        assert (np.abs(found.eod_time_s - record.eod_time_s) <= 8.0).all()

    def test_function_cycle_and_profile_are_the_same_load(self):
        record = half(discharged(8.0))
        cycle = Cycle(Load([0.0, 40.0], [12.0, 4.0]), 80.0)
        starts_s = 40.0 * np.arange(200)
        profile = Load(starts_s, np.where(np.arange(200) % 2 == 0, 12.0, 4.0))
        ends_s = [certain(record, load, load_unit="power").eod_time_s[0] for load in (cycle, profile, cycle.__call__)]
        assert len(set(ends_s)) == 1
        number_s = certain(record, 8.0, load_unit="power").eod_time_s[0]
        assert number_s == certain(record, constant(8.0)).eod_time_s[0] != ends_s[0]

    def test_pulses_shorter_than_a_step_draw_what_they_do(self):
        record = half(discharged(3.0, load_unit="current"))
        pulses, mean = (certain(record, load) for load in (Cycle(Load([0.0, 1.5, 2.5], [2.0, 6.0, 2.0], "current"), 4.0), 3.0))
        np.testing.assert_allclose(pulses.remaining_s, mean.remaining_s, rtol=0.05)
        assert pulses.nominal_Ah == pytest.approx(mean.nominal_Ah, rel=0.02)

    def test_pulses_go_on_as_pulses(self):
        pulses_A = np.where(np.arange(4000) % 30 < 15, 4.0, 0.0)
        record = discharged(pulses_A, load_unit="current")
        found = forecast(half(record), TRUTH, model=MODEL, mismatch_V=0.0, samples=60)
        median_s = found.eod_quantile_s(0.5)
        # where blocks meet, a pulse may be longer than it was
        assert median_s == pytest.approx(record.eod_time_s, rel=0.05)
        assert "The load varied" in found.summary()
        # the last current for ever, or the mean of the pulses, misses by more
        last_s = MODEL.forecast(half(record), TRUTH, None, 4.0).eod_time_s
        assert abs(last_s - record.eod_time_s) > 5.0 * abs(median_s - record.eod_time_s)

    def test_a_charge_on_the_way_comes_on_top_and_one_beyond_full_is_refused(self):
        back = Load([0.0, 300.0], [-1.0, 4.0], "current")
        whole = discharged(np.append(HALF.load[:-1], back(4.0 * np.arange(400))), load_unit="current")
        assert (np.abs(certain(HALF, back).eod_time_s - whole.eod_time_s) <= 4.0).all()
        beyond = Load([0.0, 3600.0], [-2.0, 4.0], "current")
        # 2 A bring back what 4 A took in twice the time
        after_s = 2.0 * HALF.time_s[-1] + 0.01 * 6000.0 / 2.0
        with pytest.raises(ValueError, match="beyond full, by more than 1% of its charge, after") as refused:
            certain(HALF, beyond)
        assert float(re.search(r"after (\d+) s", str(refused.value))[1]) == pytest.approx(after_s, abs=8.0)

    def test_under_a_charge_or_without_a_load_there_is_no_end(self):
        found = certain(HALF, -2.0)
        assert np.isinf(found.eod_time_s).all() and np.isnan(found.nominal_Ah)
        current_A = np.where(np.arange(300) < 60, 4.0, 0.0)
        found = certain(discharged(current_A, load_unit="current"))
        assert np.isinf(found.eod_quantile_s()).all() and np.isinf(found.remaining_s).all()
        assert np.isnan(found.state_of_health).all() and "inf" in found.summary()
        found.plot()


def test_health_is_not_that_of_a_single_draw():
    load = RandomPiecewise((1.0, 6.0), (600.0, 2400.0), unit="current")
    settings = {"model": MODEL, "mismatch_V": 0.0, "samples": 100}
    nominal_Ah = [forecast(HALF, TRUTH, load, seed=seed, **settings).nominal_Ah for seed in range(5)]
    assert np.ptp(nominal_Ah) < 0.06 * np.mean(nominal_Ah)  # of single draws a third


class TestUncertainty:
    def width(self, estimate, load=None, **keywords):
        low_s, _, high_s = forecast(HALF, estimate, load, model=MODEL, samples=400, **keywords).eod_quantile_s()
        return high_s - low_s

    def test_the_interval_is_as_wide_as_what_is_not_known(self):
        narrow, wide = (self.width(Estimate(6000.0, 0.15, sd, 0.0), mismatch_V=0.0) for sd in (60.0, 120.0))
        # the end of discharge is nearly in proportion to q_mobile: 3.3 sd of 1 % of it
        assert narrow == pytest.approx(3.29 * 0.01 * discharged(4.0, load_unit="current").eod_time_s, rel=0.2)
        assert wide == pytest.approx(2.0 * narrow, rel=0.1)
        assert narrow == self.width(Estimate(6000.0, 0.15, 60.0, 0.0), mismatch_V=0.0)  # the same seed
        assert self.width(Estimate(6000.0, 0.15, 60.0, 0.0), mismatch_V=0.1) > 1.2 * narrow
        assert self.width(Estimate(6000.0, 0.15, 60.0, 0.0), RandomPiecewise((4.0, 16.0)), mismatch_V=0.0) > 1.2 * narrow

    def test_a_resistance_that_is_not_known_counts_under_another_load_only(self):
        unknown, known = Estimate(6000.0, 0.15, 60.0, 0.03), Estimate(6000.0, 0.15, 60.0, 0.0)
        assert self.width(unknown) < 1.2 * self.width(known)
        assert self.width(unknown, 8.0) > 1.5 * self.width(known, 8.0)

    def test_what_a_resistance_absorbed_of_the_error_of_the_model_comes_out_under_another_load(self):
        error_ohm = 0.05 / 4.0
        unsure = Estimate(6000.0, 0.15, 0.0, error_ohm)
        # at the load of the record the voltage makes up for a larger resistance, and at a lighter one for too much
        low_s, high_s = (
            forecast(HALF, Estimate(6000.0, r_o), 1.0, model=MODEL, mismatch_V=0.05, samples=400).eod_quantile_s(0.5)
            for r_o in 0.15 + error_ohm * np.array([-1.0, 1.0])
        )
        own_s = 3.29 * 0.5 * (high_s - low_s)
        # beside what the estimate states, however sure that is
        absorbed_s = np.sqrt(UNFITTED_ERROR_RATIO**2 - 1.0) * own_s
        sure_s = self.width(TRUTH, 1.0, mismatch_V=0.05)
        assert absorbed_s < sure_s < 1.5 * absorbed_s
        assert self.width(unsure, 1.0, mismatch_V=0.05) == pytest.approx(np.hypot(own_s, sure_s), rel=0.1)
        assert self.width(unsure, mismatch_V=0.05) == pytest.approx(self.width(TRUTH, mismatch_V=0.05), rel=0.1)
        # what is told of the resistance is the estimate
        assert forecast(HALF, unsure, 8.0, model=MODEL).r_o.std() == pytest.approx(error_ohm, rel=0.1)

    def test_an_offset_that_the_record_shows_goes_on(self):
        higher = Samples(HALF.time_s, HALF.voltage_V + 0.05, HALF.current_A)
        found = forecast(higher, TRUTH, cut_off_V=3.2, model=MODEL, mismatch_V=0.02, samples=200)
        lower_s = MODEL.forecast(HALF, TRUTH, 3.2 - 0.05).eod_time_s
        assert found.eod_quantile_s(0.5) == pytest.approx(lower_s, rel=0.01)
        assert lower_s > 1.01 * MODEL.forecast(HALF, TRUTH, 3.2).eod_time_s

    def test_a_cell_in_progress_ends_after_its_record_however_low_its_model_came_before(self):
        current_A = np.where(np.arange(750) % 25 < 3, 6.0, 1.0)
        record = discharged(current_A, r_o=0.10, load_unit="current", cut_off_V=3.0)
        found = forecast(record, TRUTH, 1.0, 3.2, model=MODEL, mismatch_V=0.0, samples=3)
        assert MODEL.forecast(record, TRUTH, 3.2, 1.0).eod_time_s < record.time_s[-1] - 90.0
        assert (found.eod_time_s > record.time_s[-1] + 500.0).all()

    def test_samples_agree_with_the_record(self):
        whole = discharged(4.0, load_unit="current")
        late = whole.part(0, int(0.97 * len(whole.time_s)))
        found = forecast(late, Estimate(5600.0, 0.15, 200.0, 0.0), model=MODEL, mismatch_V=0.0, samples=200)
        assert (found.eod_time_s >= late.time_s[-1]).all()
        assert found.q_mobile.min() > 5750.0  # those below would have reached the cut-off
        assert "contradicts" in found.notes[-1]

    def test_what_is_left_out_is_said(self):
        assert ["leaves theirs out" in note for note in certain(HALF).notes] == [True]
        unsettled = Estimate(6000.0, 0.15, 60.0, 0.03, False, (Finding("misfit"),))
        assert "The voltage of the model is farther off" in forecast(HALF, unsettled, model=MODEL, samples=5).summary()


@pytest.mark.parametrize("q_mobile", [2000.0, 6000.0, 20000.0])
@pytest.mark.parametrize("sd_C", [0.0, np.nan, 10.0, 500.0, 3000.0, 1e6, np.inf])
def test_what_is_known_of_a_cell_narrows_an_estimate_to_it(q_mobile, sd_C):
    low_C, high_C, estimate = 5000.0, 7000.0, Estimate(q_mobile, 0.1, sd_C, 0.01)
    told = estimate.within(low_C, high_C)
    if not 0.0 < sd_C < np.inf:
        assert told is estimate
        return
    assert low_C <= told.q_mobile <= high_C and 0.0 <= told.sd_q_mobile <= sd_C
    if sd_C == 10.0 and q_mobile == 6000.0:
        assert (told.q_mobile, told.sd_q_mobile) == pytest.approx((q_mobile, sd_C))
    if sd_C == 1e6:  # nothing was known but that
        assert told.q_mobile == pytest.approx(np.sqrt(low_C * high_C), rel=0.01)
        assert told.sd_q_mobile / told.q_mobile == pytest.approx(np.log(high_C / low_C) / np.sqrt(12.0), rel=0.01)


class TestHealth:
    def test_a_new_cell_is_in_full_health(self):
        whole = simulate(4.0, dt=4.0, load_unit="current")
        truth = Estimate(7600.0, whole.r_o)
        found = forecast(half(whole), truth, model=MODEL, mismatch_V=0.0, samples=3)
        np.testing.assert_allclose(found.state_of_health, 1.0, rtol=5e-3)
        np.testing.assert_allclose(found.capacity_Ah, 4.0 * whole.eod_time_s / 3600.0, rtol=5e-3)
        given = forecast(half(whole), truth, model=MODEL, mismatch_V=0.0, samples=3, nominal_Ah=2.0)
        np.testing.assert_allclose(given.state_of_health, given.capacity_Ah / 2.0)

    def test_charge_that_is_left_is_what_was_not_drawn(self):
        np.testing.assert_allclose(certain(HALF).soc, 1.0 - 4.0 * HALF.time_s[-1] / 6000.0, rtol=1e-9)

    def test_a_cell_that_starts_partly_charged_is_as_healthy(self):
        full, partly = (
            half(discharged(4.0, load_unit="current", initial=initial_state(6000.0, soc=soc))) for soc in (1.0, 0.5)
        )
        found = forecast(partly, TRUTH, model=RecordModel(dt_s=4.0, initial_soc=0.5), mismatch_V=0.0, samples=3)
        # not the same, as at 4 A a shorter discharge leaves less behind by diffusion
        np.testing.assert_allclose(found.state_of_health, certain(full).state_of_health, rtol=0.04)

    def test_a_record_at_the_cut_off_is_over(self):
        record = discharged(4.0, load_unit="current", cut_off_V=2.9)
        found = certain(record, cut_off_V=3.0)
        np.testing.assert_allclose(found.eod_time_s, MODEL.forecast(record, TRUTH, 3.0).eod_time_s)
        assert (found.remaining_s == 0.0).all()
        found.plot()

    @pytest.mark.parametrize(
        ("keywords", "message"),
        [
            ({"estimate": Estimate(2000.0, 0.15, 10.0, 0.0)}, "contradicts the record, which takes"),
            ({"estimate": Estimate(2890.0, 0.15, 0.0, 0.0), "mismatch_V": 0.0}, "contradicts the record: no cell"),
            ({"estimate": Estimate(6000.0, 0.15, np.inf, 0.0)}, "determines nothing"),
            ({"load": [1.0, 2.0]}, r"Load\(time_s, value, unit\)"),
            ({"load": "as before"}, "load must be a number"),
            ({"load": lambda time_s: np.ones(3)}, "one value for each time"),
            ({"mismatch_V": -0.1}, "mismatch_V must"),
            ({"cut_off_V": np.nan}, "cut_off_V must"),
            ({"nominal_Ah": 0.0}, "nominal_Ah must"),
        ],
    )
    def test_what_cannot_be_meant_is_refused(self, keywords, message):
        with pytest.raises((TypeError, ValueError), match=message):
            forecast(**({"record": HALF, "estimate": TRUTH, "model": MODEL, "samples": 3} | keywords))


@pytest.mark.parametrize("unit", ["current", "power"])
def test_the_steadier_unit_is_the_one_of_the_consumer(unit):
    value_range = {"current": (1.0, 4.0), "power": (4.0, 12.0)}[unit]
    record = discharged(RandomPiecewise(value_range, unit=unit)(np.random.default_rng(0)), load_unit=unit)
    noise_V = 0.005 * np.random.default_rng(1).standard_normal(len(record.time_s))
    assert steadier_unit(Samples(record.time_s, record.voltage_V + noise_V, record.current_A)) == unit


def test_a_cycle_starts_again_at_every_period():
    cycle = Cycle(Load([0.0, 0.1], [3.0, 1.0], "current"), 0.3)
    assert cycle.unit == "current"
    np.testing.assert_array_equal(cycle(0.3 * np.arange(1000)), 3.0)
    np.testing.assert_array_equal(cycle(0.3 * np.arange(1000) + 0.2), 1.0)


class TestBlockBootstrap:
    time_s = np.arange(601.0)
    # rest first; every value occurs once
    current_A = np.where(time_s < 100.0, 0.0, time_s / 100.0)
    record = Samples(time_s, np.full(601, 3.7), current_A)

    def test_blocks_of_the_record_follow_each_other(self):
        drawn = BlockBootstrap(self.record, block_s=50.0)(np.random.default_rng(0))
        values = drawn(np.arange(2000.0)).reshape(-1, 50)
        recorded = resample_current(self.time_s, self.current_A, 1.0, 600)[100:]
        assert np.isclose(values[:, :, None], recorded, atol=0.011).any(axis=2).all()
        steps = np.diff(values, axis=1)
        # a block runs through the record, and over its end to its start
        assert (np.isclose(steps, 0.01, atol=1e-3) | (steps < -4.0)).all()
        assert len(set(values[:, 0])) <= 10  # as many as fit into the record
        np.testing.assert_array_equal(drawn(np.arange(2000.0)[::-1]), values.ravel()[::-1])

    def test_its_mean_is_as_unsure_as_the_record_makes_it(self):
        rng = np.random.default_rng(1)
        current_A = 2.0 + np.repeat(rng.standard_normal(61), 10)[:601] * 0.5
        noisy = Samples(self.time_s, self.record.voltage_V, current_A)
        sampler = BlockBootstrap(noisy, block_s=10.0)
        means_A = [sampler(rng)(np.arange(600.0)).mean() for _ in range(400)]
        assert np.mean(means_A) == pytest.approx(noisy.current_A.mean(), abs=0.02)
        # of the record that was seen and of the one to come, both 60 blocks long
        assert np.std(means_A) == pytest.approx(np.sqrt(2.0 / 60.0) * noisy.current_A.std(), rel=0.2)

    def test_a_record_without_load_is_refused(self):
        with pytest.raises(ValueError, match="no current flows"):
            BlockBootstrap(Samples(self.time_s, self.record.voltage_V, np.zeros(601)))
        with pytest.raises(ValueError, match="block_s must be at most half of the"):
            BlockBootstrap(self.record, block_s=400.0)


class TestCommand:
    discharges = load_nasa_discharges("B0006")[70:81]
    end_s = discharges[10].eod_time_s(2.7)

    @pytest.fixture(autouse=True)
    def files(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("lab").mkdir()
        tables = [
            table_of(each, cycle=n)
            for n, each in enumerate([*self.discharges[:10], self.discharges[10].until(1200.0)], start=1)
        ]
        pd.concat(tables).to_csv("all.csv", index=False)
        pd.concat(tables[:10]).to_csv("lab/life.csv", index=False)
        tables[10].drop(columns="cycle").to_csv("running.csv", index=False)
        Path("lab/notes.txt").write_text("moved to channel 4")
        Path("profile.csv").write_text("time_s;current_A\n0;1.0\n600;3.0\n")

    def test_two_cells_are_not_one_life_without_a_word(self, capsys):
        Path("other").mkdir()
        Path("lab/life.csv").rename("other/life.csv")
        pd.read_csv("other/life.csv").query("cycle < 3").to_csv("lab/life.csv", index=False)
        assert calibrate(["forecast", "running.csv", "--life", "lab", "other"]) == 0
        assert "the records of lab, other are taken for one cell's" in capsys.readouterr().err

    def test_life_and_load_give_the_end_that_python_gives(self, capsys, terminal):
        Path("running.csv").rename("run_2.5A.csv")
        assert calibrate(["forecast", "run_2.5A.csv", "--life", "lab", "--load", "profile.csv", "--out", "out"]) == 0
        shown = capsys.readouterr()
        assert "life of 10 earlier discharges" in shown.out and "then a given load" in shown.out and "health" not in shown.out
        assert "notes.txt is left out" in shown.err
        written = terminal.row("forecast", "run_2.5A.csv", "--life", "lab", "--load", "profile.csv")
        life = track_life(self.discharges[:10], 2.7)
        # another load than that of the life, up to 3 A
        prior_C = life.prior_for(self.discharges[10].until(1200.0), read_load("profile.csv"))
        assert written["prior_q_mobile_C"] == pytest.approx(prior_C, rel=1e-6)
        known = Settings(prior_q_mobile_C=tuple(written["prior_q_mobile_C"]))
        seen = self.discharges[10].until(1200.0)
        again = forecast_end(seen, known, read_load("profile.csv"))
        assert written["eod_time_s"] == pytest.approx(again.eod_quantile_s(), abs=2.0)
        # the charge that 2 A draw until the end, and what is over at once under 3 A
        assert written["eod_time_s"][1] < 1800.0 + (2.0 * (self.end_s - 1200.0) - 600.0) / 3.0
        assert Path("out/run_2.5A_forecast.png").read_bytes().startswith(b"\x89PNG")
        refused = terminal.refuses("forecast", "run_2.5A.csv", "--out", "out")
        assert "out/run_2.5A_forecast.png would be replaced" in refused

    @pytest.mark.parametrize("size", sweep(0.3, 0.05, 2.5, 10.0, 100.0))
    @pytest.mark.parametrize("share", sweep(0.5, 0.25, 0.75))
    def test_a_nominal_capacity_tells_what_a_cell_of_another_size_holds(self, size, share):
        cell = with_equilibrium(new_cell_of(size * NEW_CELL.q_mobile).replace(kn=800.0), [-0.03, 0.02, 0.05])
        made = simulate(2.0 * size, 6800.0 * size, 0.1 / size, load_unit="current", cell=cell, cut_off_V=2.7)
        seen, end_s = recorded(made, slice(None, None, 10)).until(share * made.time_s[-1]), made.time_s[-1]
        settings = Settings(nominal_Ah=2.0 * size)
        low_s, median_s, high_s = forecast_end(seen, settings).eod_quantile_s()
        found = calibrate_record(seen, settings)
        assert not found.settled and "prior" not in found.reason  # which nobody has stated
        assert low_s < end_s < high_s and abs(median_s / end_s - 1.0) < 0.25

    @pytest.mark.parametrize("size", sweep(5.0, 1.0, 2.5, 10.0))
    @pytest.mark.parametrize("rate", sweep(1.0, 0.3))
    def test_of_a_larger_cell_that_is_not_stated_nobody_is_sure(self, size, rate):
        cell = new_cell_of(size * NEW_CELL.q_mobile)
        made = simulate(2.0 * rate * size, 6800.0 * size, 0.15 / size, load_unit="current", cell=cell, thermal=True)
        for share in (0.1, 0.25, 0.5, 0.75):
            found = calibrate_record(recorded(made, slice(None, None, 10)).until(share * made.time_s[-1]))
            # 5 to hundreds, were a prior around a new 18650 all that there is
            assert abs(found.predicted_eod_time_s - made.time_s[-1]) < 4.0 * found.sd_predicted_eod_time_s, share

    def test_a_life_tells_more_of_its_own_load_than_of_any_other(self):
        life, running = track_life(self.discharges[:10], 2.7), self.discharges[10].until(1200.0)
        own, other = life.prior_q_mobile_C, life.prior_at_other_loads_C
        assert own[1] < other[1]
        loads = {None: own, 2.0: own, constant(2.0, "current"): own, constant(8.0, "power"): other}
        for load, expected in loads.items():
            assert life.prior_for(running, load) == pytest.approx(expected, rel=1e-3)
        assert life.prior_for(running, lambda time_s: 2.0) == pytest.approx(other, rel=1e-3)

    def test_a_life_leaves_the_resistance_to_the_record(self):
        life, running = track_life(self.discharges[:10], 2.7), self.discharges[10].until(1200.0)
        with_life, alone = calibrate_running(running, Settings(), life=life), calibrate_record(running)
        assert with_life.sd_q_mobile_C < 0.1 * alone.sd_q_mobile_C
        for name in ("resistance_10s_ohm", "sd_resistance_10s_ohm"):
            assert getattr(with_life, name) == pytest.approx(getattr(alone, name), rel=0.01)
        assert with_life.settled_resistance_10s and not with_life.settled
        low_ohm, median_ohm, high_ohm = np.quantile(with_life.end.resistance_10s_ohm, [0.05, 0.5, 0.95])
        assert median_ohm == pytest.approx(alone.resistance_10s_ohm, rel=0.01)
        assert high_ohm - low_ohm == pytest.approx(3.3 * alone.sd_resistance_10s_ohm, rel=0.1)

    def test_the_farther_a_load_is_from_that_of_the_life_the_less_its_constants_tell(self):
        life, running = track_life(self.discharges[:3], 2.7), self.discharges[10].until(1200.0)
        for loads_A in ((2.5, 4.0, 8.0), (1.5, 0.5, 0.1)):
            sds_C = [life.prior_for(running, load_A)[1] for load_A in loads_A]
            assert life.prior_at_other_loads_C[1] < sds_C[0] < sds_C[1] < sds_C[2]

    def test_the_gain_of_the_current_sensor_cancels_from_the_end_and_not_from_the_charge(self):
        life, running = track_life(self.discharges[:10], 2.7), self.discharges[10].until(1200.0)
        sound, scaled = (forecast_end(running, Settings(current_gain_sd=sd), life=life) for sd in (0.0, 0.02))
        assert np.ptp(scaled.eod_quantile_s()) == pytest.approx(np.ptp(sound.eod_quantile_s()), rel=0.02)
        assert np.std(scaled.q_mobile / scaled.q_mobile.mean()) > 0.018 > 1.5 * np.std(sound.q_mobile / sound.q_mobile.mean())

    def test_a_sparse_life_is_as_unsure_as_the_fade_and_says_so(self, terminal):
        running = load_nasa_discharges("B0006")[79]
        write(running.until(1300.0), "sparse.csv")
        pd.read_csv("sparse.csv").assign(cycle=80).to_csv("sparse.csv", index=False)
        row = terminal.row("forecast", "sparse.csv", "--life", "B0006:1", "B0006:40")
        low_s, _, high_s = row["eod_time_s"]
        assert low_s < running.eod_time_s(2.7) < high_s and row["discharges_after_life"] == 40
        said = terminal.shows("forecast", "sparse.csv", "--life", "B0006:1", "B0006:40")
        assert "life of 2 earlier discharges; the last one is 40 before this one" in said

    def test_of_its_own_folder_only_what_came_before_counts(self, terminal):
        table = pd.read_csv("all.csv")
        Path("folder").mkdir()
        for number, cycle in table.groupby("cycle"):
            cycle.drop(columns="cycle").to_csv(f"folder/{number}.csv", index=False)
        table.query("cycle == 6 and time_s < 1200").drop(columns="cycle").to_csv("folder/6.csv", index=False)
        assert terminal.row("forecast", "folder/6.csv", "--life", "folder")["life_discharges"] == 5

    def test_of_its_own_file_only_what_came_before_counts(self, terminal):
        apart, together = (
            terminal.row("forecast", *names) for names in (("running.csv", "--life", "lab"), ("all.csv", "--life", "all.csv"))
        )
        assert together["record"] == "all_011" and together["life_discharges"] == 10
        assert together["eod_time_s"] == pytest.approx(apart["eod_time_s"], rel=1e-3)
        assert together["eod_time_s"][1] == pytest.approx(self.end_s, rel=0.02)
        wide = terminal.row("forecast", "running.csv", "--life", "lab", "--load", "profile.csv")
        assert together["prior_q_mobile_C"][1] < 0.8 * wide["prior_q_mobile_C"][1]

    def test_without_a_life_the_interval_is_wide(self, terminal):
        alone, carried = (terminal.row("forecast", "running.csv", *prior) for prior in ((), ("--prior", "5600", "60")))
        low_s, _, high_s = alone["eod_time_s"]
        assert low_s < self.end_s < high_s and high_s - low_s > 5.0 * np.ptp(carried["eod_time_s"])
        assert alone["prior_q_mobile_C"] is None and alone["state_of_health"] == [None] * 3
        assert any("cell of some 2 Ah" in note for note in alone["notes"])
        assert not any("2 Ah" in note for note in carried["notes"])
        assert 0.6 < terminal.row("forecast", "running.csv", "--nominal", "2")["state_of_health"][1] < 0.9

    @pytest.mark.parametrize(
        "options", ["", *sweep("--prior 5460 55", "--cut-off 3.2", "--initial-soc 0.98,0.01 --nominal 2")]
    )
    @pytest.mark.parametrize("name", sweep("running.csv", "pulsed.csv"))
    def test_both_commands_give_one_end(self, name, options, terminal):
        pulses = simulate(np.tile([3.0, 1.0], 2000).repeat(30), 6500.0, 0.12, load_unit="current", thermal=True, until=2000.0)
        write(pulses, "pulsed.csv")
        end = terminal.row("forecast", name, *options.split())
        row = terminal.row(name, *options.split(), status=3)
        low_s, median_s, high_s = end["eod_time_s"]
        assert row["predicted_eod_time_s"] == median_s and row["remaining_s"] == end["remaining_s"][1]
        assert row["predicted_capacity_Ah"] == end["capacity_Ah"][1]
        assert row["sd_predicted_eod_time_s"] == pytest.approx((high_s - low_s) / 3.29)

    def test_a_pause_at_the_end_and_a_poor_model_are_noted(self, terminal):
        table = pd.read_csv("running.csv")
        rest = table.tail(1).assign(current_A=0.0)
        rest = pd.concat([rest.assign(time_s=rest["time_s"] + since_s) for since_s in (60.0, 120.0)])
        pd.concat([table, rest]).to_csv("paused.csv", index=False)
        known = ("--prior", "5460", "55")
        plain, paused = (terminal.row("forecast", name, *known)["notes"] for name in ("running.csv", "paused.csv"))
        assert [note for note in paused if note not in plain] == [
            f"What was recorded after the last sample under load, at {table['time_s'].iloc[-1]:.0f} s, is left out."
        ]
        held = ("--load", "profile.csv", "--mismatch", "0.01")
        sure = terminal.row("forecast", "running.csv", *known, *held, status=3)["notes"]
        assert any("more than mismatch_V" in note for note in sure) and not any("mismatch_V." in note for note in plain)

    def test_a_record_that_contradicts_its_estimate_has_its_own_status(self, terminal):
        late = pd.read_csv("running.csv").query("time_s > 400")
        late.to_csv("late.csv", index=False)
        row = terminal.row("forecast", "late.csv", "--life", "lab", status=3)
        assert row["settled"] is False and "The record starts at 3" in row["notes"][0]

    def test_the_installed_command_has_the_others_behind_it(self, capsys, monkeypatch):
        monkeypatch.setattr(sys, "argv", ["battery-calibrate", "forecast", "running.csv"])
        assert calibrate() == 0
        assert "remaining time (s)" in capsys.readouterr().out
        assert calibrate(["fit", "running.csv", "--out", "cell.txt"]) == 2
        assert calibrate(["running.csv"]) == 3

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["running.csv", "--life", "running.csv"], "running.csv: no discharge before running.csv"),
            (["running.csv", "--life", "lab", "--prior", "5000", "50"], "give one of them"),
            (["B0006:81", "--life", "B0005", "lab"], "discharges of B0005 and B0006: give those of the cell in progress"),
            (["lab"], "lab holds 2 files"),
            (["lab/life.csv"], "reaches 2.7 V at"),
            (["running.csv", "--load", "lab/notes.txt"], "columns time_s and either current_A or power_W, got moved"),
            (["running.csv", "--load", "late.csv"], "late.csv: start_s must be finite and increase from 0"),
            (["running.csv", "--load", "charge.csv"], "current_A is nowhere above 0"),
            (["running.csv", "--load", "empty.csv"], "empty.csv: no table"),
            (["running.csv", "--load", "none.csv"], "none.csv"),
            (["running.csv", "--out", "running.csv"], "running.csv is a file"),
        ],
    )
    def test_what_cannot_be_meant_is_refused_and_nothing_is_written(self, arguments, message, terminal):
        Path("late.csv").write_text("time_s,power_W\n10,4\n20,5\n")
        Path("charge.csv").write_text("time_s,current_A\n0,-1.0\n600,-3.0\n")
        Path("empty.csv").touch()
        before = sorted(Path().rglob("*"))
        assert message in terminal.refuses("forecast", *arguments)
        assert sorted(Path().rglob("*")) == before
