"""The published algorithm: one update, written out a second time from the equations, and the sums of its finite horizon."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_lac import LAC, LyapunovPolicy, PublishedLAC, PublishedPolicy
from sb3_lac.published_lac import HorizonReplayBuffer
from tests.sb3_lac.equations import mlp, policy_sample

GAMMA, TAU, ALPHA3 = 0.9, 0.05, 0.3
RATES = {"actor": 1e-2, "critic": 3e-2}
LAMBDA_RATE = 2e-2
SETTINGS = {"gamma": GAMMA, "tau": TAU, "alpha3": ALPHA3, "ent_coef": "auto_0.7", "lambda_init": 0.5}
SETTINGS |= {"learning_rate": RATES["actor"], "critic_learning_rate": RATES["critic"], "lambda_learning_rate": LAMBDA_RATE}
# With plain gradient descent, a wrong factor in a loss cannot hide (Adam is invariant to scale)
SETTINGS |= {"policy_kwargs": {"net_arch": None, "activation_fn": th.nn.ReLU, "optimizer_class": th.optim.SGD}}


class ShortEpisodes(gym.Wrapper):
    """Rewards above zero, and a termination after five steps."""

    def reset(self, **kwargs):
        self.n_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        self.n_steps += 1
        obs, reward, _, truncated, info = self.env.step(action)
        return obs, reward + 2.0, self.n_steps == 5, truncated, info


def lyapunov(weights, obs, actions):
    """The sum of the squares of the last layer."""
    return (mlp(weights, "lf0", th.cat([obs, actions], dim=1), 3, slope=0) ** 2).sum(dim=1)


@pytest.mark.parametrize("horizon", [None, 5])
@pytest.mark.parametrize("make_env", ["CartPoleCost-v0", "LinearCost-v0", lambda: ShortEpisodes(gym.make("LinearCost-v0"))])
def test_step_is_that_of_the_equations(make_model, make_env, horizon):
    env = make_env if isinstance(make_env, str) else make_env()
    model = make_model(env, 120, algorithm=PublishedLAC, horizon=horizon, learning_starts=120, **SETTINGS)
    batch = model.replay_buffer.sample(32)
    model.replay_buffer.sample = lambda *args, **kwargs: batch
    obs, next_obs, actions, dones = batch.observations, batch.next_observations, batch.actions, batch.dones.flatten()
    bound = model.largest_reward.item()
    costs = bound - batch.rewards.flatten()
    assert (costs >= 0).all()

    networks = ("actor", "critic", "actor_target", "critic_target")
    for network in networks[:2]:
        for parameter in getattr(model, network).parameters():
            # Targets differ from what they follow
            parameter.data.add_(0.05 * th.randn_like(parameter))
    actor, critic, actor_target, critic_target = (
        {name: tensor.detach().clone().requires_grad_(True) for name, tensor in getattr(model, network).named_parameters()}
        for network in networks
    )
    th.manual_seed(1)
    model.train(gradient_steps=1, batch_size=32)

    th.manual_seed(1)
    _, log_prob = policy_sample(actor, obs, slope=0)
    if horizon is None:
        with th.no_grad():
            next_actions, _ = policy_sample(actor_target, next_obs, slope=0)
            after = bound / (1 - GAMMA)  # nothing is paid any more
            next_values = (1 - dones) * lyapunov(critic_target, next_obs, next_actions) + dones * after
            target = costs + GAMMA * next_values
    else:
        target = horizon * bound - batch.horizon_rewards.flatten()
    critic_loss = (0.5 * (lyapunov(critic, obs, actions) - target) ** 2).mean()
    next_actions, _ = policy_sample(actor, next_obs, slope=0)
    d = (lyapunov(critic, next_obs, next_actions) - lyapunov(critic, obs, actions).detach() + ALPHA3 * costs).mean()
    actor_loss = 0.5 * d + 0.7 * log_prob.mean()
    entropy_violation = log_prob.mean() - actions.shape[1]

    logged = {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}
    expected = {
        "critic_loss": critic_loss,
        "actor_loss": actor_loss,
        "lyapunov_difference": d,
        "cost": costs.mean(),
        "lambda": 0.5,
        "ent_coef": 0.7,
        "lambda_loss": -math.log(0.5) * d,
        "ent_coef_loss": -math.log(0.7) * entropy_violation,
    }
    for name, value in expected.items():
        assert logged[name] == pytest.approx(float(value), rel=1e-4), name
    for name, weights, loss in (("critic", critic, critic_loss), ("actor", actor, actor_loss)):
        gradients = th.autograd.grad(loss, list(weights.values()), retain_graph=True)
        for (key, parameter), gradient in zip(getattr(model, name).named_parameters(), gradients, strict=True):
            th.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-5 * gradient.abs().max().item() + 1e-9)
            new = (weights[key] - RATES[name] * gradient).detach()
            th.testing.assert_close(parameter.detach(), new, rtol=1e-4, atol=1e-5 * new.abs().max().item() + 1e-9)
            target_network = {"critic": critic_target, "actor": actor_target}[name]
            followed = dict(getattr(model, f"{name}_target").named_parameters())[key]
            lagged = (1 - TAU) * target_network[key] + TAU * parameter
            th.testing.assert_close(followed.detach(), lagged.detach(), rtol=1e-4, atol=1e-6)
    # Adam's first step is its rate
    assert model.log_lambda.item() == pytest.approx(math.log(0.5) + LAMBDA_RATE * float(d.sign()), rel=1e-4)
    assert model.log_ent_coef.item() == pytest.approx(
        math.log(0.7) + RATES["actor"] * float(entropy_violation.sign()), rel=1e-4
    )


@settings(deadline=None, max_examples=40)
@given(data=st.data(), horizon=st.integers(1, 6), n_envs=st.integers(1, 3), buffer_size=st.integers(8, 20))
def test_horizon_sums_the_next_rewards_and_goes_on_with_the_last_one(data, horizon, n_envs, buffer_size):
    box = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    buffer = HorizonReplayBuffer(buffer_size * n_envs, box, spaces.Box(-1, 1, (1,)), "cpu", n_envs, horizon=horizon)
    n_steps = data.draw(st.integers(1, 3 * buffer_size))
    ends = np.array(
        data.draw(st.lists(st.lists(st.booleans(), min_size=n_envs, max_size=n_envs), min_size=n_steps, max_size=n_steps))
    )
    rewards = np.arange(n_steps * n_envs, dtype=np.float32).reshape(n_steps, n_envs) - 40
    for step in range(n_steps):
        number = (step * n_envs + np.arange(n_envs))[:, None]
        buffer.add(number, number + 0.5, np.zeros((n_envs, 1)), rewards[step], ends[step], [{}] * n_envs)
    batch = buffer.sample(64)
    for observation, following, reward, total in zip(
        batch.observations, batch.next_observations, batch.rewards, batch.horizon_rewards, strict=True
    ):
        step, env = divmod(int(observation), n_envs)
        assert following == observation + 0.5 and reward == rewards[step, env]
        summed, at = 0.0, step
        for _ in range(horizon):
            summed += rewards[at, env]
            at += not ends[at, env] and at + 1 < n_steps
        # The steps of a horizon are known, if there are so many, and none was overwritten
        assert total == summed and n_steps - buffer_size <= step <= max(n_steps - horizon, 0)


def test_the_value_behind_n_steps_is_discounted_as_often(make_model, make_env):
    model = make_model(make_env(episode_length=100), algorithm=PublishedLAC, n_steps=3, gamma=0.5, n_collect=50)
    batch, seed = model.replay_buffer.sample(16), 0
    th.manual_seed(seed)
    targets = model._candidate(batch, -batch.rewards)
    th.manual_seed(seed)
    values = model.critic_target.lyapunov(batch.next_observations, model.actor_target(batch.next_observations))
    assert batch.discounts.min() == 0.125
    th.testing.assert_close(targets, batch.discounts * values.detach() - batch.rewards)


def test_normalized_costs_of_a_horizon_are_summed_in_units_of_the_agent(make_model, make_env):
    env = VecNormalize(DummyVecEnv([lambda: make_env(offset=3.0)]))
    model = make_model(env, algorithm=PublishedLAC, horizon=3)
    env.ret_rms.var = 4.0
    batch = model.replay_buffer.sample(64, env=env)
    costs = model.costs(batch)
    targets = model._candidate(batch, costs)
    assert (targets >= costs - 1e-5).all()
    th.testing.assert_close(targets, 3 * model.bound_in(env).value - batch.horizon_rewards)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"horizon": 0}, "horizon=0 must be a whole number of at least 1"),
        ({"horizon": 3.0}, r"horizon=3\.0 must be a whole number"),
        ({"critic_learning_rate": -1e-3}, "critic_learning_rate=-0.001 must start at a finite rate of at least 0"),
        ({"lambda_learning_rate": float("nan")}, "lambda_learning_rate=nan must start at a finite rate"),
        ({"gamma": 1.0}, "gamma must be smaller than 1 without a horizon"),
        ({"policy": LyapunovPolicy}, "PublishedLAC needs a policy derived from PublishedPolicy, and this is LyapunovPolicy"),
        ({"horizon": 3, "replay_buffer_class": HerReplayBuffer}, "needs a HorizonReplayBuffer"),
    ],
)
def test_bad_arguments_are_named(make_model, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_model(algorithm=PublishedLAC, n_collect=0, **kwargs)


def test_horizon_needs_a_buffer_of_its_own(make_model):
    with pytest.raises(NotImplementedError, match="doesn't support optimize_memory_usage"):
        kwargs = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
        make_model(algorithm=PublishedLAC, n_collect=0, horizon=3, **kwargs)
    with pytest.raises(ValueError, match="observations that are no dictionaries"):
        env = BitFlippingEnv(n_bits=3, continuous=True)
        make_model(env, algorithm=PublishedLAC, n_collect=0, policy="MultiInputPolicy", horizon=3)


def test_horizon_can_be_changed_on_loading(make_model, tmp_path):
    for before, after in ((None, 3), (3, 5), (3, None)):
        make_model(algorithm=PublishedLAC, n_collect=0, horizon=before).save(tmp_path / "model")
        env = make_model(n_collect=0).get_env()
        loaded = PublishedLAC.load(tmp_path / "model", env=env, horizon=after).learn(80)
        assert loaded.horizon == after and loaded._n_updates > 0


def test_horizon_is_that_of_the_model_with_a_buffer_of_another_one(make_model, tmp_path):
    model = make_model(algorithm=PublishedLAC, horizon=3)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    # It goes on without the buffer too: a horizon need not be there yet
    assert PublishedLAC.load(tmp_path / "model", env=model.env).learn(20, reset_num_timesteps=False)._n_updates == 20
    other = make_model(algorithm=PublishedLAC, n_collect=0, horizon=7)
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.horizon == 7


@pytest.mark.filterwarnings("error")
def test_a_horizon_is_a_finite_sum_without_a_discount(make_model, make_env):
    model = make_model(make_env(offset=4.0), algorithm=PublishedLAC, horizon=3, gamma=1.0, reward_bound=5.0)
    assert model.critic.offset.item() == 3 * 5.0


@pytest.mark.parametrize(
    ("kwargs", "of_another", "message"),
    [
        ({"algorithm": PublishedLAC, "horizon": 7}, {}, "horizon=7 needs a HorizonReplayBuffer, and this is a ReplayBuffer"),
        ({"gamma": 1.0}, {"n_steps": 3}, "gamma=1.0 must be smaller than 1 with n-step returns"),
    ],
)
def test_a_buffer_that_is_refused_leaves_the_one_that_is_there(make_model, tmp_path, kwargs, of_another, message):
    make_model(n_collect=1, **of_another).save_replay_buffer(tmp_path / "buffer")
    model = make_model(**kwargs)
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.pos == 40
    model.learn(10, reset_num_timesteps=False)
    assert model._n_updates == 10


def test_model_of_another_algorithm_or_version_is_named(make_model, tmp_path):
    model = make_model(n_collect=0)
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="PublishedLAC needs a policy derived from PublishedPolicy"):
        PublishedLAC.load(tmp_path / "model")
    with pytest.raises(ValueError, match="LAC needs a policy derived from LyapunovPolicy, and this is PublishedPolicy"):
        make_model(n_collect=0, policy=PublishedPolicy)
    # Another version has other tensors
    del model.critic.floor
    model.save(tmp_path / "older")
    with pytest.raises(ValueError, match=r"does not fit this LAC: (.|\n)*another version of sb3_lac"):
        LAC.load(tmp_path / "older")
    with pytest.raises(ValueError, match="whether ent_coef is learned cannot be changed"):
        LAC.load(tmp_path / "model", ent_coef=0.1)
