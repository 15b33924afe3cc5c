import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from battery_env import OnnxPolicy
from sb3_lac import LAC, onnx
from sb3_lac.onnx import export_onnx
from tests.sweeps import sweep

SMALL = {"net_arch": [16, 16]}  # copied, since Stable-Baselines3 writes into it


class Flat(BaseFeaturesExtractor):
    """Has the size of the batch as a number that a graph takes for a constant."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 3)

    def forward(self, observations):
        return observations.view(len(observations), -1)


class Spaces(gym.Env):
    """Nothing but its spaces."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


def new_model(algorithm=LAC, env="Pendulum-v1", **kwargs):
    return algorithm("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(SMALL), **kwargs)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A policy, which has no environment, as a file, and what normalizes its observations."""
    env = normalized([3.0, -1.0], [4.0, 0.01], clip_obs=2.0)
    model = new_model(env=env)
    return model, env, export_onnx(model.policy, tmp_path_factory.mktemp("exported") / "policy", vec_normalize=env)


def normalized(mean, var, env_id="LinearCost-v0", **kwargs):
    env = VecNormalize(make_vec_env(env_id), **kwargs)
    env.obs_rms.mean, env.obs_rms.var = np.array(mean), np.array(var)
    return env


def assert_alike(policy, model, observations, seen=None):
    expected, _ = model.predict(observations if seen is None else seen, deterministic=True)
    np.testing.assert_allclose(policy.predict(observations)[0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("algorithm", "kwargs"), sweep((LAC, {}), (LAC, {"use_sde": True}), *((each, {}) for each in (SAC, TD3, TQC, PPO)))
)
def test_the_file_does_what_the_policy_does(algorithm, kwargs, monkeypatch, tmp_path):
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", True)
    model = new_model(algorithm, **kwargs)
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    observations = np.array([model.observation_space.sample() for _ in range(100)])
    assert_alike(policy, model, observations)
    assert_alike(policy, model, observations[:1])
    assert policy.env_id == "Pendulum-v1" and policy.description["algorithm"] == algorithm.__name__
    assert policy.observation_shape == (3,)
    # Torch checks distributions as before: its exporter switches that off for the whole process
    with pytest.raises(ValueError, match="GreaterThan"):
        th.distributions.Normal(0.0, -1.0)
    # Nothing else was written, and the file does not say where the code lies
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    content = (tmp_path / "policy.onnx").read_bytes()
    assert str(Path(onnx.__file__).parent).encode() not in content and b"site-packages" not in content


def test_observations_are_normalized_as_in_training(exported, tmp_path):
    model, env, path = exported
    observations = np.random.default_rng(0).uniform(-10, 10, (50, 2)).astype(np.float32)
    assert_alike(OnnxPolicy(path), model, observations, env.normalize_obs(observations))
    # A model without its environment needs to be told
    model.save(tmp_path / "model")
    loaded = LAC.load(tmp_path / "model", device="cpu")
    for untold in (loaded, loaded.policy):
        with warnings.catch_warnings(), pytest.raises(UserWarning, match=r"no environment that says whether .* normalized"):
            warnings.simplefilter("error")
            export_onnx(untold, tmp_path / "untold")


def test_a_mean_far_larger_than_the_deviation_loses_no_digits():
    env = normalized(np.full(3, 29_315.123_456_7), np.full(3, 0.01), "Pendulum-v1", clip_obs=10.0)
    model = new_model(PPO, env)
    observations = (29_315.0 + np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))).astype(np.float32)
    expected, _ = model.predict(env.normalize_obs(observations), deterministic=True)
    with th.no_grad():
        actions = onnx.DeterministicPolicy([model.policy], env)(th.as_tensor(observations)).numpy()
    np.testing.assert_allclose(actions, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("algorithm", "low", "high", "dtype", "kwargs"),
    [
        (SAC, [-1.0], [3.0], np.float64, {}),
        (PPO, [-1.0, 0.5], [1.0, 0.5], np.float32, {}),  # the second action has no choice
        (LAC, [-1.0], [1.0], np.float32, {"use_sde": True}),
    ],
)
def test_actions_are_those_of_the_mean_in_float32(algorithm, low, high, dtype, kwargs):
    action_space = spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)
    model = new_model(algorithm, Spaces(spaces.Box(-1, 1, (2,)), action_space), **kwargs)
    observations = np.array([model.observation_space.sample() for _ in range(5)])
    with th.no_grad():
        actions = onnx.DeterministicPolicy([model.policy])(th.as_tensor(observations)).numpy()
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, model.predict(observations, deterministic=True)[0], atol=1e-5)


@pytest.mark.parametrize(
    ("make_model", "message"),
    [
        (lambda: PPO("MlpPolicy", "CartPole-v1", device="cpu"), r"action space Discrete\(2\) must be a Box"),
        (
            lambda: RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", n_steps=8, policy_kwargs={"lstm_hidden_size": 4}),
            "RecurrentActorCriticPolicy has a memory",
        ),
        (
            lambda: new_model(PPO, VecFrameStack(VecNormalize(make_vec_env("LinearCost-v0")), 2)),
            r"normalizes observations of shape \(2,\), and those of the policy have \(4,\)",
        ),
        pytest.param(
            lambda: LAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"features_extractor_class": Flat}, device="cpu"),
            r"traced with 2 observations and does not take 64.* write x\.shape\[0\]",
            marks=pytest.mark.attacks,
        ),
    ],
)
def test_what_has_no_export_is_refused(make_model, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        export_onnx(make_model(), tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def test_bad_files_and_observations_are_refused(exported, tmp_path):
    with pytest.raises(FileNotFoundError):
        OnnxPolicy(tmp_path / "missing.onnx")
    (tmp_path / "mine.onnx").write_text("mine")
    with pytest.raises(FileExistsError, match=r"mine\.onnx exists"):
        export_onnx(new_model(), tmp_path / "mine")
    (tmp_path / "text.onnx").write_text("no graph")
    with pytest.raises(ValueError, match=r"text.onnx is no ONNX file"):
        OnnxPolicy(tmp_path / "text.onnx")
    policy = OnnxPolicy(exported[-1])
    with pytest.raises(ValueError, match=r"observation must have shape \(n, 2\), got \(1, 3\)"):
        policy.predict(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="deterministic"):
        policy.predict(np.zeros((1, 2)), deterministic=False)
    with pytest.raises(ValueError, match="which environment"):
        policy.env_id  # noqa: B018
    content = bytearray(exported[-1].read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "damaged.onnx").write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged\.onnx is damaged: its checksum is wrong"):
        OnnxPolicy(tmp_path / "damaged.onnx")


def test_a_graph_of_a_constant_action_is_not_written(tmp_path, monkeypatch):
    env = normalized([93.0, -93.0], [0.01, 0.01])
    model = new_model(env=env)
    export = onnx.graph_of

    class Constant(th.nn.Module):
        def __init__(self, module, action):
            super().__init__()
            self.low, self.always = module.low, th.as_tensor(action)

        def forward(self, observation):
            return 0.0 * observation[:, :1] + self.always

    def constant(module, observations, *args):
        action, _ = model.predict(env.normalize_obs(observations[:1]), deterministic=True)
        return export(Constant(module, action).eval(), observations, *args)

    monkeypatch.setattr(onnx, "graph_of", constant)
    with pytest.raises(ValueError, match="differs from the original"):
        export_onnx(model, tmp_path / "policy")
    assert not list(tmp_path.iterdir())
