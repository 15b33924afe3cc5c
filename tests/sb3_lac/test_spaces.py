"""LAC works wherever SAC works: observations, replay buffers, exploration and vectorized environments."""

import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv

from sb3_lac import LAC, PublishedLAC


class RandomEnv(gym.Env):
    """Random observations, and a cost of actions."""

    def __init__(self, observation_space, action_space):
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(np.asarray(action, dtype=self.action_space.dtype))
        return self.observation_space.sample(), -float(np.sum(np.square(action))), False, False, {}


def check_training(model, n_steps=60):
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.learn(n_steps)
    state = model.policy.state_dict()
    for part in ("actor.", "critic.", "critic_target."):
        names = [name for name in state if name.startswith(part)]
        assert any(not th.equal(before[name], state[name]) for name in names), part
    assert all(th.isfinite(tensor).all() for tensor in state.values())
    assert model.logger.name_to_value["train/cost"] >= 0


def test_arguments_are_those_of_sac_and_the_own_ones_follow_target_entropy():
    parameters, sac_parameters = (list(inspect.signature(cls.__init__).parameters.values()) for cls in (LAC, SAC))
    names = [parameter.name for parameter in parameters]
    own = ["alpha3", "lambda_init", "lambda_min", "lambda_max", "lambda_learning_rate", "reward_bound", "compile_update"]
    own.append("check_observations")
    start = names.index("target_entropy") + 1
    assert names[start : start + len(own)] == own
    shared = [(parameter.name, parameter.default) for parameter in parameters if parameter.name not in own]
    # 0.99 too, where the environment states no other one; and a weight in a root's unit
    others = {"gamma": "auto", "ent_coef": "auto_0.1"}
    assert shared == [(parameter.name, others.get(parameter.name, parameter.default)) for parameter in sac_parameters]


@pytest.mark.parametrize(
    ("action_space", "message"),
    [
        (spaces.Discrete(3), "only supports .* as action spaces but Discrete"),
        (spaces.Box(-1, np.inf, (2,)), "must have a finite lower and upper bound"),
        (spaces.Box(np.float32([-1, 0]), np.float32([1, 0])), r"The bounds of Box\(.*\) must differ"),
        (spaces.Box(-3.4e38, 3.4e38, (2,)), r"The bounds of Box\(-3\.4e\+38.*\) are so far apart.*TransformAction"),
    ],
)
def test_only_bounded_continuous_actions_are_supported(make_model, action_space, message):
    with pytest.raises((AssertionError, ValueError), match=message):
        make_model(RandomEnv(spaces.Box(-1, 1, (2,)), action_space), n_collect=0)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("use_sde", [False, True])
def test_parallel_envs_and_gsde(make_model, make_env, n_updates, n_envs, use_sde):
    env = make_vec_env(make_env, n_envs=n_envs)
    model = make_model(env, n_collect=0, gradient_steps=-1, train_freq=2, use_sde=use_sde, sde_sample_freq=4)
    check_training(model)
    # As many updates as steps in each rollout of two calls that ends after step 40
    assert n_updates(model) == {1: 20, 3: 24}[n_envs]


def test_gsde_noise_of_both_actors_is_sampled_in_each_update(make_model, monkeypatch):
    model, sampled = make_model(use_sde=True, algorithm=PublishedLAC), []
    for actor in (model.actor, model.actor_target):
        sample = actor.reset_noise
        monkeypatch.setattr(actor, "reset_noise", lambda actor=actor, sample=sample: sampled.append(actor) or sample())
    model.train(gradient_steps=2, batch_size=16)
    assert sampled == 2 * [model.actor, model.actor_target]


@pytest.mark.parametrize("observation_space", [spaces.Discrete(4), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3)])
def test_discrete_observations(make_model, observation_space):
    check_training(make_model(RandomEnv(observation_space, spaces.Box(-1, 1, (2,))), n_collect=0))


@pytest.mark.parametrize("n_channels", [1, 3])
def test_image_observations(make_model, n_channels):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=n_channels, discrete=False)
    features = {"features_extractor_kwargs": {"features_dim": 8}}
    model = make_model(
        env, n_collect=0, policy="CnnPolicy", policy_kwargs=features, learning_starts=10, buffer_size=20, batch_size=4
    )
    check_training(model, n_steps=15)


def test_rewards_computed_at_sampling_raise_the_bound(make_model):
    class PositiveReward(BitFlippingEnv):
        """Reward 0, and 1 at the goal, which relabelled transitions reach before the agent does."""

        def compute_reward(self, achieved_goal, desired_goal, info):
            return super().compute_reward(achieved_goal, desired_goal, info) + 1.0

    model = make_model(
        PositiveReward(n_bits=8, continuous=True),
        policy="MultiInputPolicy",
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "final"},
    )
    assert model.replay_buffer.rewards.max() <= 0.0
    check_training(model)
    assert model.largest_reward.item() == 1.0


@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Box(-1, 1, (1,)),
        spaces.Box(-2, 2, (2, 3)),
        spaces.Box(np.array([-3.0, 0.0]), np.array([5.0, 0.1]), dtype=np.float64),
    ],
    ids=["one", "matrix", "asymmetric_float64"],
)
def test_actions_of_any_shape_and_range(make_model, action_space):
    model = make_model(RandomEnv(spaces.Box(-1, 1, (3,)), action_space), n_collect=0)
    check_training(model)
    assert model.target_entropy == -np.prod(action_space.shape)
    actions, _ = model.predict(np.ones((20, 3), dtype=np.float32))
    assert actions.shape == (20, *action_space.shape)
    assert all(action_space.contains(action.astype(action_space.dtype)) for action in actions)
