"""The statistics of the learned Lyapunov function are right, known cases are recognized, and nothing is changed by them."""

import itertools

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from scipy.stats import binom, spearmanr
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, sync_envs_normalization

from sb3_lac import LAC, CertificateCallback, LyapunovCallback, certify, evaluate_lyapunov
from sb3_lac.stability import fitting, rollout, statistics
from sb3_lac.stability.statistics import Bootstrap, decrease_by_cost, exact_percentile, ratio

RHO = 0.5


class ContractionEnv(gym.Env):
    """
    ``s' = rho * s`` with the cost ``|s|^2``, whatever the action.

    :param starts: Start states of the episodes, repeated
    :param lengths: Lengths of the episodes, repeated
    :param deaths: Whether the episodes terminate at their end, repeated
    """

    def __init__(self, starts=((1.0, 0.5),), lengths=(40,), deaths=(False,)):
        self.observation_space = spaces.Box(-10, 10, (len(starts[0]),), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.plan = zip(*(itertools.cycle(values) for values in (starts, lengths, deaths)), strict=False)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        start, self.length, self.death = next(self.plan)
        self.state, self.n_steps = np.array(start, dtype=np.float32), 0
        return self.state, {}

    def step(self, action):
        cost = float(np.sum(self.state**2))
        self.state = (RHO * self.state).astype(np.float32)
        self.n_steps += 1
        end = self.n_steps >= self.length
        return self.state, -cost, end and self.death, end and not self.death, {}


@pytest.fixture
def make_exact_model(make_model, monkeypatch):
    def _make_exact_model(gamma=0.5, alpha3=0.5, **kwargs):
        """A model with ``L = |s|^2 / (1 - gamma * rho^2)``, the exact one of ``ContractionEnv``."""
        model = make_model(ContractionEnv(**kwargs), n_collect=0, gamma=gamma, alpha3=alpha3)

        def predict_lyapunov(observation, action):
            assert len(observation) == len(action)
            return np.sum(np.asarray(observation, dtype=np.float64) ** 2, axis=1) / (1 - gamma * RHO**2)

        monkeypatch.setattr(model.policy, "predict_lyapunov", predict_lyapunov)
        return model

    return _make_exact_model


# Values of L


def test_value_is_the_largest_of_the_critics_for_actions_in_units_of_the_space(make_model, make_env):
    env = make_env(n_dim=3)
    env.action_space = spaces.Box(np.array([-1, 0, 2], np.float32), np.array([3, 1, 4], np.float32))
    policy = make_model(env, n_collect=0, policy_kwargs={"n_critics": 2}).policy
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    actions = np.array([[3, 0.5, 2]] * 50, np.float32)
    scaled = th.tensor([[1.0, 0.0, -1.0]] * 50)
    # No value is cut off at 0
    policy.critic.floor.fill_(1.0)
    first, second = (value.detach().numpy()[:, 0] for value in policy.critic(th.as_tensor(observations), scaled))
    values = policy.predict_lyapunov(observations, actions)
    assert (first > second).any() and (second > first).any()
    np.testing.assert_allclose(values, np.maximum(first, second), rtol=1e-5)
    # A single one
    np.testing.assert_allclose(policy.predict_lyapunov(observations[7], actions[7]), values[7:8], rtol=1e-6)


# Known cases


@pytest.mark.parametrize(("gamma", "alpha3"), [(0.5, 0.5), (0.8, 0.9), (0.8, 0.95)])
def test_exact_lyapunov_function_is_recognized(make_exact_model, monkeypatch, gamma, alpha3):
    monkeypatch.setattr(statistics, "MAX_TAIL_WEIGHT", 1e-4)
    # No two states of different episodes have the same cost
    starts = ((1.0, 0.5), (2.0, -1.5), (0.25, 0.0))
    model = make_exact_model(gamma, alpha3, starts=starts, lengths=(50,))
    report = evaluate_lyapunov(model, ContractionEnv(starts, (50,)), n_episodes=3)
    values = {name: estimate.value for name, estimate in report.metrics.items()}
    feasible = (1 - RHO**2) / (1 - gamma * RHO**2)
    # |s|^2 of the starts, and the sum over an episode
    squares, series = np.array([1.25, 6.25, 0.0625]), 1 / (1 - RHO**2)
    assert values == pytest.approx(
        {
            "decrease": (alpha3 - feasible) * squares.sum() * series / 150,
            "share_decreasing": float(alpha3 <= feasible),
            "largest_feasible_alpha3": feasible,
            "mean_cost": squares.sum() * series / 150,
            "calibration_slope": 1.0,
            "rank_correlation": 1.0,
            "ultimate_bound": 0.0,
            "death_rate": 0.0,
            "start_cost": squares.mean(),
            "late_cost": 0.0,
            # It falls, from the second fifth on
            "late_rise": -squares.mean() * RHO**20 * (1 - RHO**20) * series / 10,
            # Of the level where it is largest: what alpha3 asks beyond what is feasible is most where the cost is most
            "residual": (alpha3 - feasible) * report.by_cost["cost"].iloc[-1 if alpha3 > feasible else 0],
            # The drift is proportional to the cost, so that there is no residual with the feasible alpha3
            "cost_bound": 0.0,
            "cost_bound_alpha3": feasible,
        },
        rel=1e-9,
        abs=1e-12,
    )
    # The intervals of what is the same in each episode have no width, the mean cost differs
    assert report.metrics["largest_feasible_alpha3"].low == pytest.approx(feasible, rel=1e-9)
    _, low, high = report.metrics["mean_cost"]
    assert low < 0.8 * values["mean_cost"] < 1.2 * values["mean_cost"] < high
    verdict = "holds on average" if alpha3 <= feasible else "is violated on average"
    assert f"With alpha3={alpha3:g} the decrease condition {verdict}" in report.summary(full=True)
    first, *others = report.summary().splitlines()
    assert report.holds and first.startswith("HOLDS, and rests at ") and "not proved" in others[0]
    assert len(others) == 1 and report.summary(full=True).startswith(report.summary())


def test_ends_of_episodes(make_exact_model):
    # Dies after two steps, and survives three
    arguments = {"starts": ((1.0,),), "lengths": (2, 3), "deaths": (True, False)}
    report = evaluate_lyapunov(make_exact_model(gamma=0.5, alpha3=1.0, **arguments), ContractionEnv(**arguments), n_episodes=2)
    scale = 1 / 0.875
    frame = report.transitions
    assert frame["episode"].tolist() == [0, 0, 1, 1, 1] and frame["step"].tolist() == [0, 1, 0, 1, 2]
    assert frame["terminated"].tolist() == [False, True, False, False, False]
    np.testing.assert_allclose(frame["cost"], [1, 1 / 4, 1, 1 / 4, 1 / 16])
    np.testing.assert_allclose(frame["reward"], -frame["cost"])
    np.testing.assert_allclose(frame["lyapunov"], scale * frame["cost"])
    # No L in the terminal state, but after the time limit
    np.testing.assert_allclose(frame["next_lyapunov"], scale * np.array([1 / 4, np.nan, 1 / 4, 1 / 16, 1 / 64]))
    np.testing.assert_allclose(frame["difference"], frame["next_lyapunov"] - frame["lyapunov"] + frame["cost"])
    # All is paid at a termination, while half of the weight of the costs to come and more is unseen after a time limit
    np.testing.assert_allclose(frame["cost_to_go"], [1 + 1 / 8, 1 / 4, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(report.observations, [[1], [0.5], [1], [0.5], [0.25]])

    assert report.episodes["length"].tolist() == [2, 3] and report.episodes["terminated"].tolist() == [True, False]
    np.testing.assert_allclose(report.episodes["total_cost"], [5 / 4, 21 / 16])
    np.testing.assert_allclose(report.episodes["final_cost"], [1 / 4, 1 / 16])
    assert report.metrics["decrease"].value == pytest.approx(frame["difference"].sum() / 4)
    assert report.metrics["mean_cost"].value == pytest.approx(frame["cost"].sum() / 5)
    # The survivor's last fifth is its last step; one episode has no spread
    assert report.metrics["ultimate_bound"].value == 1 / 16 and np.isnan(report.metrics["ultimate_bound"].low)
    # Wilson's interval of one death in two episodes
    assert report.metrics["death_rate"] == pytest.approx((0.5, 0.0945, 0.9055), abs=1e-4)
    assert report.by_cost["n_transitions"].sum() == 4
    assert len(report.plot().axes) == 4


@pytest.mark.parametrize("n", [2, 71, 72, 500])
def test_interval_of_a_percentile_covers_it(n):
    # Of a sorted sample the limits are places, and the number of those below the percentile is binomial
    _, low, high = exact_percentile(np.arange(n), 95)
    assert binom.cdf(high, n, 0.95) - binom.cdf(low, n, 0.95) >= 0.95 and np.isinf(high) == (n < 72)


def test_rewards_above_the_bound_cost_nothing(make_model, make_env):
    model = make_model(n_collect=0)
    model.largest_reward.fill_(3.0)
    report = evaluate_lyapunov(model, make_env(offset=5.0), n_episodes=4, seed=1)
    rewards = report.transitions["reward"]
    assert rewards.max() > 3
    np.testing.assert_allclose(report.transitions["cost"], np.maximum(3.0 - rewards, 0.0))
    # Without any cost there is no share of it
    report = evaluate_lyapunov(model, make_env(offset=1000.0), n_episodes=4, seed=1)
    assert np.isnan(report.metrics["largest_feasible_alpha3"]).all() and "nan" not in report.summary(full=True)
    assert not report.holds and report.summary().startswith("NOT SHOWN: ")


# Statistics


def test_metrics_agree_with_scipy_and_numpy(make_model, make_env):
    model = make_model(gamma=0.8)
    # Sampled actions spread more
    report = evaluate_lyapunov(model, make_env(), n_episodes=15, deterministic=False, seed=1)
    known = report.transitions.dropna()
    assert 0 < report.n_calibrated == len(known) < len(report.transitions)
    line = np.polyfit(known["lyapunov"], known["cost_to_go"], 1)
    assert report.metrics["calibration_slope"].value == pytest.approx(line[0])
    expected = spearmanr(known["lyapunov"], known["cost_to_go"]).statistic
    assert report.metrics["rank_correlation"].value == pytest.approx(expected)
    for name, (value, low, high) in report.metrics.items():
        if name == "cost_bound_alpha3":
            # This policy has not learned anything
            assert np.isnan([low, high]).all() and not report.holds
            continue
        assert low <= value <= high, name
        if name not in ("death_rate", "ultimate_bound", "share_decreasing"):
            assert low < value < high, name
    frame = report.to_frame()
    assert frame.columns.tolist() == ["value", "low", "high"] and frame.index.tolist() == list(report.metrics)
    assert frame.loc["decrease", "low"] == report.metrics["decrease"].low


def test_interval_covers_the_mean_of_dependent_transitions():
    rng = np.random.default_rng(0)
    n_episodes, n_steps, covered, widths = 40, 25, 0, []
    episode = np.repeat(np.arange(n_episodes), n_steps)
    for _ in range(100):
        # Most of the spread is between episodes
        values = 1.0 + rng.normal(size=n_episodes)[episode] + 0.3 * rng.normal(size=len(episode))
        _, low, high = Bootstrap(n_episodes).estimate(ratio, episode, values, np.ones(len(values)))
        covered += low < 1.0 < high
        widths.append(high - low)
    assert 88 <= covered <= 99
    # 2 * 1.96 / sqrt(40): resampling transitions would give intervals five times narrower, that cover half as often
    assert np.mean(widths) == pytest.approx(0.62, rel=0.05)


def test_levels_of_cost():
    rng = np.random.default_rng(0)
    # Half of the costs are zero
    cost = np.where(np.arange(1000) % 2 == 0, 0.0, rng.permutation(1000) + 1.0)
    frame = pd.DataFrame({"episode": np.arange(1000) // 100, "cost": cost, "difference": 2 - cost, "terminated": False})
    frame["lyapunov"], frame["next_lyapunov"] = 2 * cost, 2.0
    table = decrease_by_cost(frame, Bootstrap(10))
    # Two of the five quantiles are zero: the zeros have a level of their own
    assert len(table) == 4 and table["n_transitions"].sum() == 1000
    assert table["cost_low"].iloc[0] == table["cost_high"].iloc[0] == 0 and table["n_transitions"].iloc[0] == 500
    for row in table.itertuples():
        chosen = frame[frame["cost"].between(row.cost_low, row.cost_high)]
        assert row.n_transitions == len(chosen) and row.decrease == pytest.approx(chosen["difference"].mean())
        assert row.share_decreasing == pytest.approx((chosen["difference"] <= 0).mean())
        assert row.decrease_low <= row.decrease <= row.decrease_high
    assert len(decrease_by_cost(frame.assign(cost=3.0), Bootstrap(10))) == 1


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_what_is_not_available_is_said(make_exact_model, gamma):
    model = make_exact_model(gamma=0.9)
    model.gamma = gamma
    # One short episode has neither intervals nor a cost-to-go
    report = evaluate_lyapunov(model, ContractionEnv(lengths=(10,)), n_episodes=1)
    for name, (_, low, high) in report.metrics.items():
        assert name == "death_rate" or np.isnan([low, high]).all(), name
    summary = report.summary(full=True)
    assert report.n_calibrated == 0 and "calibration_slope       not available" in summary and "nan" not in summary
    assert "is undecided: too few episodes" in summary and "What is not available takes what" in summary
    assert report.plot().axes[2].texts[0].get_text() == "no episode is long enough"


# Environments


def test_parallel_envs_give_the_same_transitions(make_model):
    def make_env(rank):
        return lambda: ContractionEnv(starts=((1.0 + rank, 0.5),), lengths=(7,), deaths=(rank == 1,))

    model = make_model(ContractionEnv(), n_collect=0)
    parallel = evaluate_lyapunov(model, DummyVecEnv([make_env(rank) for rank in range(3)]), n_episodes=6)
    one_by_one = ContractionEnv(starts=((1.0, 0.5), (2.0, 0.5), (3.0, 0.5)), lengths=(7,), deaths=(False, True, False))
    single = evaluate_lyapunov(model, one_by_one, n_episodes=6)
    # One episode after the other, each from its own environment
    assert parallel.transitions["episode"].tolist() == np.repeat(np.arange(6), 7).tolist()
    assert parallel.observations[::7, 0].tolist() == [1, 1, 2, 2, 3, 3]
    # Whatever the numbers of the episodes
    frames = [
        report.transitions.drop(columns="episode").sort_values(["step", "cost"]).reset_index(drop=True)
        for report in (parallel, single)
    ]
    pd.testing.assert_frame_equal(*frames, rtol=1e-5)
    assert parallel.metrics["decrease"].value == pytest.approx(single.metrics["decrease"].value, rel=1e-4)


def test_short_episodes_are_not_over_represented(make_model):
    model = make_model(ContractionEnv(), n_collect=0)
    env = DummyVecEnv([lambda: ContractionEnv(lengths=(2,)), lambda: ContractionEnv(lengths=(30,))])
    assert evaluate_lyapunov(model, env, n_episodes=5).episodes["length"].tolist() == [2, 2, 30, 30, 30]


def test_costs_have_the_units_of_the_training(make_model, make_env):
    env, eval_env = (VecNormalize(DummyVecEnv([lambda: make_env(offset=2.0)] * 2), gamma=0.9) for _ in range(2))
    model = make_model(env, gamma=0.9)
    model.largest_reward.fill_(2.0)
    sync_envs_normalization(env, eval_env)
    before = eval_env.obs_rms.mean.copy(), eval_env.ret_rms.var
    report = evaluate_lyapunov(model, eval_env, n_episodes=6, seed=2)
    # Nothing was learned from the evaluation
    assert eval_env.training
    np.testing.assert_array_equal(eval_env.obs_rms.mean, before[0])
    assert eval_env.ret_rms.var == before[1]
    scale = np.sqrt(eval_env.ret_rms.var + eval_env.epsilon)
    states = eval_env.unnormalize_obs(report.observations)
    np.testing.assert_allclose(report.transitions["cost"], np.sum(states**2, axis=1) / scale, rtol=1e-3, atol=1e-4)
    # L is that of the normalized observations
    assert (np.abs(report.observations) <= eval_env.clip_obs).all()


@pytest.mark.parametrize(
    ("make", "policy"),
    [
        (lambda: SimpleMultiObsEnv(discrete_actions=False), "MultiInputPolicy"),
        (lambda: FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False), "CnnPolicy"),
    ],
    ids=["dict", "image"],
)
def test_dict_observations_and_images(make_model, make, policy):
    model = make_model(make(), policy=policy, n_collect=5, policy_kwargs={"net_arch": [8]}, buffer_size=100)
    report = evaluate_lyapunov(model, make(), n_episodes=2)
    assert report.observations is None and report.transitions["lyapunov"].notna().all()
    assert len(report.transitions) >= 2 and len(report.plot().axes) == 4
    # Images are transposed as for the training
    callback = LyapunovCallback(make(), n_episodes=1, eval_freq=4, verbose=0)
    model.learn(5, callback=callback)
    assert callback.last_report is not None and type(callback.eval_env) is type(model.get_env())


# Nothing is changed


def test_same_seed_gives_the_same_report(make_model, make_env):
    model, env = make_model(n_collect=0), make_env()
    reports = []
    for seed in (5, 5, 6):
        th.rand(1)
        reports.append(evaluate_lyapunov(model, env, n_episodes=3, deterministic=False, seed=seed))
    pd.testing.assert_frame_equal(reports[0].transitions, reports[1].transitions)
    assert reports[0].summary(full=True) == reports[1].summary(full=True) != reports[2].summary(full=True)
    # The mean action is judged unless asked otherwise: the start is the same, but not the trajectory
    deterministic = evaluate_lyapunov(model, env, n_episodes=3, seed=5)
    actions, _ = model.predict(deterministic.observations, deterministic=True)
    expected = model.policy.predict_lyapunov(deterministic.observations, actions)
    np.testing.assert_allclose(deterministic.transitions["lyapunov"], expected, rtol=1e-4, atol=1e-6)
    assert (deterministic.observations[:2] == reports[0].observations[:2]).all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize("of_the_model", [True, False])
@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_training_env_is_refused(make_env, algorithm, of_the_model):
    env = make_env()
    model = algorithm("MlpPolicy", env, buffer_size=10, policy_kwargs={"net_arch": [8]})
    env = model.get_env() if of_the_model else env
    with pytest.raises(ValueError, match="is the training environment, whose episodes an evaluation would end"):
        certify(model, env, n_episodes=1)
    with pytest.raises(ValueError, match="is the training environment"):
        model.learn(10, callback=(LyapunovCallback if algorithm is LAC else CertificateCallback)(env))
    assert model.num_timesteps == 0


@pytest.mark.parametrize("judge", [evaluate_lyapunov, certify])
def test_env_must_be_another_one_of_the_same_kind(make_model, make_env, judge):
    def normalized(**kwargs):
        return VecNormalize(DummyVecEnv([make_env]), **kwargs)

    plain, model = make_model(n_collect=0), make_model(normalized(), n_collect=0)
    for policy, env, message in (
        (plain, make_env(n_dim=3), "Observation spaces do not match"),
        (plain, normalized(), r"norm_obs=True.*, but .* no normalization"),
        (model, make_env(), "has no normalization, but the training environment has norm_obs=True"),
    ):
        with pytest.raises(ValueError, match=message):
            judge(policy, env)
    # Rewards matter for the critic, and observations for all
    env = normalized(norm_reward=False)
    if judge is certify:
        certify(model, env, n_episodes=2, seed=5)
    else:
        with pytest.raises(ValueError, match=r"norm_reward=False, .* norm_reward=True: .*sync_envs_normalization"):
            evaluate_lyapunov(model, env)


def test_episode_without_an_end_is_noticed(make_model, make_env, monkeypatch):
    monkeypatch.setattr(rollout, "MANY_STEPS", 19)
    with pytest.warns(UserWarning, match="gone on for 19 steps. If it never ends"):
        evaluate_lyapunov(make_model(n_collect=0), make_env(episode_length=25), n_episodes=1)


# Callback


def test_callback_logs_the_metrics(make_model, make_env, tmp_path, capsys):
    reports, logged = [], []

    class AfterEval(BaseCallback):
        def _on_step(self):
            reports.append(self.parent.last_report)
            return len(reports) < 3

    model = make_model(n_collect=0, gamma=0.8)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    dump = model.logger.dump
    model.logger.dump = lambda step: (logged.append(dict(model.logger.name_to_value)), dump(step))
    callback = LyapunovCallback(make_env(), AfterEval(), n_episodes=3, eval_freq=10, seed=4)
    model.learn(25, callback=callback, log_interval=None)
    assert capsys.readouterr().out.count("measured, not proved") == 2
    report = evaluate_lyapunov(model, make_env(), n_episodes=3, seed=4)
    assert reports[1].transitions.equals(report.transitions)
    feasible = report.metrics["largest_feasible_alpha3"]
    # SB3 cuts names after 36 characters
    assert logged[1]["lyapunov/feasible_alpha3"] == feasible.value and all(len(name) <= 36 for name in logged[1])
    assert callback.history[1]["timesteps"] == 20 and callback.history[1]["feasible_alpha3_low"] == feasible.low
    assert pd.read_csv(tmp_path / "progress.csv")["lyapunov/feasible_alpha3_low"].dropna().iloc[1] == feasible.low
    # A training that is continued from a checkpoint, until the next callback stops it
    model.num_timesteps = 12
    assert model.learn(200, callback=callback, reset_num_timesteps=False).num_timesteps == 17
    # What was evaluated after the checkpoint was of a model that is gone
    model.logger.close()
    assert [entry["timesteps"] for entry in callback.history] == [10, 17]
    # Another training is not mixed with it
    make_model(n_collect=0).learn(5, callback=callback)
    assert callback.history == []


@pytest.mark.filterwarnings("ignore:Observations lie far")
@pytest.mark.parametrize("make_callback", [LyapunovCallback, CertificateCallback])
def test_callbacks_of_stable_baselines3_stop_a_training_after_an_evaluation(make_model, make_env, make_callback, monkeypatch):
    monkeypatch.setattr(fitting, "N_ITERATIONS", 2)  # a function that is no good, and soon there
    options = {"n_episodes": 4, "eval_freq": 10, "seed": 1000, "verbose": 0}
    # A policy that never changes: the second evaluation is as good as the first, and the third is one too many
    model = make_model(n_collect=0, learning_starts=1000, learning_rate=0.0)
    callback = make_callback(make_env(), StopTrainingOnNoModelImprovement(1), **options)
    assert model.learn(100, callback=callback).num_timesteps == 30
    rewards = callback.last_report.transitions.groupby("episode")["reward"].sum()
    assert callback.best_mean_reward == pytest.approx(rewards.mean())
    for threshold, steps in ((callback.best_mean_reward - 0.1, 10), (callback.best_mean_reward + 0.1, 20)):
        stop = StopTrainingOnRewardThreshold(threshold)
        assert model.learn(20, callback=make_callback(make_env(), stop, **options)).num_timesteps == steps


@pytest.mark.filterwarnings("ignore:Observations lie far")
@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_training_with_callback_is_the_same_to_the_bit(make_env, algorithm, monkeypatch):
    monkeypatch.setattr(fitting, "N_ITERATIONS", 2)

    def train(callback):
        env = VecNormalize(make_vec_env(make_env, n_envs=2, seed=0), gamma=0.99)
        options = {"learning_starts": 20, "batch_size": 16, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}}
        return algorithm("MlpPolicy", env, **options, seed=0, device="cpu").learn(84, callback=callback)

    env = VecNormalize(make_vec_env(make_env, n_envs=3))
    make = LyapunovCallback if algorithm is LAC else CertificateCallback
    callback = make(env, n_episodes=4, eval_freq=7, verbose=0)
    model, alone = train(callback), train(None)
    assert len(callback.history) == 84 // 14
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, alone.policy.state_dict()[name]), name
    np.testing.assert_array_equal(env.obs_rms.mean, model.get_vec_normalize_env().obs_rms.mean)
    assert env.ret_rms.var == model.get_vec_normalize_env().ret_rms.var != 1
