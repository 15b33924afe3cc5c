"""A certificate tells a loop that settles from one that does not, and its statements are exact."""

import dataclasses
import itertools
import math
import random
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.stats import binom
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.control import ScaledController
from sb3_lac import CertificateCallback, GymnasiumVecEnv, LyapunovCallback, certify, evaluate_lyapunov, fit_lyapunov
from sb3_lac.envs import LinearCostEnv, reference_controller
from sb3_lac.stability import CriticLyapunov, Interval, LyapunovFunction, fitting
from sb3_lac.stability.fitting import shortest_window, traced_returns
from sb3_lac.stability.report import SHORT, Reason
from sb3_lac.stability.statistics import exact_interval, exact_lower_bound, tightest_drift

FIT = {"progress_bar": False}


@pytest.fixture(autouse=True, scope="module")
def _few_iterations():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "N_ITERATIONS", 20)
        yield


@pytest.fixture(scope="module")
def linear_env():
    return make_vec_env("LinearCost-v0", n_envs=10)


@pytest.fixture(scope="module")
def optimal(linear_env):
    controller = reference_controller(gym.make("LinearCost-v0"))
    return controller, fit_lyapunov(controller, linear_env, n_episodes=50, seed=0, **FIT)


@pytest.fixture(scope="module")
def judged(optimal, linear_env):
    controller, lyapunov = optimal
    return evaluate_lyapunov(controller, linear_env, n_episodes=50, seed=100, lyapunov=lyapunov)


@pytest.fixture(scope="module")
def exact():
    """The function of the optimal loop whose decrease is all of the cost, its matrix and the average cost."""
    env = LinearCostEnv()
    p = env.value_matrix(env.optimal_gain(), gamma=1.0)
    function = LyapunovFunction(lambda states: np.einsum("ni,ij,nj->n", states.astype(float), p, states.astype(float)))
    return function, p, env.noise_std**2 * np.trace(p)


# Good and bad loops


def test_function_of_the_optimal_loop_is_the_exact_one(optimal, judged, linear_env, exact):
    (controller, lyapunov), (function, _, average_cost), report = optimal, exact, judged
    values, learned = function.values(report.observations), report.transitions["lyapunov"].to_numpy()
    assert np.corrcoef(values, learned)[0, 1] > 0.998
    assert np.polyfit(values, learned, 1)[0] == pytest.approx(1.0, abs=0.05)
    # All of the cost, up to what the noise costs in each step
    assert report.holds and report.metrics["cost_bound_alpha3"].value > 0.7
    assert average_cost * 0.8 < report.metrics["cost_bound"].value < average_cost * 1.5
    assert report.metrics["calibration_slope"].value == pytest.approx(1.0, abs=0.05)
    assert report.metrics["death_rate"].value == 0
    statements = certify(controller, linear_env, lyapunov=lyapunov, n_episodes=59, seed=200).statements
    assert statements.index.tolist() == ["survives", "stays_within", "decreases"]
    assert statements["share"].min() > 0.9 and statements["at_least"].min() > 0.8


@pytest.mark.parametrize("factor", [-1.0, -0.14], ids=["wrong sign", "hardly unstable"])
def test_destabilised_loop_fails(linear_env, optimal, factor):
    env = LinearCostEnv()
    assert np.abs(np.linalg.eigvals(env.A - factor * env.B @ env.optimal_gain())).max() > 1.005
    controller = ScaledController(optimal[0], factor)
    lyapunov = fit_lyapunov(controller, linear_env, n_episodes=30, seed=0, **FIT)
    report = evaluate_lyapunov(controller, linear_env, n_episodes=30, seed=100, lyapunov=lyapunov)
    assert not report.holds and report.metrics["largest_feasible_alpha3"].high < 0
    assert report.summary().startswith("NOT SHOWN: L does not fall")
    certification = certify(controller, linear_env, lyapunov=lyapunov, n_episodes=30, ultimate_bound=0.05, seed=200)
    assert certification.statements.loc["stays_within", "n_true"] == 0
    assert certification.statements.loc["stays_within", "at_least"] == 0
    assert "decreases" not in certification.statements.index and "not made" in certification.summary()


def test_known_function_is_judged_like_a_learned_one(linear_env, optimal, exact):
    function, _, average_cost = exact
    report = evaluate_lyapunov(optimal[0], linear_env, n_episodes=100, seed=0, lyapunov=function)
    assert report.holds and report.alpha3 == 1.0
    # With it both bounds are the mean cost in the long run, of the noise alone: the drift is -(c - average cost)
    assert report.metrics["decrease"].value == pytest.approx(average_cost, rel=0.2)
    _, low, high = report.metrics["cost_bound"]
    assert low < 1.1 * average_cost < 1.5 * average_cost and average_cost < high
    # The bounds err on the safe side, with few episodes too
    for seed in (1000, 2000, 3000):
        metrics = evaluate_lyapunov(optimal[0], linear_env, n_episodes=20, seed=seed, lyapunov=function).metrics
        assert metrics["residual"].high > average_cost and metrics["cost_bound"].high > average_cost
        assert metrics["cost_bound"].value < 1.5 * average_cost


