from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from battery_env import Discharge, LeastSquares, SensorErrors, cramer_rao_bound, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL, Trajectory, initial_state, simulate
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.estimators.error import ErrorModel
from battery_env.estimators.search import Prior, Search, SizePrior
from battery_env.records import Samples
from tests.records import recorded
from tests.sweeps import sweep


def discharged(
    q_mobile: float = 6000.0, r_o: float = 0.15, load=8.0, noise_V: float = 0.0, seed: int = 0, **more
) -> Trajectory:
    return SensorErrors(noise_V).apply(simulate(load, q_mobile, r_o, **more), np.random.default_rng(seed))


def steps(seed: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).uniform(2.0, 8.0, 120), 100)


@pytest.fixture(scope="module")
def b0005() -> list[Discharge]:
    return [discharge.loaded_part(2.7) for discharge in load_nasa_discharges("B0005")]


def test_the_width_of_a_likelihood_is_found_at_any_distance_to_the_least_q_mobile(b0005, monkeypatch):
    record, both, free = b0005[80], ("q_mobile", "r_o"), {"q_mobile": (100.0, 1e7), "r_o": (-1.0, 30.0)}
    search = Search.of(Samples.of(record), LeastSquares().model, both, {}, free)
    search = replace(search, error=ErrorModel(0.05, 0.001, 0.1, 6.0, 1000.0))
    fit = search.best(search.best_starts([]), [])
    own = search.spread(fit, [], 1.0)
    spreads = []
    for distance_C in (*np.logspace(-300, 12, 105), 0.0):
        least_C = fit.values["q_mobile"] - distance_C
        monkeypatch.setattr(Search, "least_q_at_C", lambda *_, least_C=least_C: (least_C, 0.0))
        spreads.append(search.spread(fit, [], 1.0))
    assert np.isfinite(spreads).all() and max(spreads) < 2.0 * own


class TestCleanRecords:
    @pytest.mark.parametrize("power_W", sweep(16.0, 4.0, 8.0))
    @pytest.mark.parametrize("q_mobile", sweep(7600.0, 4000.0))
    @pytest.mark.parametrize("r_o", sweep(0.2, 0.1))
    def test_both_parameters_are_recovered_even_where_the_voltage_collapses(self, power_W, q_mobile, r_o):
        # 16 W at 0.2 ohm ends after less than a minute
        estimate = LeastSquares().estimate(discharged(q_mobile, r_o, power_W))
        assert estimate.q_mobile == pytest.approx(q_mobile, rel=1e-6)
        assert estimate.r_o == pytest.approx(r_o, rel=1e-6)
        assert estimate.settled and np.isfinite(estimate.sd_q_mobile)

    @settings(max_examples=15)
    @given(q_mobile=st.floats(2000.0, 12_000.0), r_o=st.floats(0.02, 0.35), seed=st.integers(0, 1000))
    def test_both_parameters_are_recovered_under_any_steps_of_the_load(self, q_mobile, r_o, seed):
        estimate = LeastSquares().estimate(discharged(q_mobile, r_o, steps(seed)))
        assert estimate.q_mobile == pytest.approx(q_mobile, rel=1e-6)
        assert estimate.r_o == pytest.approx(r_o, rel=1e-6)

    def test_one_parameter_at_a_time(self):
        record = discharged(6000.0, 0.15)
        q_only = LeastSquares(["q_mobile"], cell=NEW_CELL.replace(r_o=0.15)).estimate(record)
        assert q_only.q_mobile == pytest.approx(6000.0, rel=1e-6)
        assert q_only.r_o == 0.15 and np.isnan(q_only.sd_r_o)
        r_only = LeastSquares(["r_o"], cell=NEW_CELL.replace(q_mobile=6000.0)).estimate(record)
        assert r_only.r_o == pytest.approx(0.15, rel=1e-6)
        assert r_only.q_mobile == 6000.0 and np.isnan(r_only.sd_q_mobile)

    @pytest.mark.parametrize("thermal", [False, True])
    @pytest.mark.parametrize("dt_s", sweep(2.0, 0.5))
    def test_thermal_model_and_other_time_steps(self, thermal, dt_s):
        record = discharged(load=2.0, load_unit="current", thermal=thermal, dt=dt_s)
        estimate = LeastSquares(thermal=thermal, dt_s=dt_s).estimate(record)
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=1e-6)

    def test_a_record_sampled_now_and_then(self):
        whole = discharged(load=2.0, load_unit="current")
        kept = np.sort(np.random.default_rng(0).choice(len(whole.time_s), 200, replace=False))
        estimate = LeastSquares(initial=whole.state[kept[0]]).estimate(recorded(whole, kept))
        assert (estimate.q_mobile, estimate.r_o) == pytest.approx((6000.0, 0.15), rel=1e-6)


