import copy
import pickle
import random

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac import LAC, PublishedLAC, published_lac
from tests.sweeps import sweep


def assert_same(value, other):
    """Compare nested state dicts, numbers and tensors exactly."""
    th.testing.assert_close(value, other, rtol=0, atol=0)


def assert_same_learned_state(model, other):
    # Policy and optimizers
    assert_same(model.get_parameters(), other.get_parameters())
    for name in ("log_lambda", "log_ent_coef"):
        assert_same(getattr(model, name), getattr(other, name))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
@pytest.mark.parametrize("algorithm", [LAC, PublishedLAC])
def test_a_copy_goes_on_like_the_model_itself(make_model, train_metrics, algorithm, copied):
    model = make_model(n_collect=50, algorithm=algorithm)
    twin = copied(model)
    assert_same(*(train_metrics(each, gradient_steps=5) for each in (model, twin)))
    assert_same_learned_state(model, twin)


@pytest.mark.parametrize(
    ("n_envs", "norm_reward", "kwargs"),
    [
        (1, None, {}),
        (2, None, {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2)), "gradient_steps": -1}),
        (1, False, {"use_sde": True, "n_steps": 3}),
        *sweep(
            (1, None, {"algorithm": PublishedLAC, "critic_learning_rate": 1e-3}),
            (1, None, {"algorithm": PublishedLAC, "horizon": 3}),
            (2, True, {"lambda_learning_rate": 0.01, "alpha3": 0.2, "lambda_init": 0.5}),
            (1, None, {"ent_coef": 0.1, "policy_kwargs": {"n_critics": 2, "share_features_extractor": True}}),
        ),
    ],
    ids=["default", "noise", "normalized_and_gsde", "published", "horizon", "normalized_rewards", "fixed_entropy_and_twins"],
)
def test_interrupted_run_ends_like_an_uninterrupted_one(
    make_model, make_env, n_updates, tmp_path, n_envs, norm_reward, kwargs
):
    def make_wrapped_env():
        env = make_vec_env(make_env, n_envs=n_envs, env_kwargs={"offset": 4.0})
        return env if norm_reward is None else VecNormalize(env, norm_reward=norm_reward)

    reference = make_model(make_wrapped_env(), n_collect=0, learning_starts=20, **kwargs).learn(60)

    # Interrupted at the end of an episode: VecNormalize does not save the returns of an unfinished one
    model = make_model(make_wrapped_env(), n_collect=0, learning_starts=20, **kwargs).learn(40)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay_buffer")
    rng_states = random.getstate(), np.random.get_state(), th.get_rng_state()
    env = model.get_env()
    if norm_reward is not None:
        env.save(tmp_path / "vecnormalize.pkl")
        env = VecNormalize.load(tmp_path / "vecnormalize.pkl", env.venv)

    # The environments go on from where they are
    loaded = type(model).load(tmp_path / "model", env=env, device="cpu", force_reset=False)
    loaded.set_logger(model.logger)
    # To have no two of them in memory
    del loaded.replay_buffer
    loaded.load_replay_buffer(tmp_path / "replay_buffer")
    for set_state, state in zip((random.setstate, np.random.set_state, th.set_rng_state), rng_states, strict=True):
        set_state(state)
    loaded.learn(20, reset_num_timesteps=False)

    assert 0 < n_updates(model) < n_updates(reference) == n_updates(loaded)
    assert reference.largest_reward.item() > 0
    assert_same_learned_state(reference, loaded)


def test_running_environments_can_get_a_normalization(make_model, make_env):
    venv = make_vec_env(make_env)
    model = make_model(venv)
    model.set_env(VecNormalize(venv), force_reset=False)
    model.learn(5, reset_num_timesteps=False)
    assert model.replay_buffer.pos == 45


def test_arguments_are_kept_checked_and_can_be_changed(make_model, tmp_path):
    arguments = {"alpha3": 0.2, "lambda_init": 0.3, "lambda_min": 0.01, "lambda_max": 2.0, "lambda_learning_rate": 1e-4}
    make_model(n_collect=0, **arguments).save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model")
    assert {name: getattr(loaded, name) for name in arguments} == arguments
    assert loaded.lambda_lr_schedule(0.5) == 1e-4
    assert LAC.load(tmp_path / "model", alpha3=0.5).alpha3 == 0.5
    assert LAC.load(tmp_path / "model", lambda_max=0.2).log_lambda.exp().item() == pytest.approx(0.2)
    with pytest.raises(ValueError, match=r"alpha3=-1\.0 must be greater than 0"):
        LAC.load(tmp_path / "model", alpha3=-1)
    # As YAML reads a number without a point
    assert LAC.load(tmp_path / "model", alpha3="1e-1", lambda_max="1e-1").alpha3 == 0.1
    for wrong in ("lots", None, [1.0]):
        with pytest.raises(ValueError, match=r"^alpha3=.* must be a number"):
            LAC.load(tmp_path / "model", alpha3=wrong)


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("policies", "PublishedPolicy"),
        ("policies", "PublishedCnnPolicy"),
        ("policies", "PublishedMultiInputPolicy"),
        ("policies", "SumOfSquaresCritic"),
        ("buffers", "HorizonReplayBuffer"),
    ],
)
def test_files_of_earlier_versions_find_classes_where_these_were(module, name):
    assert pickle.loads(f"csb3_lac.{module}\n{name}\n.".encode()) is getattr(published_lac, name)