@pytest.mark.parametrize(("factor", "holds"), [(1.0, True), (-0.14, False)])
def test_loop_whose_cost_rises_in_the_end_does_not_hold(optimal, factor, holds):
    """The time decreases wherever the loop goes."""

    class OfTheState(ScaledController):
        def predict(self, observation, **kwargs):
            return super().predict(observation[:, :2].astype(np.float32), **kwargs)

    clock = LyapunovFunction(lambda observations: 200.0 - observations[:, 2])
    env = gym.wrappers.TimeAwareObservation(gym.make("LinearCost-v0"), normalize_time=False)
    report = evaluate_lyapunov(OfTheState(optimal[0], factor), env, n_episodes=30, seed=0, lyapunov=clock)
    assert report.holds == holds and ("rises where the roll-outs end" in report.summary()) != holds
    assert report.metrics["cost_bound"].value >= report.metrics["late_cost"].value


class Beside(ScaledController):
    """A controller that adds the same to each of its actions, and so rests beside its goal."""

    def predict(self, *arguments, **options):
        actions, state = self.controller.predict(*arguments, **options)
        return actions + self.factor, state


@pytest.fixture(scope="module")
def beside(optimal, linear_env):
    controller = Beside(optimal[0], np.float32(0.15))
    return controller, fit_lyapunov(controller, linear_env, n_episodes=50, seed=0, **FIT)


def test_verdict_says_where_a_loop_rests(optimal, beside, linear_env):
    for (controller, lyapunov), asked in ((optimal, False), (beside, True)):
        report = evaluate_lyapunov(controller, linear_env, n_episodes=50, seed=100, lyapunov=lyapunov)
        share = 100 * report.metrics["late_cost"].value / report.metrics["start_cost"].value
        assert report.holds and (share > 10) == asked
        assert report.summary().startswith(f"HOLDS, and rests at {share:.3g} % of the start's cost")
        assert ("beside the goal?" in report.summary()) == asked


def test_one_stated_bound_ranks_loops_that_pass_by_their_own(optimal, beside, linear_env):
    passed = {}
    for name, (controller, lyapunov) in (("optimal", optimal), ("beside", beside)):
        for bound in (None, 0.02):
            report = certify(controller, linear_env, lyapunov=lyapunov, n_episodes=50, ultimate_bound=bound, seed=200)
            passed[name, bound] = report.statements.loc["stays_within", "share"]
            assert ("The bound is this loop's own" in report.summary()) == report.own_bound == (bound is None)
            assert ("beside the goal?" in report.summary()) == (name == "beside")
            (label,) = (text.get_text() for text in report.plot().axes[1].get_legend().texts if "bound" in text.get_text())
            assert label.startswith("bound of this loop alone" if bound is None else "stated bound 0.02")
    assert passed["beside", None] >= 0.9 and passed["optimal", None] >= 0.9
    assert passed["beside", 0.02] == 0.0 and passed["optimal", 0.02] == 1.0


# Verdicts

FALLING, RISING, TOO_WIDE = Interval(0.5, 0.4, 0.6), Interval(-0.5, -0.6, -0.4), Interval(0.25, -0.25, 0.75)
NONE = Interval(math.nan, math.nan, math.nan)


@pytest.mark.parametrize(
    ("changed", "reason", "enough"),
    [
        ({"death_rate": Interval(0.5, 0.1, 0.9)}, Reason.DIED, None),
        ({"largest_feasible_alpha3": NONE}, Reason.FREE, 200),
        ({"largest_feasible_alpha3": RISING}, Reason.L_RISES, None),
        # Half of the interval is twice the value, and with four times as many episodes as wide as that
        ({"largest_feasible_alpha3": TOO_WIDE}, Reason.L_RISES, 200),
        ({"largest_feasible_alpha3": Interval(-0.25, -0.75, 0.25)}, Reason.L_RISES, 200),
        # What is close to the limit is asked again, and no millions of episodes
        ({"largest_feasible_alpha3": Interval(1e-9, -0.5, 0.5)}, Reason.L_RISES, 400),
        ({"cost_bound_alpha3": NONE}, Reason.RISES_FAR_OUT, None),
        ({"late_rise": Interval(9.0, 8.0, 10.0)}, Reason.COST_RISES, None),
        ({"cost_bound": Interval(20.0, 19.0, 21.0)}, Reason.UNSETTLED, None),
        # What is decided is said first
        ({"largest_feasible_alpha3": TOO_WIDE, "cost_bound": Interval(20.0, 19.0, 21.0)}, Reason.UNSETTLED, None),
    ],
)
def test_each_reason_is_said_with_the_episodes_that_it_lacks(judged, changed, reason, enough):
    report = dataclasses.replace(judged, metrics=judged.metrics | changed)
    first = report.summary().splitlines()[0]
    assert not report.holds and first.startswith("NOT SHOWN") and reason.value in first
    assert re.findall(r"50 do not tell, n_episodes=(\d+) may", first) == ([] if enough is None else [str(enough)])
    assert (SHORT in first) == (enough is not None)


