"""Constants of a cell are found, or stay where they were, and come with an honest uncertainty."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.polynomial import Legendre

from battery_env import CellParameters, Estimate, LeastSquares, fit_cell, forecast
from battery_env.electrochemistry import NEW_CELL, initial_state, simulate, voltage
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.electrochemistry.model_error import UNFITTED_ERROR_RATIO
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.estimators.cell_fit import CellFit, read_cell
from battery_env.estimators.joint_fit import EQUILIBRIUM_PRIOR_SD_V, JointFit
from battery_env.estimators.priors import RATE_PRIOR_SD
from battery_env.estimators.search import JointSearch
from battery_env.lab.calibrate import calibrate
from battery_env.lab.running import forecast_end
from battery_env.lab.settings import Settings
from battery_env.loads import RandomPiecewise
from battery_env.loads import constant as constant_load
from battery_env.records import ChargeBefore, DischargeStart
from battery_env.records.discharge import Discharge, load_nasa_discharges
from tests.records import recorded
from tests.sweeps import sweep

FIELDS = ("cell", "constants", "discharges", "mismatch_V", "thermal")
TOO_LARGE = '{"format": "battery_env.CellParameters", "version": 1, "constants": {"kn": 1' + 400 * "0" + "}}"
OTHER = with_equilibrium(NEW_CELL, [0.02, -0.03, 0.02]).replace(kn=1000.0, tDiffusion=9e6, to=10.0, tsn=600.0, VEOD=2.7)


def discharged(cell, q_mobile, r_o, load, seed=0):
    return recorded(simulate(load, q_mobile, r_o, load_unit="current", thermal=True, cell=cell), noise_V=0.002, seed=seed)


def pulses(seed):
    """Currents that change every minute."""
    return np.repeat(np.random.default_rng(seed).uniform(0.5, 4.0, 300), 60)


@pytest.fixture(scope="module")
def simulated():
    ages = ((7400.0, 0.12), (6500.0, 0.15), (5500.0, 0.2))
    return [discharged(OTHER, q, r, pulses(n), seed=n) for n, (q, r) in enumerate(ages)]


@pytest.fixture(scope="module")
def fit(simulated):
    return fit_cell(simulated)


@pytest.fixture(scope="module")
def b0005_fit():
    discharges = load_nasa_discharges("B0005")
    return fit_cell([discharges[0], discharges[84], discharges[-1]])


@pytest.mark.parametrize("seed", [1, 2, 4, 7, 11])
def test_under_a_changing_load_a_nominal_capacity_keeps_the_estimate_of_another_cell_near(b0005_fit, seed):
    """Constants of a new cell let such a record run off to several times the true charge."""
    load = RandomPiecewise((0.5, 4.0), unit="current")(np.random.default_rng(seed))
    whole = simulate(load, 6100.0, 0.15, load_unit="current", thermal=True, cell=b0005_fit.cell, cut_off_V=2.6)
    record = recorded(whole, noise_V=0.005, seed=seed, starts_at_rest=True).until(0.75 * whole.reached_s(2.7))
    found = calibrate(record, nominal_Ah=2.0)
    assert abs(found.q_mobile_C / 6100.0 - 1.0) < 0.5 and not found.settled
    assert abs(found.q_mobile_C - 6100.0) < 2.0 * found.sd_q_mobile_C


def test_a_fit_tells_how_much_the_cell_holds_before_its_knee_does(b0005_fit, monkeypatch):
    q_C = [discharge.q_mobile for discharge in b0005_fit.discharges]
    low_C, high_C = b0005_fit.life_q_mobile_C
    # these ages are of nearly a whole life, a single one in its middle is not
    assert low_C == pytest.approx(min(q_C) / 1.2, rel=0.05) and high_C == pytest.approx(1.2 * max(q_C))
    one = dataclasses.replace(b0005_fit, discharges=b0005_fit.discharges[1:2])
    assert one.life_q_mobile_C[0] == pytest.approx(0.7 * q_C[1] / 1.2)
    settings = Settings(cell=b0005_fit)
    for other in load_nasa_discharges("B0006")[40:160:60]:
        start_s, end_s = other.load_on_time_s, other.eod_time_s(2.7)
        seen = other.until(start_s + 0.25 * (end_s - start_s))
        low_s, _, high_s = forecast_end(seen, settings).eod_quantile_s()
        assert low_s < end_s < high_s
        q_mobile_C = calibrate(other, settings).q_mobile_C
        with monkeypatch.context() as patch:
            patch.setattr(Estimate, "within", lambda estimate, low_C, high_C: estimate)
            assert high_s - low_s < 0.8 * np.ptp(forecast_end(seen, settings).eod_quantile_s())
            assert calibrate(other, settings).q_mobile_C == q_mobile_C
    # a prior says more
    known = dataclasses.replace(settings, prior_q_mobile_C=(0.9 * low_C, 0.01 * low_C))
    assert np.median(forecast_end(seen, known).q_mobile) < low_C


@pytest.mark.parametrize("coefficients_V", [[0.1], [0.0, 0.1], [0.1, 0.0, -0.2, 0.05, 0.01], list(np.full(14, 0.01))])
def test_what_is_added_to_the_equilibrium_voltage_is_added_exactly(coefficients_V):
    state = simulate(2.0, 7600.0, 0.1, load_unit="current").state[::200]
    fraction_p = state[:, 7] * 6.0 / 7600.0
    added_V = voltage(state, 7600.0, with_equilibrium(NEW_CELL, coefficients_V)) - voltage(state, 7600.0)
    np.testing.assert_allclose(added_V, Legendre(coefficients_V, domain=[0.4, 1.0])(fraction_p), rtol=0.0, atol=1e-9)


def test_derivatives_of_the_search_are_exact(simulated):
    problem = JointFit(simulated, [True] * 3, NEW_CELL, True, 1.0)
    sd = np.array([1.0, 0.1, *problem.sd.values()])
    for search, start in zip(problem.searches, problem.starts()[0], strict=True):
        x = np.array(search.x_at(start, search.unknown)) + 0.1 * np.random.default_rng(0).standard_normal(len(sd)) * sd

        def at(x, search=search, start=start):
            return search.weighed_at(start, dict(zip(search.unknown, x.tolist(), strict=True)), problem.priors)

        _, by_x = at(x)
        for k, step in enumerate(2e-5 * np.diag(sd)):
            slope = (at(x + step)[0] - at(x - step)[0]) / 4e-5
            np.testing.assert_allclose(by_x[:, k] * sd[k], slope, rtol=1e-4, atol=4e-6)


def test_each_discharge_has_parameters_of_its_own_and_all_have_the_same_constants(simulated):
    problem = JointFit(simulated, [True] * 3, NEW_CELL, True, 1.0)
    search, values = JointSearch(problem.searches, problem.priors), problem.starts()[0]

    def moved(name, step, of):
        return [at | {name: at[name] + step} if n in of else at for n, at in enumerate(values)]

    _, jacobian = search.weighed(values)
    assert jacobian.shape[1] == 3 * 2 + len(problem.sd)
    for name, column, of in (("q_mobile", 2, [1]), ("r_o", 5, [2]), ("kn", 6, [0, 1, 2]), ("equilibrium 7", 19, [0, 1, 2])):
        step = 1e-4 * values[0][name] or 1e-4
        more, less = (search.weighed(moved(name, each, of))[0] for each in (step, -step))
        np.testing.assert_allclose(jacobian[:, column] * step, 0.5 * (more - less), rtol=1e-3, atol=1e-8)


class TestSimulated:
    def test_the_voltage_is_explained_to_the_noise(self, fit):
        assert fit.rmse_V == pytest.approx(0.002, rel=0.05)
        for discharge in fit.discharges:
            assert discharge.left_out_V == pytest.approx(0.002, rel=0.1)
        assert all(discharge.rmse_before_V > 2.0 * discharge.rmse_V for discharge in fit.discharges)

    def test_constants_and_ages_are_within_their_deviations(self, fit):
        for constant in fit.constants[: len(RATE_CONSTANTS)]:
            true = getattr(OTHER, constant.name)
            assert abs(np.log(constant.value / true)) < 4.0 * constant.sd
        for discharge, (q, r) in zip(fit.discharges, ((7400.0, 0.12), (6500.0, 0.15), (5500.0, 0.2)), strict=True):
            assert abs(discharge.q_mobile - q) < 4.0 * discharge.sd_q_mobile < 0.02 * q
            assert abs(discharge.r_o - r) < 4.0 * discharge.sd_r_o < 0.2 * r
        identified = {constant.name for constant in fit.constants if constant.identified}
        assert {"tDiffusion", "to", "tsn", "equilibrium 0"} <= identified

        assert (fit.cell.q_mobile, fit.cell.r_o) == (fit.discharges[0].q_mobile, fit.discharges[0].r_o)  # the youngest one
        assert fit.cell.VEOD == 2.7

    def test_what_the_discharges_do_not_show_stays_at_its_prior(self):
        with pytest.warns(UserWarning, match="show one age"):
            fit = fit_cell([discharged(NEW_CELL, 7000.0, 0.12, 2.0)], cut_off_V=NEW_CELL.VEOD)
        kp = next(constant for constant in fit.constants if constant.name == "kp")
        assert kp.value == pytest.approx(NEW_CELL.kp, rel=0.2) and kp.sd > 0.9 * kp.prior_sd and not kp.identified
        assert "kp" in fit.summary() and "not identified" in fit.summary()

    def test_another_chemistry(self):
        # flat at 3.3 V, as with iron phosphate
        flat = with_equilibrium(NEW_CELL, [-0.35, 0.33, -0.05, 0.05]).replace(VEOD=2.5)
        records = [discharged(flat, q, 0.12, pulses(n)) for n, q in enumerate((7400.0, 6000.0))]
        with pytest.warns(
            UserWarning, match="at 3.4. V with these constants.* If a full cell of this kind rests there, all is"
        ):
            fit = fit_cell(records, cut_off_V=2.5)
        assert fit.rmse_V < 0.003
        assert voltage(initial_state(cell=fit.cell), cell=fit.cell) == pytest.approx(
            voltage(initial_state(cell=flat), cell=flat), abs=0.01
        )

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("soc", sweep(0.8, 0.9))
    def test_a_start_that_is_not_full_is_doubted(self, soc, tmp_path):
        current_A = np.append(np.zeros(120), np.full(20_000, 2.0))
        low = [
            simulate(current_A, q, 0.15, load_unit="current", thermal=True, initial=initial_state(q, soc=soc), cut_off_V=2.7)
            for q in (7000.0, 5000.0)
        ]
        rest_V = low[0].voltage_V[0]
        with pytest.warns(UserWarning, match=f"A full cell rests at {rest_V:.2f} V .* at 4.19 V .* did not start full"):
            fit = fit_cell(low)
        assert fit.full_V == pytest.approx(rest_V, abs=0.005) and f"at {rest_V:.2f} V after" in fit.summary()
        assert CellFit.from_json(fit.to_json(tmp_path / "cell.json")).doubt == fit.doubt != ""
        # who knows such a cell, and says so, is not asked
        known = NEW_CELL.replace(U0p=NEW_CELL.U0p + rest_V - 4.19)
        assert fit_cell(low, start=known).doubt == ""

    def test_what_no_constants_can_describe_is_refused(self, simulated):
        record = simulated[0]
        wild = record.voltage_V - 0.3 * (np.sin(record.time_s / 100.0) > 0.0)
        with pytest.raises(ValueError, match=r"the equations do not describe this cell: .* mV off"):
            fit_cell([Discharge(record.time_s, np.maximum(wild, 2.72), record.current_A)])


class TestRealCells:
    @pytest.mark.parametrize("size", sweep(120.0, 0.02))
    def test_cells_of_any_size_have_constants(self, b0005_fit, size):
        discharges = load_nasa_discharges("B0005")
        chosen = [discharges[n] for n in (0, 84, -1, 120)]
        *fitted, other = (Discharge(each.time_s, each.voltage_V, size * each.current_A) for each in chosen)
        found, own = calibrate(other, cell=fit_cell(fitted)), calibrate(discharges[120], cell=b0005_fit)
        assert found.settled and found.q_mobile_C == pytest.approx(size * own.q_mobile_C, rel=0.01)
        assert found.r_o_ohm * size == pytest.approx(own.r_o_ohm, rel=0.1)

    def test_the_error_to_expect_is_what_unseen_discharges_show(self, b0005_fit):
        own = b0005_fit.calibrator()
        shown_V = [discharge.left_out_V for discharge in b0005_fit.discharges]
        assert b0005_fit.mismatch_V >= np.sqrt(np.mean(np.square(shown_V))) > 1.2 * b0005_fit.rmse_V
        for discharge in load_nasa_discharges("B0006")[8::40]:
            record = discharge.loaded_part(2.7)
            error_V = own.model.voltage(record, own.estimate(record)) - record.voltage_V
            assert np.sqrt(np.mean(error_V**2)) < UNFITTED_ERROR_RATIO * b0005_fit.mismatch_V
        assert all(f"{1e3 * error_V:.1f} mV\n" in b0005_fit.summary() + "\n" for error_V in shown_V)

    @pytest.mark.parametrize("numbers", sweep([0, 10, 20], [0], [5, 5, 5]), ids=["young", "one", "copies"])
    def test_one_age_says_nothing_of_others(self, numbers, tmp_path):
        discharges = load_nasa_discharges("B0005")
        with pytest.warns(UserWarning, match=r"show one age, .* q_mobile is .* mismatch_V, (48|50|51) mV, allows"):
            fit = fit_cell([discharges[n] for n in numbers])
        assert CellFit.from_json(fit.to_json(tmp_path / "cell.json")) == fit
        assert fit.rmse_V < fit.error_at_V(fit.cell.q_mobile) < 0.02
        assert all(0.0 < each.left_out_V < 0.02 for each in fit.discharges)

    @pytest.mark.filterwarnings("ignore::UserWarning")
    @pytest.mark.parametrize("number", sweep(0, 60, 167))
    def test_what_one_discharge_leaves_is_what_others_of_its_age_show_and_less_than_older_ones(self, number):
        discharges, shown_V = load_nasa_discharges("B0005"), []
        fit = fit_cell([discharges[number]])
        for other in (abs(number - 5), abs(number - 80)):
            record = discharges[other].loaded_part(2.7)
            estimate = LeastSquares(cell=fit.cell, thermal=fit.thermal).estimate(record)
            error_V = fit.calibrator().model.voltage(record, estimate) - record.voltage_V
            shown_V.append((float(np.sqrt(np.mean(error_V**2))), fit.error_at_V(estimate.q_mobile)))
        near, old = shown_V
        assert near[0] < 1.5 * near[1] < 0.03
        assert near[1] < old[1] and old[0] < 1.5 * old[1]

    def test_an_error_is_expected_at_the_age_of_a_prior_and_at_the_load_of_the_fit(self, b0005_fit):
        settings, q_C = Settings(cell=b0005_fit), b0005_fit.cell.q_mobile
        of_fit_A = np.full(60, b0005_fit.currents_A[0])
        known = dataclasses.replace(settings, prior_q_mobile_C=(q_C, 50.0))
        assert known.expecting(of_fit_A).resolved.mismatch_V == b0005_fit.error_at_V(q_C) <= b0005_fit.mismatch_V
        pulses_A = of_fit_A * np.tile([0.5, 1.5], 30)
        for other in (settings.expecting(of_fit_A), known.expecting(2.0 * of_fit_A), known.expecting(pulses_A)):
            assert other.resolved.mismatch_V == b0005_fit.mismatch_V
        assert dataclasses.replace(known, mismatch_V=0.03).expecting(of_fit_A).resolved.mismatch_V == 0.03

    def test_a_discharge_of_another_cell_is_named(self):
        discharges = load_nasa_discharges("B0005")
        other = discharged(NEW_CELL.replace(VEOD=2.7), 6200.0, 0.12, 4.0)
        with pytest.warns(UserWarning, match=r"without 2 are .* times as far off it as its age explains: leave it out if"):
            fit = fit_cell([discharges[0], other, discharges[84]])
        assert fit.mismatch_V > 0.04

    def test_a_forecast_takes_the_model_of_a_fit(self, b0005_fit):
        calibrator = b0005_fit.calibrator()
        discharge = load_nasa_discharges("B0006")[60]
        end_s = discharge.eod_time_s(2.7)
        record = discharge.loaded_part(2.7).until(0.75 * end_s)
        estimate = calibrator.estimate(record)
        found = forecast(record, estimate, model=calibrator.model, mismatch_V=b0005_fit.mismatch_V)
        assert found.cut_off_V == 2.7  # that of the fit
        low_s, median_s, high_s = found.eod_quantile_s()
        assert low_s < end_s < high_s and median_s == pytest.approx(end_s, rel=0.08)
        assert 1.7 < found.nominal_Ah < 1.95  # the first discharge that was fitted gave 1.86 Ah
        loads = [constant_load(record.current_A[-1], "current")]
        assert found.nominal_Ah == pytest.approx(calibrator.model.capacity_Ah(loads, 2.7)[0])

    def test_a_fit_says_what_it_is_of(self, b0005_fit):
        assert 295.0 < b0005_fit.cell.Tb0 < 300.0  # the measured temperature
        assert b0005_fit.full_V == pytest.approx(load_nasa_discharges("B0005")[84].voltage_V[0], abs=0.02)
        assert b0005_fit.doubt == "" and "a full cell rests at 4.19 V before, at 4.20 V after" in b0005_fit.summary()
        assert [discharge.name for discharge in b0005_fit.discharges] == ["B0005:1", "B0005:85", "B0005:168"]
        assert "B0005:85" in b0005_fit.summary()
        assert len(b0005_fit.constants) == len(RATE_PRIOR_SD) + len(EQUILIBRIUM_PRIOR_SD_V)


class TestFiles:
    @pytest.mark.parametrize("charge", [None, ChargeBefore(4.2, 0.05, 1.5, 600.0)])
    def test_a_fit_and_constants_survive_their_files_and_are_read_for_what_they_are(self, charge, fit, tmp_path):
        fit = dataclasses.replace(fit, usual_start=DischargeStart(4.18, 0.0, 0.01, charge))
        assert read_cell(fit.to_json(tmp_path / "fit.json")) == fit
        assert read_cell(OTHER.to_json(tmp_path / "constants.json")) == OTHER
        # a fit of an older release does not tell how its discharges start
        old = json.loads((tmp_path / "fit.json").read_text())
        del old["usual_start"]
        (tmp_path / "old.json").write_text(json.dumps(old))
        assert read_cell(tmp_path / "old.json") == dataclasses.replace(fit, usual_start=None)
        (tmp_path / "other.json").write_text("{}")
        with pytest.raises(ValueError, match=r"other\.json holds no"):
            read_cell(tmp_path / "other.json")
        for value, name in ((fit, "fit.json"), (OTHER, "constants.json")):
            with pytest.raises(FileExistsError, match="exists already"):
                value.to_json(tmp_path / name)

    def test_constants_hold_for_the_loads_that_were_fitted(self, fit):
        low_A, high_A = fit.currents_A
        for current_A, is_known in ((0.5 * low_A, False), (low_A, True), (high_A, True), (2.0 * high_A, False)):
            record = discharged(fit.cell, 6500.0, 0.15, current_A)
            found = calibrate(record, cell=fit)
            assert found.settled == is_known == bool(found.nominal_Ah > 0.0)
            assert ("is none of those that the constants were fitted to" in found.reason) != is_known
            running, settings = record.until(0.5 * record.time_s[-1]), Settings(cell=fit)
            expected = forecast_end(running, settings, load=high_A, samples=10)
            assert bool(expected.nominal_Ah > 0.0)
            expected = forecast_end(running, settings, load=2.0 * high_A, samples=10)
            assert any("is none of those" in note for note in expected.notes) and np.isnan(expected.nominal_Ah)
            expected = forecast_end(running, settings, load=constant_load(4.0 * high_A, "power"), samples=10)
            assert any("is none of those" in note for note in expected.notes) and np.isnan(expected.nominal_Ah)
            # of several loads, the new cell is that of one
            slow = dataclasses.replace(fit.discharges[0], current_A=0.5 * low_A)
            of_several = dataclasses.replace(fit, discharges=(slow, *fit.discharges))
            assert np.isnan(calibrate(record, cell=of_several).nominal_Ah)

    def test_settings_use_all_that_a_fit_knows(self, fit):
        settings = Settings(cell=fit)
        assert settings.constants == fit.cell
        assert settings.resolved == (fit.cell.VEOD, fit.mismatch_V, fit.thermal, fit.usual_start)
        estimator, own = settings.calibrator(fit.cell), fit.calibrator()
        assert estimator.bounds == own.bounds and estimator.bounds["q_mobile"][1] == pytest.approx(1.2 * fit.cell.q_mobile)
        assert Settings(cell=OTHER).resolved.mismatch_V == 0.05
        assert Settings().calibrator(NEW_CELL).bounds == LeastSquares().bounds
        assert not Settings(cell=dataclasses.replace(fit, thermal=False)).resolved.thermal

    @pytest.mark.parametrize("other", [Settings.but, dataclasses.replace])
    def test_what_is_stated_stays_as_stated_with_another_cell_and_nothing_else_does(self, other, fit):
        isothermal = dataclasses.replace(fit, thermal=False)
        # also where what is stated is what holds when nothing is
        for stated in ({"mismatch_V": 0.05}, {"cut_off_V": 2.7}, {"thermal": True}, {"mismatch_V": 0.1, "cut_off_V": 3.0}):
            for cell in (fit, isothermal, OTHER, None):
                whole = Settings(**stated, cell=cell)
                assert other(Settings(**stated), cell=cell) == whole == other(Settings(**stated, cell=fit), cell=cell)
                assert whole.resolved == Settings(cell=cell).resolved._replace(**stated)

    def test_settings_and_keywords_say_the_same(self, fit):
        cell = dataclasses.replace(fit, cell=fit.cell.replace(VEOD=3.0))
        record = discharged(fit.cell, 6500.0, 0.15, fit.currents_A[0])
        by_settings = calibrate(record, Settings(mismatch_V=0.05, cut_off_V=2.7), cell=cell)
        by_keywords = calibrate(record, mismatch_V=0.05, cut_off_V=2.7, cell=cell)
        assert by_settings.sd_q_mobile_C == by_keywords.sd_q_mobile_C
        assert by_settings.capacity_Ah == by_keywords.capacity_Ah > calibrate(record, cell=cell).capacity_Ah

    @pytest.mark.parametrize(
        ("kind", "change", "message"),
        [
            (CellParameters, lambda content: content.update(version=99), "of version 99"),
            (CellParameters, lambda content: content.update(format="something"), "holds no battery_env.CellParameters but so"),
            (CellParameters, lambda content: content["constants"].pop("kn"), "missing or unknown: kn"),
            (CellParameters, lambda content: content["constants"].update(knn=1.0), "missing or unknown: knn"),
            (CellParameters, lambda content: content["constants"].update(kn=-1.0), "kn must be greater than 0"),
            (CellParameters, lambda content: content["constants"].update(kn="fast"), "kn must be float"),
            (CellParameters, lambda content: content["constants"].update(Ap=1.0), "damaged"),
            (CellParameters, lambda content: content.update(constants=[1.0]), "given by name"),
            (CellParameters, lambda content: content.pop("constants"), "damaged"),
            (CellFit, lambda content: content.update(usual_start=[4.1]), "damaged"),
            (CellFit, lambda content: content.update(usual_start=["full", 0.0, 0.0, None]), "damaged"),
            (CellFit, lambda content: content.update(usual_start=[4.1, 0.0, 0.0, [4.2]]), "damaged"),
            *((CellFit, lambda content, name=name: content.pop(name), "damaged") for name in FIELDS),
            *((CellFit, lambda content, name=name: content.update({name: None}), "damaged") for name in FIELDS),
            *((CellFit, lambda content, name=name: content.update({name: [{"name": "kn"}]}), "damaged") for name in FIELDS),
        ],
    )
    def test_a_damaged_file_is_refused(self, kind, change, message, fit, tmp_path):
        path = (fit if kind is CellFit else OTHER).to_json(tmp_path / "cell.json")
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=message):
            kind.from_json(path)

    @pytest.mark.parametrize("text", ["", "{", "[" * 3_000, "[]", "null", '"text"', "\udcff", "PK\3\4", "{}", TOO_LARGE])
    @pytest.mark.parametrize("kind", [CellFit, CellParameters])
    def test_what_is_no_such_file_is_refused(self, kind, text, tmp_path):
        path = tmp_path / "cell.json"
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(ValueError, match=r"cell\.json"):
            kind.from_json(path)


class TestBadInput:
    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            ({"discharges": []}, ValueError, "takes 1 to 30 discharges, got 0"),
            ({"discharges": 5}, TypeError, "must be a list of discharges"),
            ({"discharges": load_nasa_discharges("B0005")[0]}, TypeError, "must be a list of discharges, got Discharge"),
            ({"discharges": [1.0]}, TypeError, "discharge 1 is no record"),
            ({"cut_off_V": -1.0}, ValueError, "cut_off_V"),
            ({"cut_off_V": "low"}, ValueError, "cut_off_V"),
            ({"limit_V": 0.0}, ValueError, "limit_V"),
            ({"start": 5}, TypeError, "cell must be"),
            ({"thermal": "yes"}, TypeError, "thermal must be"),
            ({"dt_s": 100.0}, ValueError, "dt must"),
        ],
    )
    def test_arguments_are_checked(self, arguments, error, message, simulated):
        with pytest.raises(error, match=message):
            fit_cell(**{"discharges": simulated, **arguments})
