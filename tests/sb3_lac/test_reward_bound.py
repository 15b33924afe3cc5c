"""Positive rewards: what a termination costs, and the offset that carries the bound of the rewards."""

import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_lac import LAC, evaluate_lyapunov


def predictions(model, buffer=None):
    """L of all transitions in its replay buffer, or in another one."""
    buffer = buffer or model.replay_buffer
    return model.policy.predict_lyapunov(buffer.observations[: buffer.pos, 0], buffer.actions[: buffer.pos, 0])


def test_report_counts_the_bound_after_a_termination(make_model, make_env):
    model = make_model(make_env(), n_collect=0, gamma=0.5, reward_bound=2.0)
    report = evaluate_lyapunov(model, make_env(episode_length=3, terminate=True, offset=1.0), n_episodes=2, seed=1)
    costs = report.transitions["cost"].to_numpy().reshape(2, 3)
    np.testing.assert_allclose(costs, 2.0 - report.transitions["reward"].to_numpy().reshape(2, 3))
    last = costs[:, 2] + 0.5 * 4.0
    expected = np.stack([costs[:, 0] + 0.5 * (costs[:, 1] + 0.5 * last), costs[:, 1] + 0.5 * last, last], axis=1)
    np.testing.assert_allclose(report.transitions["cost_to_go"].to_numpy().reshape(2, 3), expected)


def test_offset_has_the_units_of_normalized_rewards(make_model, make_env, train_metrics):
    env = VecNormalize(DummyVecEnv([lambda: make_env(offset=3.0)]), gamma=0.75)
    model = make_model(env, gamma=0.75, reward_bound=3.0)
    for scale in (2.0, 5.0):
        env.ret_rms.var = scale**2 - env.epsilon
        train_metrics(model)
        assert model.policy.critic.offset.item() == pytest.approx(4 * 3.0 / scale)
        assert model.policy.critic_target.offset.item() == pytest.approx(4 * 3.0 / scale)
    # Rewards are clipped, and so is the bound
    env.ret_rms.var, env.epsilon = 1e-4, 0.0
    train_metrics(model)
    assert model.policy.critic.offset.item() == pytest.approx(4 * env.clip_reward)


@pytest.mark.parametrize(
    ("normalized", "kwargs"), [(False, {}), (True, {}), (False, {"n_steps": 3}), (False, {"reward_bound": 0.5})]
)
def test_bound_is_the_largest_reward_of_one_step(make_model, make_env, normalized, kwargs):
    env = DummyVecEnv([lambda: make_env(offset=4.0)])
    model = make_model(VecNormalize(env) if normalized else env, gamma=0.75, **kwargs)
    assert model.largest_reward.item() == model.replay_buffer.rewards.max() > 1
    # Seen before the first update, and in L
    if not normalized:
        assert model.critic.offset.item() == pytest.approx(4 * model.replay_buffer.rewards.max(), rel=1e-4)


def test_stated_bound_holds_from_the_start(make_model, make_env, train_metrics):
    model = make_model(make_env(offset=4.0), gamma=0.75, reward_bound=5.0)
    for _ in range(2):
        assert model.bound_in().value.item() == 5.0 and model.critic.offset.item() == 20.0
        assert train_metrics(model, gradient_steps=5)["cost"] >= 1.0


def test_bound_and_offset_are_saved_and_a_larger_bound_can_be_stated_on_loading(make_model, make_env, train_metrics, tmp_path):
    model = make_model(make_env(offset=4.0), gamma=0.75, reward_bound=5.0)
    train_metrics(model, gradient_steps=5)
    model.save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model", device="cpu")
    assert loaded.bound_in().value.item() == 5.0
    np.testing.assert_array_equal(predictions(loaded, model.replay_buffer), predictions(model))
    changed = LAC.load(tmp_path / "model", reward_bound=7.0, device="cpu")
    assert changed.bound_in().value.item() == 7.0
    # Without an environment L is that of the new bound from the next update on, which adds 2 / (1 - gamma)
    changed.replay_buffer = model.replay_buffer
    changed.costs(model.replay_buffer.sample(4))
    np.testing.assert_allclose(predictions(changed), predictions(model) + 8.0, rtol=1e-5)
    assert changed.largest_reward.item() == 7.0
    # With one it is at once, that of a new discount too
    stated = {"reward_bound": 7.0, "custom_objects": {"gamma": 0.9375}}
    loaded = LAC.load(tmp_path / "model", model.get_env(), device="cpu", **stated)
    np.testing.assert_allclose(predictions(loaded, model.replay_buffer), predictions(model) + 92.0, rtol=1e-5)
    assert loaded.critic_target.offset.item() == 112.0


def test_report_does_not_change_the_critic(make_model, make_env, train_metrics):
    env = VecNormalize(DummyVecEnv([lambda: make_env(offset=3.0)]), gamma=0.75)
    model = make_model(env, gamma=0.75, reward_bound=3.0)
    train_metrics(model)
    state = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    eval_env = VecNormalize(DummyVecEnv([lambda: make_env(offset=3.0)]), gamma=0.75)
    eval_env.ret_rms.var = 4.0 - eval_env.epsilon
    report = evaluate_lyapunov(model, eval_env, n_episodes=2, seed=1)
    assert all(th.equal(state[name], tensor) for name, tensor in model.policy.state_dict().items())
    # Its values have the units of its rewards: with an offset of 4 * 3 / 2
    actions, _ = model.predict(report.observations, deterministic=True)
    of_the_training = model.policy.predict_lyapunov(report.observations, actions)
    shift = 6.0 - model.critic.offset.item()
    np.testing.assert_allclose(report.transitions["lyapunov"], of_the_training + shift, rtol=1e-3, atol=1e-3)


def test_without_discount_a_positive_reward_makes_values_infinite_and_ends_no_training(make_model, make_env, train_metrics):
    with pytest.warns(UserWarning, match="With gamma=1 and rewards up to"):
        model = make_model(make_env(offset=4.0), n_collect=60, gamma=1.0)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    assert train_metrics(model)["lyapunov_mean"] == np.inf
    # What is learned is relative
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
    assert not any(th.equal(*pair) for pair in zip(before, model.actor.parameters(), strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = evaluate_lyapunov(model, make_env(offset=4.0), n_episodes=4, seed=1)
    assert "L is not finite" in report.summary() and not report.holds