def test_verdict_that_holds_says_if_more_episodes_may_show_a_rise(judged):
    assert SHORT not in judged.summary()
    report = dataclasses.replace(judged, metrics=judged.metrics | {"late_rise": Interval(1.0, -0.5, 2.5)})
    assert report.holds and f"{SHORT}: whether {Reason.COST_RISES.value}, n_episodes=150 may tell" in report.summary()


def test_with_the_episodes_that_a_verdict_asks_for_it_is_decided(exact, optimal, linear_env):
    controller = Beside(optimal[0], np.float32(0.25))
    few = evaluate_lyapunov(controller, linear_env, n_episodes=20, seed=100, lyapunov=exact[0])
    (enough,) = re.findall(r"n_episodes=(\d+) may", few.summary())
    many = evaluate_lyapunov(controller, linear_env, n_episodes=int(enough), seed=100, lyapunov=exact[0])
    assert not few.holds and SHORT in few.summary() and many.holds and SHORT not in many.summary()


# Other roll-outs


def test_roll_outs_of_a_fit_say_nothing_of_others(optimal, linear_env):
    controller, lyapunov = optimal
    for judge in (evaluate_lyapunov, certify):
        for seed in (0, 9):
            with pytest.raises(ValueError, match=rf"seed={seed} with 10 environments .* \(seeds 0 to 9\).* from 10 on"):
                judge(controller, linear_env, lyapunov=lyapunov, seed=seed)
    evaluate_lyapunov(controller, linear_env, n_episodes=10, seed=10, lyapunov=lyapunov)


def sampled(actions):
    """Actions of PyTorch's random numbers, as those of the policies of Stable-Baselines3."""
    return th.randn(len(actions), 2).numpy(), None


# The function was fitted on two episodes only
@pytest.mark.filterwarnings("ignore:Observations lie far")
@pytest.mark.parametrize("env_seed", [None, 0])
def test_roll_outs_without_a_seed_are_new_ones(make_env, env_seed):
    # Whatever seed the environment was given before
    drawn = []
    env = make_vec_env(make_env, n_envs=2, seed=env_seed)
    policy = NoController(lambda zeros: (drawn.append(sampled(zeros)[0]) or drawn[-1], None))
    lyapunov = fit_lyapunov(policy, env, n_episodes=2, progress_bar=False)
    with pytest.raises(ValueError, match="the Lyapunov function was fitted on"):
        certify(policy, env, lyapunov=lyapunov, n_episodes=2, seed=lyapunov.seeds.start)
    reports = []
    for judge in (certify, certify, evaluate_lyapunov):
        env = make_vec_env(make_env, n_envs=2, seed=env_seed)
        reports.append(judge(policy, env, lyapunov=lyapunov, n_episodes=2))
    # Each draws other states and actions
    assert len({report.transitions["reward"].iloc[0] for report in reports}) == 3
    assert len({actions[0, 0] for actions in drawn}) == len(drawn)
    # And can be made again
    again = evaluate_lyapunov(policy, env, n_episodes=2, lyapunov=lyapunov, seed=reports[2].seed)
    assert again.transitions.equals(reports[2].transitions)


def test_fit_is_reproducible_and_leaves_random_numbers_alone(linear_env, optimal):
    controller = optimal[0]
    points = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    values = []
    for seed in (3, 3, 30):
        th.manual_seed(1)
        np.random.seed(1)
        random.seed(1)
        values.append(fit_lyapunov(controller, linear_env, n_episodes=10, seed=seed, progress_bar=False).values(points))
        drawn = (th.rand(1).item(), np.random.rand(), random.random())
        assert drawn == pytest.approx((0.7576315999, 0.417022004702574, 0.13436424411240122))
    np.testing.assert_array_equal(values[0], values[1])
    assert (values[0] != values[2]).any() and (values[0] >= 0).all()