class TestGrowingWindow:
    def test_each_estimate_is_that_of_the_samples_so_far(self):
        record = discharged(6000.0, 0.15, steps(0), noise_V=0.005)
        record = replace(record, time_s=record.time_s + 500.0)
        fit = LeastSquares(window_every_s=400.0)
        (trace,) = fit.trace([record])
        expected_s = np.append(np.arange(900.0, record.time_s[-1], 400.0), record.time_s[-1])
        np.testing.assert_array_equal(trace.time_s, expected_s)
        for n, time_s in enumerate(trace.time_s):
            alone = fit.estimate(record.part(0, int(time_s - 500.0) + 1))
            for name in ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o"):
                assert getattr(trace, name)[n] == pytest.approx(getattr(alone, name), rel=1e-3)
            assert trace.settled[n] == alone.settled
        assert trace.settled[-1] and (np.diff(trace.sd_q_mobile) < 0.0).all()


class TestNoise:
    def test_errors_are_as_large_as_stated(self):
        scores = []
        for seed in range(25):
            estimate = LeastSquares().estimate(discharged(noise_V=0.005, seed=seed))
            scores.append([(estimate.q_mobile - 6000.0) / estimate.sd_q_mobile, (estimate.r_o - 0.15) / estimate.sd_r_o])
        assert np.abs(scores).max() < 4.0
        assert 0.6 < np.sqrt(np.mean(np.square(scores), axis=0)).min()
        assert np.sqrt(np.mean(np.square(scores), axis=0)).max() < 1.5

    def test_mismatch_widens_the_deviations_and_more_samples_do_not_narrow_them(self):
        record = discharged(noise_V=0.005)
        thinned = recorded(record, slice(None, None, 20))
        white, doubtful, few = (
            LeastSquares(mismatch_V=mismatch_V).estimate(data)
            for mismatch_V, data in ((0.0, record), (0.05, record), (0.05, thinned))
        )
        assert doubtful.q_mobile == pytest.approx(white.q_mobile, rel=1e-3)
        assert doubtful.sd_q_mobile > 50.0 * white.sd_q_mobile
        assert few.sd_q_mobile == pytest.approx(doubtful.sd_q_mobile, rel=0.2)

    def test_a_known_noise_takes_the_place_of_the_residuals(self):
        record = discharged(noise_V=0.005).part(0, 200)
        unknown, known, doubled = (LeastSquares(voltage_noise_V=noise_V).estimate(record) for noise_V in (None, 0.005, 0.01))
        assert (unknown.q_mobile, unknown.r_o) == pytest.approx((known.q_mobile, known.r_o), rel=1e-6)
        assert unknown.sd_q_mobile == pytest.approx(known.sd_q_mobile, rel=0.2)
        assert doubled.sd_q_mobile == pytest.approx(2.0 * known.sd_q_mobile)
        bound = cramer_rao_bound(record, 0.005)
        assert known.sd_q_mobile == pytest.approx(bound.sd_q_mobile[-1], rel=0.2)
        # and a prior is weighed with it
        sd = known.sd_q_mobile
        fit = LeastSquares(voltage_noise_V=0.005, prior_q_mobile_C=(known.q_mobile, sd))
        assert fit.estimate(record).sd_q_mobile == pytest.approx(sd / np.sqrt(2.0), rel=1e-3)

    def test_prior_and_record_are_weighed_by_their_variances(self):
        beginning = discharged(noise_V=0.005).part(0, 1500)
        alone = LeastSquares(["q_mobile"], cell=NEW_CELL.replace(r_o=0.15)).estimate(beginning)
        prior = (alone.q_mobile + 2.0 * alone.sd_q_mobile, alone.sd_q_mobile)
        both = LeastSquares(["q_mobile"], cell=NEW_CELL.replace(r_o=0.15), prior_q_mobile_C=prior).estimate(beginning)
        assert both.q_mobile == pytest.approx(alone.q_mobile + alone.sd_q_mobile, abs=0.1 * alone.sd_q_mobile)
        assert both.sd_q_mobile == pytest.approx(alone.sd_q_mobile / np.sqrt(2.0), rel=0.05)


