"""The finite horizon candidate: sums of costs along stored episodes."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.her import HerReplayBuffer
from torch.nn import functional as F

from sb3_lac import LAC, evaluate_lyapunov
from sb3_lac.buffers import HorizonReplayBuffer

SPACE = spaces.Box(-np.inf, np.inf, (1,))
ACTIONS = spaces.Box(-1, 1, (1,))


class Recorder:
    """Fills a buffer with numbered steps: the reward of step i of environment e is i + 1000 e, and so is its observation."""

    def __init__(self, horizon, gamma=1.0, buffer_size=20, n_envs=1):
        self.buffer = HorizonReplayBuffer(
            buffer_size * n_envs, SPACE, ACTIONS, device="cpu", n_envs=n_envs, horizon=horizon, gamma=gamma
        )
        self.n_envs = n_envs
        self.steps = 0

    def add(self, n_steps, terminated=None, truncated=None, env_idx=0):
        """Add steps, the last of which may end the episode of one environment."""
        for i in range(n_steps):
            now = self.steps + 1000.0 * np.arange(self.n_envs)
            done, timeout = np.zeros(self.n_envs), np.zeros(self.n_envs, dtype=bool)
            if i == n_steps - 1:
                done[env_idx] = float(bool(terminated or truncated))
                timeout[env_idx] = bool(truncated)
            infos = [{"TimeLimit.truncated": bool(flag)} for flag in timeout]
            self.buffer.add(now[:, None], now[:, None] + 1, np.zeros((self.n_envs, 1)), now, done, infos)
            self.steps += 1
        return self

    def sums(self):
        """Observation -> sum, of everything that can be sampled."""
        assert self.buffer.n_complete == self.buffer.complete.sum()
        sample = self.buffer.sample(2000)
        known = set(self.buffer.observations[self.buffer.complete].flatten().tolist())
        sums = dict(zip(sample.observations.flatten().tolist(), sample.horizon_returns.flatten().tolist(), strict=True))
        assert set(sums) == known
        return sums


def test_sum_covers_the_next_steps():
    assert Recorder(horizon=3).add(6).sums() == {0: 3, 1: 6, 2: 9, 3: 12}


def test_sum_is_discounted():
    assert Recorder(horizon=3, gamma=0.5).add(4).sums() == {0: 1.0, 1: 1 + 1 + 0.75}


def test_unfinished_episode_is_used_as_far_as_it_is_known():
    recorder = Recorder(horizon=4)
    with pytest.raises(ValueError, match="horizon=4 steps: use a smaller horizon"):
        recorder.add(3).buffer.sample(1)
    assert recorder.add(1).sums() == {0: 6}
    assert recorder.add(1).sums() == {0: 6, 1: 10}


def test_after_a_termination_nothing_is_paid():
    recorder = Recorder(horizon=3).add(5, terminated=True).add(2)
    assert recorder.sums() == {0: 3, 1: 6, 2: 9, 3: 7, 4: 4}


def test_future_beyond_a_time_limit_is_unknown():
    assert Recorder(horizon=3).add(5, truncated=True).add(3).sums() == {0: 3, 1: 6, 2: 9, 5: 18}


def test_episode_shorter_than_the_horizon_counts_if_it_terminated():
    recorder = Recorder(horizon=10).add(2, terminated=True)
    with pytest.warns(UserWarning, match="episode of 3 steps, which is shorter than horizon=10"):
        recorder.add(3, truncated=True)
    # Said once
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recorder.add(3, truncated=True)
    assert recorder.add(1).sums() == {0: 1, 1: 1}


def test_horizon_beyond_the_time_limit_is_refused_before_the_training():
    with pytest.raises(ValueError, match=r"horizon=201 is longer than the episodes, which max_episode_steps=200 cuts"):
        LAC("MlpPolicy", "Pendulum-v1", horizon=201)
    assert LAC("MlpPolicy", "Pendulum-v1", horizon=200, buffer_size=300).horizon == 200


def test_horizon_can_be_changed_on_loading(make_model, make_env, tmp_path):
    make_model(n_collect=0, horizon=4).save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model", env=make_env(), horizon=None, device="cpu")
    assert loaded.horizon is None and type(loaded.replay_buffer) is ReplayBuffer
    loaded.learn(60)
    assert loaded._n_updates > 0
    assert LAC.load(tmp_path / "model", env=make_env(), horizon=7, device="cpu").replay_buffer.horizon == 7
    assert LAC.load(tmp_path / "model", env=make_env(), device="cpu").replay_buffer.horizon == 4
    make_model(n_collect=0).save(tmp_path / "model")
    assert LAC.load(tmp_path / "model", env=make_env(), horizon=7, device="cpu").replay_buffer.horizon == 7


def test_horizon_is_any_whole_number(make_model):
    assert make_model(n_collect=0, horizon=np.int64(4)).replay_buffer.horizon == 4


def test_overwritten_transitions_are_forgotten():
    recorder = Recorder(horizon=3, buffer_size=6).add(9)
    assert recorder.sums() == {3: 12, 4: 15, 5: 18, 6: 21}
    assert recorder.add(1, terminated=True).sums() == {4: 15, 5: 18, 6: 21, 7: 24, 8: 17, 9: 9}


def test_environments_have_episodes_of_their_own():
    recorder = Recorder(horizon=2, n_envs=2).add(3, terminated=True, env_idx=1).add(2)
    sums = recorder.sums()
    assert {key: value for key, value in sums.items() if key < 1000} == {0: 1, 1: 3, 2: 5, 3: 7}
    assert {key: value for key, value in sums.items() if key >= 1000} == {1000: 2001, 1001: 2003, 1002: 1002, 1003: 2007}


def test_episode_does_not_go_on_after_a_new_start_of_the_training():
    recorder = Recorder(horizon=3).add(4)
    recorder.steps = 50
    assert recorder.add(3).sums() == {0: 3, 1: 6, 50: 153}


def test_reset_forgets_everything():
    recorder = Recorder(horizon=2).add(5)
    recorder.buffer.reset()
    with pytest.raises(ValueError, match="No stored episode"):
        recorder.buffer.sample(1)
    assert recorder.add(2).sums() == {5: 11}


def test_transitions_are_sampled_evenly():
    recorder = Recorder(horizon=5, buffer_size=200).add(100, terminated=True).add(7, truncated=True)
    np.random.seed(0)
    sample = recorder.buffer.sample(20_000)
    _, counts = np.unique(sample.observations.numpy(), return_counts=True)
    assert len(counts) == 103
    assert counts.min() > 120 and counts.max() < 270


def test_sum_of_one_step_is_the_reward():
    sample = Recorder(horizon=1).add(5, truncated=True).add(3).buffer.sample(50)
    assert th.equal(sample.horizon_returns, sample.rewards)
    assert set(sample.observations.flatten().tolist()) == set(range(8))


def test_critic_learns_the_sum_of_a_finite_horizon(make_model, make_env, train_metrics):
    # Cost 3 in each step, whatever happens: L is 3 (1 + 0.9 + 0.81), neither more nor with a tail
    model = make_model(make_env(), horizon=3, gamma=0.9, learning_rate=1e-2)
    model.replay_buffer.rewards[:] = -3.0
    train_metrics(model, gradient_steps=400)
    assert train_metrics(model, seed=1)["lyapunov_mean"] == pytest.approx(3 * 2.71, abs=0.4)


def test_steps_after_a_termination_cost_the_bound(make_model, make_env, train_metrics, monkeypatch):
    # Reward 3 in each of two steps, dead afterwards: of a horizon of four steps, two cost nothing and two cost 3
    model = make_model(make_env(episode_length=2, terminate=True), horizon=4, gamma=1.0, reward_bound=3.0)
    model.replay_buffer.rewards[:] = 3.0
    targets = []
    loss = F.mse_loss
    monkeypatch.setattr(F, "mse_loss", lambda values, y: targets.append(y + model.critic.offset) or loss(values, y))
    metrics = train_metrics(model, gradient_steps=5)
    assert th.cat(targets).unique().tolist() == [6.0, 9.0]
    # These steps themselves cost nothing
    assert metrics["cost"] == 0.0


def test_model_with_a_horizon_is_saved_loaded_and_continued(make_model, make_env, tmp_path):
    model = make_model(horizon=4, gamma=1.0)
    assert isinstance(model.replay_buffer, HorizonReplayBuffer)
    model.learn(30, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = LAC.load(tmp_path / "model", env=make_env())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.horizon == loaded.replay_buffer.horizon == 4
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded._n_updates > model._n_updates


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"horizon": 0}, "horizon=0 must be an integer of at least 1"),
        ({"horizon": 2.5}, "horizon=2.5 must be an integer"),
        ({"horizon": True}, "horizon=True must be an integer"),
        ({"horizon": 5, "n_steps": 3}, "horizon=5 and n_steps=3 are two Lyapunov candidates"),
        ({"horizon": 5, "replay_buffer_class": NStepReplayBuffer}, "horizon=5 and n_steps=3 are two Lyapunov candidates"),
        ({"horizon": 5, "replay_buffer_class": HerReplayBuffer}, "replay_buffer_class=HerReplayBuffer"),
        ({"replay_buffer_class": HorizonReplayBuffer}, "set for instance horizon=5"),
        ({"horizon": 600}, "horizon=600 must not be larger than the 500 steps"),
        (
            {"horizon": 5, "env": SimpleMultiObsEnv(discrete_actions=False), "policy": "MultiInputPolicy"},
            "not supported for Dict",
        ),
    ],
)
def test_bad_horizons_are_named(make_model, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(n_collect=0, **kwargs)


def test_loaded_model_with_a_horizon_waits_for_a_complete_sum(make_model, make_env, tmp_path):
    make_model(horizon=4).save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model", env=make_env(), device="cpu")
    with pytest.warns(UserWarning, match=r"horizon=4 steps yet.*load_replay_buffer\(\) before learn"):
        loaded.learn(10, reset_num_timesteps=False)
    # The first three of ten steps leave no sum of four
    assert loaded._n_updates == 7


def test_sums_of_a_loaded_buffer_have_the_discount_of_the_model(make_model, make_env, tmp_path):
    make_model(horizon=4, gamma=1.0).save(tmp_path / "model")
    filled = make_model(horizon=4, gamma=1.0)
    filled.save_replay_buffer(tmp_path / "buffer")
    loaded = LAC.load(tmp_path / "model", env=make_env(), gamma=0.5, device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(5, reset_num_timesteps=False)
    # All steps of the future count, but less
    buffer = loaded.replay_buffer
    rows, envs = np.array([0]), np.array([0])
    (found,) = buffer._get_horizon_samples(rows, envs, None).horizon_returns.tolist()[0]
    assert found == pytest.approx((buffer.rewards[:4, 0] * 0.5 ** np.arange(4)).sum(), rel=1e-5)


@pytest.mark.parametrize(
    ("stored", "needed", "message"),
    [
        ({"horizon": 4}, {"horizon": 6}, "has horizon=4 and the model horizon=6"),
        ({"horizon": 4}, {}, "has horizon=4 and the model horizon=None"),
        ({}, {"horizon": 6}, "has horizon=None and the model horizon=6"),
        ({"n_steps": 3}, {"n_steps": 5}, "has n_steps=3 and the model n_steps=5"),
        ({}, {"n_steps": 5}, "has n_steps=1 and the model n_steps=5"),
    ],
)
def test_a_buffer_that_sums_other_steps_is_refused(make_model, stored, needed, message, tmp_path):
    make_model(**stored).save_replay_buffer(tmp_path / "buffer")
    model = make_model(**needed, n_collect=0)
    own = model.replay_buffer
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_n_steps_of_a_loaded_model_can_be_changed(make_model, make_env, tmp_path):
    make_model(n_collect=0).save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model", env=make_env(), n_steps=8, device="cpu")
    assert isinstance(loaded.replay_buffer, NStepReplayBuffer) and loaded.replay_buffer.n_steps == 8


# n-step returns


def test_returns_and_values_have_one_discount(make_model, make_env, tmp_path):
    model = make_model(make_env(offset=1.0), n_steps=3, gamma=0.99)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = LAC.load(tmp_path / "model", env=make_env(offset=1.0), gamma=0.5, device="cpu")
    assert loaded.replay_buffer.gamma == 0.5
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(10, reset_num_timesteps=False)
    assert loaded._n_updates > 0 and loaded.replay_buffer.gamma == 0.5
    # Sums of n rewards are no rewards
    assert loaded.reward_bound.item() == loaded.largest_stored_reward < 1.0
    chosen = make_model(make_env(offset=1.0), gamma=0.5, replay_buffer_class=NStepReplayBuffer)
    chosen.learn(10, reset_num_timesteps=False)
    assert chosen.replay_buffer.gamma == 0.5 and chosen.reward_bound.item() == chosen.largest_stored_reward


def test_number_of_steps_is_an_argument_of_the_model(make_model, make_env, tmp_path):
    for kwargs, n_steps in (
        ({"n_steps": 4}, 4),
        ({"replay_buffer_class": NStepReplayBuffer}, 3),
        ({"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 5}}, 5),
    ):
        model = make_model(n_collect=0, **kwargs)
        assert model.n_steps == model.replay_buffer.n_steps == n_steps
        model.save(tmp_path / "model")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert LAC.load(tmp_path / "model", env=make_env(), device="cpu").replay_buffer.n_steps == n_steps
            assert LAC.load(tmp_path / "model", env=make_env(), n_steps=2, device="cpu").replay_buffer.n_steps == 2
            loaded = LAC.load(tmp_path / "model", env=make_env(), n_steps=1, device="cpu")
        assert type(loaded.replay_buffer) is ReplayBuffer


def test_memory_cannot_be_optimized(make_model):
    with pytest.raises(NotImplementedError, match="optimize_memory_usage"):
        make_model(
            n_collect=0, horizon=5, optimize_memory_usage=True, replay_buffer_kwargs={"handle_timeout_termination": False}
        )


class CorridorEnv(gym.Env):
    """All places look the same, and each step costs 1."""

    observation_space = spaces.Box(0, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        return np.zeros(1, np.float32), -1.0, False, self.n_steps >= 20, {}


@pytest.mark.parametrize("between", ["another call of learn", "an evaluation"])
def test_no_sum_goes_on_where_the_environment_was_reset(between):
    options = {"learning_starts": 100, "policy_kwargs": {"net_arch": [4]}}
    model = LAC("MlpPolicy", CorridorEnv(), horizon=5, gamma=1.0, seed=0, **options)
    model.learn(13)
    if between == "an evaluation":
        evaluate_lyapunov(model, model.get_env(), 2, seed=5)
    model.learn(13, reset_num_timesteps=between != "an evaluation")
    buffer = model.replay_buffer
    assert buffer.episode_lengths.tolist() == [13]
    complete = np.flatnonzero(buffer.complete[: buffer.pos, 0])
    assert complete.tolist() == [*range(9), *range(13, 22)]
    sums = buffer._get_horizon_samples(complete, np.zeros(len(complete), int), None).horizon_returns
    assert (sums == -5).all()


def test_a_buffer_of_single_steps_is_not_replaced_by_one_of_n_steps():
    with pytest.warns(UserWarning, match=r"n_steps=3 is ignored, because replay_buffer_class=ReplayBuffer"):
        model = LAC("MlpPolicy", "Pendulum-v1", replay_buffer_class=ReplayBuffer, n_steps=3, buffer_size=10)
    assert type(model.replay_buffer) is ReplayBuffer and model.n_steps == 1


def test_a_discount_of_numpy_trains_on_returns_of_n_steps():
    options = {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [4]}}
    model = LAC("MlpPolicy", "Pendulum-v1", gamma=np.float64(0.9), n_steps=3, **options).learn(15)
    assert model.gamma == 0.9 and type(model.gamma) is float