def test_function_does_not_depend_on_what_never_changed(make_env):
    env, policy = make_env(), NoController(sampled)

    def fit(last):
        # A number that is another one in the observation of the time limit only, from which nothing is learned
        def shown(state):
            return np.append(state, np.float32(last if env.n_steps == env.episode_length else 0.1))

        space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        return fit_lyapunov(policy, gym.wrappers.TransformObservation(env, shown, space), n_episodes=10, seed=0, **FIT)

    lyapunov, changed = fit(0.1), fit(1.0)
    points = np.array([[1.0, 0.5, 0.1], [0.0, -1.0, 0.1]])
    np.testing.assert_array_equal(changed.values(points), lyapunov.values(points))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = lyapunov.values(points)
    with pytest.warns(UserWarning, match=r"1 of their 3 numbers, number \[2\] among them, which was within \[0.1"):
        moved = lyapunov.values(points + np.array([0.0, 0.0, 0.05]))
    np.testing.assert_array_equal(moved, values)
    with pytest.warns(UserWarning, match=r"2 of their 3 numbers, number \[0, 1\] among them"):
        lyapunov.values(np.array([[50.0, -50.0, 0.1]]))


# Statistics


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(st.integers(1, 50), st.floats(-5, 5), st.floats(0, 10)), min_size=1, max_size=6),
    st.floats(0, 15) | st.just(np.nan),
)
def test_bound_on_the_mean_cost_is_the_tightest(levels, late_cost):
    n, m, c = (np.array(column, dtype=float) for column in zip(*levels, strict=True))
    # Differences that rounding decides about are no matter of this
    m, c, late_cost = np.round(m, 2), np.round(c, 2), np.round(late_cost, 2)
    bound, alpha3 = tightest_drift(n, n * m, n * c, late_cost)
    # min v, t * m + c <= v, v >= the late cost, t = 1 / alpha3 >= 0
    least = c.min() if np.isnan(late_cost) else late_cost
    expected = linprog([1, 0], A_ub=np.column_stack([-np.ones(len(m)), m]), b_ub=-c, bounds=[(least, None), (0, None)])
    assert expected.status == 0 and bound == pytest.approx(expected.fun, rel=1e-6, abs=1e-6)
    assert np.isnan(alpha3) == (m[c == c.max()].max() >= 0 or c.max() == 0)
    if not np.isnan(alpha3):
        assert (m <= -alpha3 * c + alpha3 * bound + 1e-9 * (1 + alpha3 * c.max())).all()


def test_cost_that_goes_up_and_down_does_not_rise():
    """As that of a goal that moves: in the last fifth it is higher than in the one before, and not than ever before."""
    costs = [8.0, 8.0, *(1.0 + np.sin(2 * np.pi * np.arange(2, 20) / 10 - 2.5))]
    falls = LyapunovFunction(lambda observations: np.where(observations[:, 0] < 99, observations[:, 0], 0.0))
    report = evaluate_lyapunov(NoController(), PlannedEnv([costs]), n_episodes=10, seed=0, lyapunov=falls)
    fifths = np.reshape(costs, (5, 4)).mean(axis=1)
    assert fifths[4] > fifths[3] + 0.5 and report.metrics["late_cost"].value == pytest.approx(fifths[4])
    assert report.metrics["late_rise"].value == pytest.approx(fifths[4] - fifths[1:4].max())
    assert report.metrics["late_rise"].value < 0


def test_at_exact_bounds_what_was_seen_is_as_unlikely_as_they_say():
    for n_true, n in ((1, 1), (1, 2), (7, 60), (59, 60), (60, 60)):
        share, low, high = exact_interval(n_true, n)
        assert share == n_true / n and binom.sf(n_true - 1, n, low) == pytest.approx(0.025)
        assert high == 1.0 if n_true == n else binom.cdf(n_true, n, high) == pytest.approx(0.025)
        assert binom.sf(n_true - 1, n, exact_lower_bound(n_true, n, 0.8)) == pytest.approx(0.2)
    assert exact_interval(0, 9).low == exact_lower_bound(0, 9, 0.8) == 0.0


def test_returns_look_as_far_as_the_trace(monkeypatch):
    costs, next_values = np.array([1.0, 2.0, 4.0, 8.0]), np.array([10.0, 20.0, 30.0, 0.0])
    # Two steps until a time limit, and two until a death, after which nothing is paid
    rows = np.array([[0, 1, -1], [2, 3, -1]])
    for trace_decay, average_cost, expected in (
        (0.0, 0.5, costs - 0.5 + next_values),
        (1.0, 0.5, [22.0, 21.5, 11.0, 7.5]),
        (0.5, 0.0, [17.0, 22.0, 23.0, 8.0]),
    ):
        monkeypatch.setattr(fitting, "TRACE_DECAY", trace_decay)
        np.testing.assert_allclose(traced_returns(costs, next_values, rows, average_cost), expected)