class TestHeldParameters:
    @pytest.mark.parametrize(
        ("bounds", "name", "value"),
        [
            ({"q_mobile_bounds_C": (100.0, 5900.0)}, "q_mobile", 5900.0),
            ({"q_mobile_bounds_C": (6100.0, 9000.0)}, "q_mobile", 6100.0),
            ({"r_o_bounds_ohm": (0.0, 0.14)}, "r_o", 0.14),
            ({"r_o_bounds_ohm": (0.16, 1.0)}, "r_o", 0.16),
        ],
    )
    def test_one_beyond_its_bounds_is_held_there_and_the_other_one_fits_to_it(self, bounds, name, value):
        record = discharged(6000.0, 0.15).part(0, 2000)
        estimate = LeastSquares(**bounds).estimate(record)
        assert getattr(estimate, name) == value and not estimate.settled
        other = {"q_mobile": "r_o", "r_o": "q_mobile"}[name]
        alone = LeastSquares([other], cell=NEW_CELL.replace(**{name: value})).estimate(record)
        assert getattr(estimate, other) == pytest.approx(getattr(alone, other), rel=1e-6)


# what the model does not know of this cell: factors of two standard deviations and less
OFF = {"kn": 0.7, "tDiffusion": 1.3, "to": 0.8, "tsn": 1.2}
NUISANCE = dict.fromkeys(OFF, 0.2)


def discharged_otherwise(seed=0, factors=OFF, thermal=False):
    """A discharge of a cell whose constants are others than the model's."""
    cell = NEW_CELL.replace(**{name: factor * getattr(NEW_CELL, name) for name, factor in factors.items()})
    return discharged(load=steps(seed), noise_V=0.005, seed=seed, cell=cell, thermal=thermal)


