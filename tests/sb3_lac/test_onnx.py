from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from battery_env import OnnxPolicy, PolicyEstimator, TrajectoryDataset
from sb3_lac import LAC, onnx
from sb3_lac.onnx import export_onnx

SMALL = {"net_arch": [16, 16]}  # copied, since Stable-Baselines3 writes into it


@pytest.mark.parametrize("algorithm", [LAC, SAC, TD3, TQC, PPO])
def test_the_file_does_what_the_policy_does(algorithm, tmp_path):
    # torch.compile switches it off for the whole process
    validates = th.distributions.Distribution._validate_args
    model = algorithm("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", policy_kwargs=dict(SMALL))
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    observations = np.array([model.observation_space.sample() for _ in range(100)])
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(policy.predict(observations)[0], expected, atol=1e-5)
    np.testing.assert_allclose(policy.predict(observations[:1])[0], expected[:1], atol=1e-5)
    assert policy.env_id == "Pendulum-v1" and policy.description["algorithm"] == algorithm.__name__
    assert policy.observation_shape == (3,)
    # The model is as it was, and nothing else was written
    assert [file.name for file in tmp_path.iterdir()] == ["policy.onnx"]
    # Nor does the file say where the code lies
    content = (tmp_path / "policy.onnx").read_bytes()
    assert str(Path(onnx.__file__).parent).encode() not in content and b"site-packages" not in content
    assert th.distributions.Distribution._validate_args == validates