def test_shortest_window():
    # Falls every second step only, and stays below 2 in the end
    values = np.array([8.0, 9.0, 4.0, 5.0, 1.0, 2.0, 9.0, 3.0])
    rows = np.array([[0, 1, 2, 3, 4, 5], [6, 7, -1, -1, -1, -1]])
    assert shortest_window(values, rows, level=2.0) == 2
    assert shortest_window(values[:2], np.array([[0, 1]]), level=2.0) is None


# Statements


class PlannedEnv(gym.Env):
    """Pays planned costs, whatever the action; an episode dies at a cost that is not finite, which costs 1."""

    def __init__(self, plan):
        self.observation_space = spaces.Box(-100, 100, (1,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.plan = itertools.cycle(plan)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.costs = list(next(self.plan))
        return self._observation(), {}

    def _observation(self):
        return np.array([self.costs[0] if np.isfinite(self.costs[0]) else 99.0], np.float32)

    def step(self, action):
        cost = self.costs.pop(0)
        death, self.costs = not self.costs, self.costs or [np.inf]
        death = self.costs[0] == np.inf and not death
        return self._observation(), -float(cost), death, self.costs == [np.inf] and not death, {}


class NoController:
    """
    A controller that does nothing.

    :param answer: Makes of its actions what ``predict`` returns
    """

    def __init__(self, answer=lambda actions: (actions, None)):
        self.answer = answer

    def predict(self, observation, deterministic=True):
        return self.answer(np.zeros((len(observation), 1), np.float32))


IDENTITY = LyapunovFunction(lambda observations: observations[:, 0])
FALLS = LyapunovFunction(lambda observations: observations[:, 0])
FALLS.level, FALLS.window_steps, FALLS.ultimate_bound = 1.8, 1, 1.2


def test_statements_count_what_they_say(monkeypatch):
    settles, rises, stays, dies, rests = [8, 4, 2, 1, 1], [8, 4, 9, 1, 1], [8, 4, 2, 1.5, 1.5], [8, 4, np.inf], [1, 1, 1, 1, 1]
    env = PlannedEnv([settles, rises, stays, dies, rests])
    report = certify(NoController(), env, lyapunov=FALLS, n_episodes=10, seed=0)
    frame = report.statements
    assert frame["n_episodes"].to_dict() == {"survives": 10, "stays_within": 10, "decreases": 8}
    # The late costs are those of the last step; what rests never starts above the level and does not testify
    assert frame["n_true"].to_dict() == {"survives": 8, "stays_within": 6, "decreases": 4}
    assert report.confidence_of_each == pytest.approx(1 - 0.05 / 3)
    for row in frame.itertuples():
        assert row.at_least == exact_lower_bound(row.n_true, row.n_episodes, report.confidence_of_each)
    assert np.isnan(report.episodes.loc[4, "decreases"]) and report.episodes.loc[3, "decreases"] == 0
    summary = report.summary()
    assert "8 of 10" in summary and "Bonferroni" in summary and "no proof of stability" in summary and "seed 0" in summary
    assert len(report.plot().axes) == 2
    # A lower bound is not rounded up
    assert "0.9999 " in dataclasses.replace(report, statements=frame.assign(at_least=0.99998)).summary()
    # A wider window passes over the rise
    monkeypatch.setattr(FALLS, "window_steps", 3)
    assert certify(NoController(), env, lyapunov=FALLS, n_episodes=5).statements.loc["decreases", "n_true"] == 3


def test_region_of_attraction_on_a_grid():
    angles = np.array([0.0, 0.05, 0.1, 0.33])
    starts = np.stack([np.zeros(4), np.zeros(4), angles, np.array([0, 0, 0, 3.0])], axis=1)
    # Five environments do not divide the 24 episodes
    env = make_vec_env("CartPoleCost-v0", n_envs=5)
    controller = reference_controller(gym.make("CartPoleCost-v0"))
    report = certify(controller, env, n_episodes=3, ultimate_bound=0.05, starts=starts, n_episodes_per_start=6, seed=0)
    frame = report.starts
    np.testing.assert_array_equal(frame[[f"state_{k}" for k in range(4)]], starts)
    assert frame["n_attracted"].tolist() == [6, 6, 6, 0]
    assert (frame["low"] <= frame["share"]).all() and (frame["share"] <= frame["high"]).all()
    assert frame["low"].iloc[0] == exact_interval(6, 6).low
    assert "3 of 4 start states" in report.summary()
    assert len(report.plot_region_of_attraction(2, 3).axes) == 2
    with pytest.raises(ValueError, match="There are no start states"):
        certify(controller, env, n_episodes=3).plot_region_of_attraction()


def test_a_cost_of_the_bound_is_within_the_bound():
    # DummyVecEnv holds rewards in single precision, where 0.1 is a little more than 0.1
    for ultimate_bound, n_true in ((0.1, 4), (0.0999, 0)):
        report = certify(NoController(), PlannedEnv([[0.1] * 10]), n_episodes=4, ultimate_bound=ultimate_bound)
        assert report.statements.loc["stays_within", "n_true"] == n_true


# Deaths


def test_death_is_no_decrease():
    """Transitions into terminal states have no next value: they count as deaths, and in nothing else."""
    env = PlannedEnv([[8, 4, np.inf], [8, 4, 2, 1]])
    report = evaluate_lyapunov(NoController(), env, n_episodes=10, lyapunov=IDENTITY, seed=0)
    known = report.transitions[~report.transitions["terminated"]]
    assert report.transitions["next_lyapunov"].isna().sum() == report.transitions["terminated"].sum() == 5
    assert report.metrics["decrease"].value == pytest.approx(known["difference"].mean())
    assert not report.holds and "episodes died (5 of 10)" in report.summary()
    # Some samples of these episodes have no transition at all
    env = PlannedEnv([[5, np.inf]] * 9 + [[8, 4, 2, 1]])
    report = evaluate_lyapunov(NoController(), env, n_episodes=10, lyapunov=IDENTITY, seed=0)
    assert report.metrics["death_rate"].value == 0.9 and not report.holds
    assert np.isfinite(report.metrics["cost_bound"].value)


def test_states_that_die_have_a_large_value(monkeypatch):
    monkeypatch.setattr(fitting, "N_ITERATIONS", 60)
    monkeypatch.setattr(fitting, "BATCH_SIZE", 64)
    # The same first cost; the one dies of it, the other settles
    env = PlannedEnv([[3, 50, np.inf], [4, 2, 1, 1, 1, 1, 1, 1]])
    lyapunov = fit_lyapunov(NoController(), env, n_episodes=60, seed=0, progress_bar=False)
    dying, settling = lyapunov.values(np.array([[3.0], [4.0]]))
    assert dying > 3 * settling


# Policies and environments


def test_policy_is_asked_as_far_as_it_can_be_asked():
    class WithMasks(PlannedEnv):
        def action_masks(self):
            return np.array([True, len(self.costs) > 1])

    class Counter:
        """Counts steps of the episode, which it is only told by ``state`` and ``episode_start``."""

        counts, masks = [], []

        def predict(self, observation, state=None, episode_start=None, deterministic=False, action_masks=None):
            count = np.zeros(len(observation)) if state is None else np.where(episode_start, 0.0, state[0] + 1)
            self.counts.append(count)
            self.masks.append(action_masks)
            return np.zeros((len(observation), 1), np.float32), (count,)

    policy = Counter()
    certify(policy, WithMasks([[1, 1, 1]]), n_episodes=2)
    assert np.concatenate(policy.counts).tolist() == [0, 1, 2, 0, 1, 2]
    np.testing.assert_array_equal(policy.masks, 2 * [[[True, True]], [[True, True]], [[True, False]]])
    certify(policy, PlannedEnv([[1, 1]]), n_episodes=1)
    assert policy.masks[6:] == [None, None]


def test_random_actions_of_dqn_are_those_of_the_seed():
    model = DQN("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}, buffer_size=10, seed=0)
    before = np.random.get_state()[1].copy(), model.action_space.np_random.bit_generator.state
    first, second = (
        certify(model, gym.make("CartPole-v1"), n_episodes=5, deterministic=False, seed=7).episodes["length"] for _ in range(2)
    )
    assert first.tolist() == second.tolist() and first.nunique() > 1
    np.testing.assert_array_equal(np.random.get_state()[1], before[0])
    assert model.action_space.np_random.bit_generator.state == before[1]


def test_critic_is_a_function_of_the_observation(make_model, make_env):
    model = make_model(n_collect=0)
    lyapunov = CriticLyapunov(model)
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_array_equal(lyapunov.values(observations), model.policy.predict_lyapunov(observations, actions))
    assert "lyapunov" in certify(model, make_env(), lyapunov=lyapunov, n_episodes=3, ultimate_bound=1.0, seed=10).transitions


def test_costs_of_other_functions_are_those_of_the_env(make_env):
    env, eval_env = (VecNormalize(make_vec_env(make_env, n_envs=2), gamma=0.9) for _ in range(2))
    model = SAC("MlpPolicy", env, buffer_size=100, learning_starts=1000, policy_kwargs={"net_arch": [8]}, seed=0)
    model.learn(100)
    eval_env.obs_rms, eval_env.ret_rms = env.obs_rms, env.ret_rms
    lyapunov = fit_lyapunov(model, eval_env, n_episodes=4, seed=2, progress_bar=False)
    report = evaluate_lyapunov(model, eval_env, n_episodes=4, seed=10, lyapunov=lyapunov)
    states = eval_env.unnormalize_obs(report.observations)
    np.testing.assert_allclose(report.transitions["cost"], np.sum(states**2, axis=1), rtol=1e-3, atol=1e-4)


# Callback


@pytest.mark.filterwarnings("ignore:Observations lie far")
def test_callback_logs_the_certificates_of_any_algorithm(make_env):
    model = SAC("MlpPolicy", make_env(), learning_starts=100, policy_kwargs={"net_arch": [8]}, buffer_size=100, seed=0)
    callback = CertificateCallback(make_env(), n_episodes=4, eval_freq=10, verbose=0)
    model.learn(20, callback=callback)
    report, certification = callback.last_report, callback.last_certification
    assert len(callback.history) == 2
    assert callback.history[-1]["cost_bound_high"] == report.metrics["cost_bound"].high
    assert callback.history[-1]["survives_at_least"] == certification.statements.loc["survives", "at_least"]
    assert len(report.episodes) == len(certification.episodes) == 4


def test_callback_goes_on_where_nothing_has_a_cost(make_env, capsys):
    model = SAC("MlpPolicy", make_env(), learning_starts=100, policy_kwargs={"net_arch": [8]}, buffer_size=100, seed=0)
    free = gym.wrappers.TransformReward(make_env(), lambda reward: 0.5)
    callback = CertificateCallback(free, n_episodes=2, eval_freq=10)
    assert model.learn(20, callback=callback).num_timesteps == 20
    assert capsys.readouterr().out.count("nothing had a cost") == 2
    assert callback.last_report is None and callback.last_certification is None
    assert callback.best_mean_reward == 10.0  # of 20 steps
    assert all(np.isnan(value) for name, value in callback.history[0].items() if name != "timesteps")


# Arguments


def test_arguments_of_before_work_and_say_what_to_write(make_env):
    def costs(judge, *arguments, **options):
        return judge(NoController(), PlannedEnv([[4, 2, 1], [8, 2, 1]]), *arguments, **options).transitions["cost"].tolist()

    for judge, old, old_names, new, written in (
        (certify, (FALLS, 2), {}, {"lyapunov": FALLS, "n_episodes": 2}, "lyapunov=..., n_episodes=..."),
        (evaluate_lyapunov, (2, True, 7, FALLS), {}, {"n_episodes": 2, "seed": 7, "lyapunov": FALLS}, "lyapunov=..."),
        (
            evaluate_lyapunov,
            (),
            {"n_eval_episodes": 2, "lyapunov": FALLS},
            {"n_episodes": 2, "lyapunov": FALLS},
            "n_episodes=...",
        ),
    ):
        with pytest.warns(DeprecationWarning, match=re.escape(written)):
            before = costs(judge, *old, **old_names)
        assert before == costs(judge, **new)
    with pytest.warns(DeprecationWarning, match="fit_lyapunov: write n_episodes=..., deterministic=..., seed=..."):
        before = fit_lyapunov(NoController(), PlannedEnv([[4, 2, 1]]), 3, True, 0, progress_bar=False)
    now = fit_lyapunov(NoController(), PlannedEnv([[4, 2, 1]]), n_episodes=3, seed=0, progress_bar=False)
    assert before.values(np.ones((1, 1))) == now.values(np.ones((1, 1)))
    for make in (LyapunovCallback, CertificateCallback):
        with pytest.warns(DeprecationWarning, match="write n_episodes=..."):
            assert make(make_env(), n_eval_episodes=4).n_episodes == 4
    with pytest.warns(DeprecationWarning), pytest.raises(TypeError, match="takes 2 positional arguments"):
        fit_lyapunov(NoController(), ONES, 3, True, 0, False, "one too many")
    with pytest.warns(DeprecationWarning), pytest.raises(TypeError, match="multiple values for keyword argument 'n_episodes'"):
        certify(NoController(), ONES, None, 3, n_episodes=4)


# Refusals


def showing(observation):
    return gym.wrappers.TransformObservation(PlannedEnv([[1, 1]]), lambda _: np.full(1, observation), None)


ONES = PlannedEnv([[1, 1]])
SOMETIMES_PAID = gym.wrappers.TransformReward(gym.make("LinearCost-v0"), lambda reward: 1.0 if reward < -0.5 else reward)
ONE_START_FOR_ALL = GymnasiumVecEnv(gym.vector.SyncVectorEnv([lambda: PlannedEnv([[1, 1]])] * 2, autoreset_mode="SameStep"))


@pytest.mark.parametrize(
    ("call", "env", "arguments", "message"),
    [
        (certify, ONES, {"n_episodes": 0}, "number of episodes must be a whole number of at least 1, and not 0"),
        (certify, ONES, {"n_episodes": 2.5}, "of at least 1, and not 2.5"),
        (certify, ONES, {"seed": -1}, "seed=-1 must be a whole number of at least 0"),
        (certify, ONES, {"ultimate_bound": np.nan}, "ultimate_bound=nan must be a number"),
        (certify, ONES, {"lyapunov": np.sum}, r"must be a LyapunovFunction: .*LyapunovFunction\(function\)"),
        (certify, ONES, {"starts": np.ones((3, 1)), "n_episodes_per_start": 5}, "n_episodes_per_start=5 must be at least 6"),
        (certify, ONES, {"starts": np.ones(3), "ultimate_bound": 1.0}, r"starts of shape \(3,\)"),
        (certify, ONES, {"starts": np.ones((3, 1))}, "give one, or a fitted lyapunov"),
        (certify, ONES, {"starts": [[1.0], [2.0]], "ultimate_bound": 1.0}, "The environment ignores reset"),
        (certify, ONES, {"starts": [[5.0]], "ultimate_bound": 1.0}, "The environment ignores reset"),
        (certify, ONE_START_FOR_ALL, {"starts": [[1.0], [2.0]], "ultimate_bound": 1.0}, "takes the same options for all"),
        (certify, PlannedEnv([[-2, 1]]), {"ultimate_bound": 1.0}, "A reward of 2 is positive, and it is not known"),
        (certify, SOMETIMES_PAID, {"starts": [[0.0, 0.0], [0.9, 0.9]], "ultimate_bound": 0.5}, "A reward of 1 is positive"),
        (evaluate_lyapunov, PlannedEnv([[-2, 1]]), {"lyapunov": IDENTITY}, "A reward of 2 is positive"),
        (evaluate_lyapunov, ONES, {}, "must be a LAC or PublishedLAC.*CertificateCallback"),
        (certify, "LinearCost-v0", {}, r"env='LinearCost-v0' is no environment: pass that of gym.make"),
        (certify, gym.make_vec("LinearCost-v0", num_envs=2), {}, r"pass sb3_lac.GymnasiumVecEnv\(env\)"),
        (certify, showing(np.nan), {}, "observation that is NaN"),
        (fit_lyapunov, showing(np.inf), {"n_episodes": 2}, "infinite observation"),
        (fit_lyapunov, PlannedEnv([[0, 0]]), {}, "Nothing had a cost"),
        (fit_lyapunov, PlannedEnv([[np.nan, 0]]), {}, "reward that is not finite"),
    ],
)
def test_what_cannot_be_meant_is_refused(call, env, arguments, message):
    with pytest.raises(ValueError, match=message):
        call(NoController(), env, **arguments)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (None, "needs a method predict"),
        (NoController, "needs a method predict"),
        (NoController(lambda actions: actions), "returned ndarray, and must return two things"),
        (NoController(lambda actions: (actions[0], None)), r"actions of shape \(1,\), and must return one for each of 2 env"),
    ],
)
def test_a_policy_predicts_actions(policy, message):
    env = DummyVecEnv([lambda: PlannedEnv([[1, 1]])] * 2)
    with pytest.raises(ValueError, match=message):
        certify(policy, env, n_episodes=2)
    # A list of actions is as good as an array
    assert len(certify(NoController(lambda actions: (actions.tolist(), None)), env, n_episodes=2).episodes) == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: LyapunovFunction(np.sum, reward_bound=-1.0), "^reward_bound=-1.0 must"),
        (lambda: LyapunovFunction(np.sum, gamma=math.nan), "^gamma=nan must"),
        (lambda: LyapunovFunction(np.sum, alpha3="1"), "^alpha3='1' must"),
        (lambda: LyapunovFunction(lambda states: states).values(np.ones((2, 3))), "one for each of 2 observations"),
        (lambda: LyapunovFunction(lambda _: np.array([np.nan, 1.0])).values(np.ones((2, 3))), "1 of 2 values .* not finite"),
    ],
)
def test_functions_that_cannot_be_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_fit_that_diverges_is_refused(linear_env, optimal, monkeypatch):
    monkeypatch.setattr(fitting, "LEARNING_RATE", 1e30)
    with pytest.raises(ValueError, match="The fit diverged"):
        fit_lyapunov(optimal[0], linear_env, n_episodes=5, **FIT)


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (CertificateCallback, {"seed": -1}, "seed=-1 must be a whole number of at least 0"),
        (CertificateCallback, {"n_episodes": -1}, "and not -1"),
        (CertificateCallback, {"ultimate_bound": "small"}, "ultimate_bound='small' must be a number"),
        (LyapunovCallback, {}, "must be a LAC or PublishedLAC.*CertificateCallback"),
    ],
)
def test_callback_refuses_questions_before_the_training(make_env, make, arguments, message):
    model = SAC("MlpPolicy", make_env(), buffer_size=10, seed=2)
    with pytest.raises(ValueError, match=message):
        model.learn(10, callback=make(make_vec_env(make_env, n_envs=3), **arguments))
    assert model.num_timesteps == 0
