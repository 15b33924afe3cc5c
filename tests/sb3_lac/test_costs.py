"""What enters from an environment: terminations that cost nothing, and numbers that are not finite."""

import re
import warnings
from itertools import cycle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from sb3_lac import LAC
from tests.sweeps import sweep


class Priced(gym.Wrapper):
    """A termination has a price."""

    def __init__(self, env, price):
        super().__init__(env)
        self.price = price

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward - self.price * terminated, terminated, truncated, info


def in_dict(env):
    space = spaces.Dict({"state": env.observation_space})
    return gym.wrappers.TransformObservation(env, lambda obs: {"state": obs}, space)


def warnings_of(model, n_steps=60):
    """What it says of terminations, in training and when that is continued."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(n_steps)
        model.learn(6, reset_num_timesteps=False)
    assert model._n_updates > 0
    return [str(warning.message) for warning in caught if "termination" in str(warning.message)]


@pytest.mark.parametrize(
    ("n_envs", "wrapper", "kwargs"),
    [
        (1, None, {}),
        (3, None, {}),
        (1, None, {"n_steps": 3}),
        (1, None, {"buffer_size": 30}),
        (2, in_dict, {"policy": "MultiInputPolicy"}),
    ],
)
def test_free_terminations_warn_once(make_model, make_env, n_envs, wrapper, kwargs):
    lengths = cycle((5, 7))

    class Failing(gym.Wrapper):
        def reset(self, **kwargs):
            self.unwrapped.episode_length = next(lengths)
            return self.env.reset(**kwargs)

    env = make_vec_env(lambda: Failing(make_env(terminate=True)), n_envs, wrapper_class=wrapper)
    model = make_model(env, n_collect=0, gamma=0.9, **kwargs)
    (message,) = warnings_of(model)
    assert "the cheapest policy" in message and "time limit" not in message
    lengths = cycle((5, 5))
    model = make_model(env, n_collect=0, gamma=0.9, **kwargs)
    (message,) = warnings_of(model)
    assert "have 5 steps, as with a time limit. If it is one, return truncated=True" in message
    assert "cheapest policy" not in message and "price" not in message


def test_warning_names_the_costs(make_model):
    class Fixed(gym.Env):
        """Costs of 1, 3, 1, 3, and of 2 in the step that ends an episode, the fifth or the seventh."""

        observation_space = action_space = spaces.Box(-1, 1, (1,))
        last_step = 7

        def reset(self, seed=None, options=None):
            self.n_steps, self.last_step = 0, 12 - self.last_step
            return self.observation_space.low, {}

        def step(self, action):
            self.n_steps += 1
            cost = 2 if self.n_steps == self.last_step else 3 - 2 * (self.n_steps % 2)
            return self.observation_space.low, -cost, self.n_steps == self.last_step, False, {}

    (message,) = warnings_of(make_model(Fixed(), n_collect=0, gamma=0.75, learning_starts=35))
    # 2 per step for ever: 2 / (1 - 0.75)
    assert "costs 2 on average" in message and "(up to 3)" in message and "about 8 " in message
    (message,) = warnings_of(make_model(Fixed(), n_collect=0, gamma=1.0, learning_starts=35))
    assert "about inf " in message
    # One end alone may be either
    (message,) = warnings_of(make_model(Fixed(), n_collect=0, learning_starts=8))
    assert "ended (1) have 5 steps" in message and "If it is a failure, its last step has to cost more" in message


@pytest.mark.parametrize(
    ("env", "wrapped", "kwargs"),
    [
        # a time limit; one that the buffer cannot tell from a termination; living pays; each step is an end
        ({"terminate": False}, None, {}),
        (
            {"terminate": False},
            None,
            {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "optimize_memory_usage": True},
        ),
        ({"offset": 1.0}, None, {}),
        ({}, None, {"reward_bound": 1.0}),
        ({"episode_length": 1}, None, {}),
        # a price of more than the dearest step, whose state is (10, 10) at most; steps that cost nothing
        ({}, lambda env: Priced(env, 200.0), {}),
        ({}, lambda env: gym.wrappers.TransformReward(env, lambda reward: 0.0), {}),
    ],
)
def test_nothing_to_warn_of(make_model, make_env, env, wrapped, kwargs):
    env = make_env(**{"episode_length": 5, "terminate": True, **env})
    assert warnings_of(make_model(env if wrapped is None else wrapped(env), n_collect=0, **kwargs)) == []


@pytest.mark.parametrize(
    "env_id", ["CartPoleCost-v0", "LinearCost-v0", "Oscillator-v0", "PendulumCost-v0", "QuadrotorCost-v0", "VehicleCost-v0"]
)
def test_cost_environments_do_not_warn(make_model, env_id):
    model = make_model(env_id, n_collect=0, learning_starts=400)
    assert warnings_of(model, n_steps=401) == []
    ends = model.replay_buffer.dones > model.replay_buffer.timeouts
    assert ends.any() == (env_id in ("CartPoleCost-v0", "QuadrotorCost-v0", "VehicleCost-v0"))


class Spoilt(gym.Wrapper):
    """Something is not a finite number: what ``reset()`` observes, or what the fifth step observes or pays."""

    def __init__(self, env, where, number):
        super().__init__(env)
        self.where, self.number = where, number

    def reset(self, **kwargs):
        self.n_steps = 0
        obs, info = self.env.reset(**kwargs)
        return (obs + self.number if self.where == "first observation" else obs), info

    def step(self, action):
        self.n_steps += 1
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.n_steps == 5:
            reward += self.number if self.where == "reward" else 0.0
            obs = obs + self.number if self.where != "reward" else obs
            terminated = self.where == "last observation"
        return obs, reward, terminated, truncated, info


def test_the_environment_is_not_blamed_for_an_action(make_model):
    noise = NormalActionNoise(np.full(2, np.nan), np.ones(2))
    with pytest.raises(ValueError, match="The policy gave the action nan at step 1"):
        make_model(action_noise=noise)


@pytest.mark.parametrize("wrapper", sweep(None, in_dict))
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("number", sweep(float("nan"), 9.9e37, float("inf"), -float("inf")))
@pytest.mark.parametrize("where", ["first observation", "observation", "last observation", "reward"])
def test_what_is_not_finite_is_refused_before_it_is_stored(make_model, make_env, where, number, normalized, wrapper):
    env = make_vec_env(lambda: Spoilt(make_env(), where, number), 1, wrapper_class=wrapper)
    policy = "MlpPolicy" if wrapper is None else "MultiInputPolicy"
    model = make_model(VecNormalize(env) if normalized else env, n_collect=0, policy=policy)
    named = "nan" if normalized and where == "last observation" else re.escape(str(number))
    # VecNormalize hands on the last observation of an episode clipped
    if normalized and where == "last observation" and number == number:
        model.learn(10)
        return
    with pytest.raises(ValueError, match=rf"gave the {where} .*{named} at step \d+: all must be finite") as error:
        model.learn(20)
    assert ("statistics of VecNormalize have it" in str(error.value)) == (normalized and where != "last observation")
    assert model._n_updates == 0 and model.replay_buffer.pos <= 4
    assert np.isfinite(model.replay_buffer.rewards).all()


class FillingExtractor(FlattenExtractor):
    """Readings that are missing are zero."""

    def forward(self, observations):
        return super().forward(observations.nan_to_num(0.0, 0.0, 0.0))


@pytest.mark.parametrize("where", ["first observation", "observation", "last observation", "reward"])
def test_observations_are_left_to_an_extractor_that_handles_them(make_model, make_env, tmp_path, where):
    policy_kwargs = {"features_extractor_class": FillingExtractor}
    model = make_model(Spoilt(make_env(), where, np.nan), n_collect=0, check_observations=False, policy_kwargs=policy_kwargs)
    if where == "reward":
        with pytest.raises(ValueError, match="The environment gave the reward nan at step"):
            model.learn(60)
        return
    model.learn(60)
    assert model._n_updates == 20 and all(th.isfinite(tensor).all() for tensor in model.policy.state_dict().values())
    model.save(tmp_path / "model")
    assert LAC.load(tmp_path / "model").check_observations is False


def test_rewards_may_be_a_list(make_model, make_env):
    class Listed(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            observations, rewards, dones, infos = self.venv.step_wait()
            return observations, rewards.tolist(), dones, infos

    model = make_model(Listed(make_vec_env(lambda: make_env(offset=3.0), 2)), n_collect=60)
    assert model.largest_reward.item() == model.replay_buffer.rewards.max() > 0


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU"))]
)
@pytest.mark.parametrize("where", ["observations", "next_observations", "actions", "rewards"])
def test_what_was_put_into_the_buffer_elsewhere_reaches_no_weights(make_model, make_env, where, device):
    model = make_model(make_env(), device=device)
    getattr(model.replay_buffer, where)[:] = float("nan")
    weights = [parameter.detach().clone() for parameter in model.policy.parameters()]
    with pytest.raises(ValueError, match=rf"The replay buffer gave {where} with nan at step \d+: all must be finite"):
        model.train(1)
    assert all(th.equal(*pair) for pair in zip(weights, model.policy.parameters(), strict=True))


def test_rewards_that_are_computed_at_sampling_are_refused_too(make_model):
    class Undefined(BitFlippingEnv):
        """Its rewards are numbers only where it is the environment that asks for them."""

        def compute_reward(self, achieved_goal, desired_goal, info):
            rewards = super().compute_reward(achieved_goal, desired_goal, info)
            return rewards if np.ndim(achieved_goal) < 2 else rewards + np.inf

    env = Undefined(n_bits=3, continuous=True)
    model = make_model(env, n_collect=0, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
    with pytest.raises(ValueError, match="The replay buffer gave rewards with inf"):
        model.learn(100)