class TestNuisanceConstants:
    def test_they_take_the_blame(self):
        record = discharged_otherwise()
        alone = LeastSquares().estimate(record)
        beside = LeastSquares(nuisance=NUISANCE).estimate(record)
        assert abs(alone.r_o - 0.15) > 0.002 and abs(beside.r_o - 0.15) < 0.0005
        assert abs(alone.q_mobile - 6000.0) > 20.0 and abs(beside.q_mobile - 6000.0) < 10.0
        assert beside.settled and not alone.settled

    @pytest.mark.parametrize("share", sweep(0.6, 0.3, 1.0))
    def test_errors_are_as_large_as_stated(self, share):
        scores = []
        for seed in range(8):
            draw = np.random.default_rng(seed)
            record = discharged_otherwise(seed=seed, factors={name: np.exp(0.2 * draw.standard_normal()) for name in OFF})
            estimate = LeastSquares(nuisance=NUISANCE).estimate(record.part(0, int(share * len(record.time_s))))
            scores += [(estimate.q_mobile - 6000.0) / estimate.sd_q_mobile, (estimate.r_o - 0.15) / estimate.sd_r_o]
        assert np.abs(scores).max() < 4.0 and 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.7

    def test_an_offset_of_the_sensor_is_one_of_them(self):
        record = discharged(6000.0, 0.15, steps(0), noise_V=0.005)
        shifted = replace(record, voltage_V=record.voltage_V + 0.02)
        estimate = LeastSquares(nuisance={"offset_V": 0.01}).estimate(shifted)
        assert estimate.q_mobile == pytest.approx(6000.0, rel=0.002) and estimate.r_o == pytest.approx(0.15, rel=0.01)
        assert estimate.settled and not LeastSquares(voltage_noise_V=0.005).estimate(shifted).settled

    @pytest.mark.parametrize("thermal", [False, True])
    def test_derivatives_are_exact(self, thermal):
        record = recorded(discharged_otherwise(thermal=thermal), slice(None, None, 7))
        nuisance = {**dict.fromkeys(RATE_CONSTANTS, 0.2), "offset_V": 0.01}
        fit = LeastSquares(nuisance=nuisance, thermal=thermal)
        search = Search.of(Samples.of(record), fit.model, fit.parameters, nuisance, fit.bounds)
        priors = (Prior("q_mobile", 6000.0, 1e-4), Prior("to", 0.0, 0.05))
        values = {"q_mobile": 6100.0, "r_o": 0.14, **dict.fromkeys(nuisance, 0.1), "offset_V": 0.003}
        search = replace(search, error=ErrorModel(0.01, 0.002, 0.1, 6.0, 900.0))
        residual, jacobian = search.weighed(values, priors)
        assert jacobian.shape == (len(residual), 9) and len(residual) == len(record.time_s) + 2
        for column, name in zip(jacobian.T, values, strict=True):
            step = 0.05 if name == "q_mobile" else 1e-5
            more, less = (search.weighed(values | {name: values[name] + sign * step}, priors)[0] for sign in (1, -1))
            np.testing.assert_allclose(column, (more - less) / (2.0 * step), rtol=1e-4, atol=1e-8)


class TestRealDischarges:
    @pytest.mark.parametrize("share", sweep(0.5, 0.1, 0.9))
    def test_an_unfinished_one_is_not_settled_and_a_prior_repairs_it(self, b0005, share):
        previous, record = b0005[98], b0005[99]
        fit = LeastSquares(thermal=True, mismatch_V=0.05)
        beginning = record.until(record.time_s[0] + share * (record.time_s[-1] - record.time_s[0]))
        alone = fit.estimate(beginning)
        assert not alone.settled
        assert abs(alone.q_mobile - fit.estimate(record).q_mobile) < 3.0 * alone.sd_q_mobile
        before = fit.estimate(previous).q_mobile
        carried = LeastSquares(thermal=True, mismatch_V=0.05, prior_q_mobile_C=(before, 0.01 * before))
        eod_time_s = carried.model.forecast(beginning, carried.estimate(beginning), 2.7).eod_time_s
        assert eod_time_s == pytest.approx(record.time_s[-1], rel=0.015)

    @pytest.mark.parametrize("cycle", sweep(95, 125))
    def test_the_deeper_of_two_minima_is_found(self, b0005, cycle):
        # the middle of these discharges is explained nearly as well by 3600 C as by 4500 C, and by 3200 C as by 4100 C
        record = b0005[cycle]
        half = record.until(record.time_s[0] + 0.5 * (record.time_s[-1] - record.time_s[0]))

        def square_V2(estimate):
            residual_V = LeastSquares(thermal=True).model.voltage(half, estimate) - half.voltage_V
            return residual_V @ residual_V

        def profile(q_mobile):
            return LeastSquares(["r_o"], cell=NEW_CELL.replace(q_mobile=q_mobile), thermal=True).estimate(half)

        best = LeastSquares(thermal=True).estimate(half)
        assert square_V2(best) < min(square_V2(profile(q_mobile)) for q_mobile in np.linspace(3000.0, 6000.0, 40))