def test_observations_are_normalized_as_in_training(tmp_path):
    env = VecNormalize(make_vec_env("LinearCost-v0"), clip_obs=2.0)
    env.obs_rms.mean, env.obs_rms.var = np.array([3.0, -1.0]), np.array([4.0, 0.01])
    model = LAC("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(SMALL))
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy.onnx"))
    observations = np.random.default_rng(0).uniform(-10, 10, (50, 2)).astype(np.float32)
    expected, _ = model.predict(env.normalize_obs(observations), deterministic=True)
    np.testing.assert_allclose(policy.predict(observations)[0], expected, atol=1e-5)


def test_a_model_without_its_environment_needs_to_be_told_of_the_normalization(tmp_path):
    env = VecNormalize(make_vec_env("LinearCost-v0"))
    env.obs_rms.mean, env.obs_rms.var = np.array([3.0, -1.0]), np.array([4.0, 0.01])
    LAC("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(SMALL)).save(tmp_path / "model")
    model = LAC.load(tmp_path / "model", device="cpu")
    for exported in (model, model.policy):
        with pytest.warns(UserWarning, match="has no environment that says whether observations were normalized"):
            export_onnx(exported, tmp_path / f"{type(exported).__name__}.onnx")
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy.onnx", vec_normalize=env))
    observations = np.random.default_rng(0).uniform(-10, 10, (50, 2)).astype(np.float32)
    expected, _ = model.predict(env.normalize_obs(observations), deterministic=True)
    np.testing.assert_allclose(policy.predict(observations)[0], expected, atol=1e-5)


def test_actions_are_float32(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", policy_kwargs=dict(SMALL), _init_setup_model=False)
    model.action_space = spaces.Box(-1.0, 3.0, (1,), np.float64)
    model._setup_model()
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    observations = np.array([model.observation_space.sample() for _ in range(5)])
    actions, _ = policy.predict(observations)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, model.predict(observations, deterministic=True)[0], atol=1e-5)


def test_all_of_it_is_on_the_device_of_the_policy():
    model = PPO("MlpPolicy", VecNormalize(make_vec_env("LinearCost-v0")), device="cpu", policy_kwargs=dict(SMALL))
    # A device that every machine has
    module = onnx.DeterministicPolicy(model.policy.to("meta"), model.get_vec_normalize_env())
    assert {tensor.device.type for tensor in (*module.parameters(), *module.buffers())} == {"meta"}


def test_policies_with_a_memory_are_refused(tmp_path):
    model = RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", device="cpu", n_steps=8, policy_kwargs={"lstm_hidden_size": 4})
    with pytest.raises(ValueError, match="RecurrentActorCriticPolicy has a memory"):
        export_onnx(model, tmp_path / "policy")


def test_gsde_exports_its_mean(tmp_path):
    model = LAC("MlpPolicy", "Pendulum-v1", use_sde=True, seed=0, device="cpu", policy_kwargs=dict(SMALL))
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    observations = np.array([model.observation_space.sample() for _ in range(20)])
    np.testing.assert_allclose(policy.predict(observations)[0], model.predict(observations, deterministic=True)[0], atol=1e-5)


def test_a_calibration_policy_runs_without_torch(tmp_path):
    model = LAC("MlpPolicy", "BatteryRo-v0", seed=0, device="cpu", policy_kwargs=dict(SMALL))
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    discharge = TrajectoryDataset.paper("r_o")[0]
    estimate = PolicyEstimator(policy, policy.env_id).estimate(discharge)
    assert estimate.r_o == pytest.approx(PolicyEstimator(model, "BatteryRo-v0").estimate(discharge).r_o, rel=1e-4)


def test_nothing_is_overwritten(tmp_path):
    model = LAC("MlpPolicy", "Pendulum-v1", device="cpu", policy_kwargs=dict(SMALL))
    (tmp_path / "policy.onnx").write_text("mine")
    with pytest.raises(FileExistsError, match=r"policy\.onnx exists"):
        export_onnx(model, tmp_path / "policy")
    assert (tmp_path / "policy.onnx").read_text() == "mine"


def test_a_file_that_does_something_else_is_not_written(tmp_path, monkeypatch):
    model = LAC("MlpPolicy", "Pendulum-v1", device="cpu", policy_kwargs=dict(SMALL))
    monkeypatch.setattr(onnx, "TOLERANCE", -1.0)
    with pytest.raises(ValueError, match="differs from the original"):
        export_onnx(model, tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def test_other_spaces_are_refused(tmp_path):
    model = PPO("MlpPolicy", "CartPole-v1", device="cpu")
    with pytest.raises(ValueError, match=r"action space Discrete\(2\) must be a Box"):
        export_onnx(model, tmp_path / "policy")


@pytest.mark.filterwarnings("ignore:LAC has no environment")
def test_bad_files_and_observations_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        OnnxPolicy(tmp_path / "missing.onnx")
    (tmp_path / "text.onnx").write_text("no graph")
    with pytest.raises(ValueError, match=r"text.onnx is no ONNX file"):
        OnnxPolicy(tmp_path / "text.onnx")
    model = LAC("MlpPolicy", None, device="cpu", policy_kwargs=dict(SMALL), _init_setup_model=False)
    model.observation_space, model.action_space, model.n_envs = spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (1,)), 1
    model._setup_model()
    policy = OnnxPolicy(export_onnx(model, tmp_path / "policy"))
    with pytest.raises(ValueError, match="must have shape"):
        policy.predict(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="deterministic"):
        policy.predict(np.zeros((1, 2)), deterministic=False)
    with pytest.raises(ValueError, match="which environment"):
        policy.env_id  # noqa: B018


ROOMS = spaces.Box(np.array([90e3, 250.0], np.float32), np.array([110e3, 350.0], np.float32))
IMAGES = spaces.Box(0, 255, (3, 4, 4), np.uint8)
HALF = spaces.Box(np.array([5.0, -np.inf], np.float32), np.array([np.inf, -50.0], np.float32))


@pytest.mark.parametrize(("space", "least"), [(ROOMS, 80.0), (IMAGES, 200.0), (HALF, 8.0)])
def test_observations_of_the_check_fill_the_space(space, least):
    observations = onnx.observations_to_check(space, None)
    assert all(space.contains(observation.astype(space.dtype)) for observation in observations)
    assert (np.ptp(observations, axis=0) > least).all()


def test_a_graph_of_a_constant_action_is_refused_where_observations_are_normalized(tmp_path, monkeypatch):
    env = VecNormalize(make_vec_env("LinearCost-v0"))
    env.obs_rms.mean, env.obs_rms.var = np.array([93.0, -93.0]), np.array([0.01, 0.01])
    model = LAC("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(SMALL))
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


def test_a_mean_far_larger_than_the_deviation_loses_no_digits(tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1"), clip_obs=10.0)
    env.obs_rms.mean, env.obs_rms.var = np.full(3, 29_315.123_456_7), np.full(3, 0.01)
    model = PPO("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=dict(SMALL))
    module = onnx.DeterministicPolicy(model.policy, env)
    observations = (29_315.0 + np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))).astype(np.float32)
    expected, _ = model.predict(env.normalize_obs(observations), deterministic=True)
    with th.no_grad():
        actions = module(th.as_tensor(observations)).numpy()
    np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_wrappers_around_the_normalization_are_refused(tmp_path):
    env = VecFrameStack(VecNormalize(make_vec_env("LinearCost-v0")), 2)
    model = PPO("MlpPolicy", env, device="cpu", policy_kwargs=dict(SMALL))
    with pytest.raises(ValueError, match=r"normalizes observations of shape \(2,\), and those of the policy have \(4,\)"):
        export_onnx(model, tmp_path / "policy")


def test_an_action_that_has_no_choice_is_exported(tmp_path):
    model = PPO("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", policy_kwargs=dict(SMALL), _init_setup_model=False)
    model.action_space = spaces.Box(np.array([-1.0, 0.5], np.float32), np.array([1.0, 0.5], np.float32))
    model._setup_model()
    actions, _ = OnnxPolicy(export_onnx(model, tmp_path / "policy")).predict(np.ones((3, 3), np.float32))
    assert (actions[:, 1] == 0.5).all()