class TestBadInput:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"parameters": ["capacity"]}, "one or both"),
            ({"parameters": []}, "one or both"),
            ({"parameters": ["r_o", "r_o"]}, "one or both"),
            ({"dt_s": 20.0}, "dt must"),
            ({"q_mobile_bounds_C": (6000.0, 5000.0)}, "bounds of q_mobile"),
            ({"q_mobile_bounds_C": (2.1, 5000.0)}, "Ampere-hours"),
            ({"r_o_bounds_ohm": (0.2, 0.1)}, "bounds of r_o must be"),
            ({"r_o_bounds_ohm": (0.0, 80.0)}, "Milliohms"),
            ({"prior_q_mobile_C": (6000.0, 0.0)}, "sd > 0"),
            ({"size": SizePrior(0.0)}, "size.usual_C must be a positive"),
            ({"prior_q_mobile_C": (1.9, 0.1)}, "Ampere-hours|mean within 100 .. 1e\\+07"),
            ({"prior_q_mobile_C": (6000.0, 60.0), "parameters": ["r_o"]}, "needs 'q_mobile'"),
            ({"mismatch_V": -0.05}, "mismatch_V must be .*at least 0.*, got -0.05"),
            ({"voltage_noise_V": 0.0}, "voltage_noise_V must be greater than 0"),
            ({"current_gain_sd": 1.0}, "current_gain_sd is a share within 0 .. 1"),
            *(
                ({"initial_soc": soc}, r"initial_soc is a state of charge within .*\.soc_from_rest tells both")
                for soc in (0.0, 1.1, np.nan, "rest", (0.5, -0.1), (0.5, 0.1, 0.1), None)
            ),
            ({"initial": np.zeros(7)}, "initial must hold 8"),
            (
                {"initial": initial_state(), "initial_soc": 0.8},
                "initial is a whole state: give it or initial_soc, got both",
            ),
            ({"window_every_s": -1.0}, "window_every_s must be greater than 0"),
            ({"nuisance": {"kn": 0.0}}, "nuisance kn must be a positive"),
            ({"nuisance": {"kn": "0.2"}}, "nuisance kn must be a positive"),
            ({"nuisance": {"knn": 0.2}}, r"nuisance constants are kn, kp, .* and offset_V, got 'knn'"),
            ({"nuisance": ["kn"]}, "standard deviations by name"),
            ({"nuisance": {"tDiffusion": 0.2}, "parameters": ["r_o"]}, "only beside q_mobile"),
        ],
    )
    def test_arguments_are_checked(self, arguments, message):
        with pytest.raises((TypeError, ValueError), match=message):
            LeastSquares(**arguments)

    def test_a_record_says_what_it_takes(self):
        with pytest.raises(ValueError, match=r"at least 5\d\d\d.* C, which is beyond the upper bound, 4000 C"):
            LeastSquares(q_mobile_bounds_C=(100.0, 4000.0)).estimate(discharged())
        with pytest.raises(ValueError, match="q_mobile = 100 C is empty at the start"):
            LeastSquares(["r_o"], cell=NEW_CELL.replace(q_mobile=100.0)).estimate(discharged(load=30.0, load_unit="current"))


@pytest.mark.parametrize("is_stated", [False, True])
@pytest.mark.parametrize("ratio", [0.4, 0.999999, 1.0, 1.2, 5.0])
def test_a_stated_size_rules_out_far_ones_and_the_derivative_of_its_residual_is_right(ratio, is_stated):
    size = SizePrior(6000.0, is_stated)
    at = [float(size.residual({"q_mobile": 6000.0 * ratio * factor})[0][0]) for factor in (1.0 - 1e-6, 1.0, 1.0 + 1e-6)]
    (slope,) = size.residual({"q_mobile": 6000.0 * ratio})[1]["q_mobile"]
    assert slope * 6000.0 * ratio == pytest.approx((at[2] - at[0]) / 2e-6, rel=1e-4)
    # 2.5 standard deviations of a stated size contradict it; no number of them an unstated one
    assert abs(at[1]) == pytest.approx(abs(np.log(ratio)) / 0.2) if is_stated else abs(at[1]) < 2.1


def test_a_cell_whose_charges_meet_fast_is_found():
    # faster than the steps that starts are compared on with the constants of others
    cell = NEW_CELL.replace(tDiffusion=1.2e6)
    estimate = LeastSquares(cell=cell).estimate(simulate(2.0, 7000.0, 0.12, load_unit="current", cell=cell))
    assert (estimate.q_mobile, estimate.r_o) == pytest.approx((7000.0, 0.12), rel=1e-4)
