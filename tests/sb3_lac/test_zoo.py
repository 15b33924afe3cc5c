import argparse
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, is_vecenv_wrapped
from torch import nn

pytest.importorskip("rl_zoo3")

import optuna
import rl_zoo3
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_lac import LAC, GymnasiumVecEnv
from sb3_lac.zoo import LACExperimentManager, find_config, main, steps_as_one_batch

ENV = "Pendulum-v1"
CONFIG = {
    "default": {
        "policy": "MlpPolicy",
        "n_timesteps": 60,
        "learning_rate": "lin_3e-4",
        "lambda_learning_rate": "lin_5e-5",
        "learning_starts": 40,
        "buffer_size": 500,
        "batch_size": 8,
        "normalize": "dict(norm_obs=True, norm_reward=True)",
        "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.LeakyReLU, output_dim=4)",
    }
}


@pytest.fixture
def workdir(tmp_path, monkeypatch):
    """A folder with hyperparameters in zoo_configs, as the current one."""
    (tmp_path / "zoo_configs").mkdir()
    (tmp_path / "zoo_configs" / "lac.yml").write_text(yaml.dump(CONFIG))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["python"])
    return tmp_path


def test_algorithm_is_registered():
    assert rl_zoo3.ALGOS["lac"] is LAC
    assert "lac" in HYPERPARAMS_SAMPLER and "lac" in HYPERPARAMS_CONVERTER


def test_train_continue_and_enjoy(workdir, capsys):
    main(["train", "--env", ENV, "--eval-freq", "-1", "--seed", "1", "--save-replay-buffer"])
    first = LAC.load(workdir / "logs" / "lac" / f"{ENV}_1" / f"{ENV}.zip")
    assert first.num_timesteps == 60 and first._n_updates == 20
    assert first.critic.output_dim == 4 and isinstance(first.actor.latent_pi[1], nn.LeakyReLU)
    assert first.lr_schedule(0.5) == pytest.approx(1.5e-4)
    assert first.lambda_lr_schedule(0.5) == pytest.approx(2.5e-5)

    trained_agent = str(workdir / "logs" / "lac" / f"{ENV}_1" / f"{ENV}.zip")
    main(["train", "--env", ENV, "--eval-freq", "-1", "-n", "50", "-i", trained_agent])
    second = LAC.load(workdir / "logs" / "lac" / f"{ENV}_2" / f"{ENV}.zip")
    assert second._n_updates > first._n_updates

    capsys.readouterr()
    main(["enjoy", "--env", ENV, "-f", "logs", "--no-render", "-n", "201"])
    assert "1 Episodes" in capsys.readouterr().out


def test_optimize(workdir):
    options = ["--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1"]
    storage = ["--storage", str(workdir / "study.log"), "--study-name", "lac"]
    main(["optimize", "--env", ENV, "-n", "50", *options, *storage, "--no-optim-plots", "--seed", "0"])
    storage_backend = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(workdir / "study.log")))
    trials = optuna.load_study(study_name="lac", storage=storage_backend).trials
    assert len(trials) == 2
    assert {"alpha3", "lambda_max", "output_dim", "lambda_learning_rate"} <= set(trials[0].params)


def test_every_sample_is_a_valid_model(make_env):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(5):
        trial = study.ask()
        hyperparams = HYPERPARAMS_SAMPLER["lac"](trial, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
        # What is loaded from a finished trial is what was tried
        assert HYPERPARAMS_CONVERTER["lac"](trial.params) == hyperparams
        model = LAC("MlpPolicy", make_env(), buffer_size=10, device="cpu", **hyperparams)
        assert model.alpha3 == trial.params["alpha3"]
        assert model.lambda_init == model.lambda_max == trial.params["lambda_max"]
        assert model.critic.output_dim == trial.params["output_dim"]


def test_sampler_knows_hindsight_experience_replay():
    trial = optuna.create_study().ask()
    additional_args = {"using_her_replay_buffer": True, "her_kwargs": {"copy_info_dict": True}}
    hyperparams = HYPERPARAMS_SAMPLER["lac"](trial, 2, 1, additional_args)
    assert set(hyperparams["replay_buffer_kwargs"]) == {"copy_info_dict", "n_sampled_goal", "goal_selection_strategy"}


def test_config_of_the_current_folder_comes_first(workdir):
    assert find_config("lac") == workdir / "zoo_configs" / "lac.yml"


def test_other_algorithms_and_configs_can_be_chosen(workdir, monkeypatch):
    calls = []
    monkeypatch.setattr(rl_zoo3.train, "train", lambda: calls.append(sys.argv[1:]))
    (workdir / "zoo_configs" / "td3.yml").write_text("{}")
    main(["train", "--algo", "td3"])
    main(["optimize", "--algo=ppo", "-conf", "my.yml", "--env", ENV])
    assert calls == [
        ["--algo", "td3", "--conf-file", str(workdir / "zoo_configs" / "td3.yml")],
        ["--env", ENV, "--algo", "ppo", "--conf-file", "my.yml", "--optimize-hyperparameters"],
    ]


def test_missing_config_is_explained(workdir, capsys):
    with pytest.raises(SystemExit):
        main(["train", "--algo", "a2c"])
    assert "No hyperparameters for 'a2c'" in capsys.readouterr().err


def run_python(*args):
    return subprocess.run([sys.executable, *args], capture_output=True, text=True)


def test_module_runs_as_a_command():
    result = run_python("-m", "sb3_lac.zoo", "enjoy", "--help")
    assert result.returncode == 0 and "--no-render" in result.stdout


def test_missing_zoo_names_the_extra():
    result = run_python("-c", "import sys; sys.modules['rl_zoo3'] = None; import sb3_lac.zoo")
    assert result.returncode != 0 and "pip install 'sb3_lac[zoo]'" in result.stderr


class TestEnvironments:
    """Copies of an environment are stepped by one call where it is registered with a vector environment that can."""

    @pytest.fixture
    def model_of(self, workdir):
        (workdir / "zoo_configs" / "lac.yml").write_text(yaml.dump({"default": {**CONFIG["default"], "n_envs": 3}}))

        def set_up(env_id):
            options = {"config": "zoo_configs/lac.yml", "eval_freq": -1, "verbose": 0, "seed": 5}
            manager = LACExperimentManager(argparse.Namespace(), "lac", env_id, str(workdir), **options)
            return manager.setup_experiment()[0], Path(manager.save_path)

        return set_up

    def test_one_call_makes_the_episodes_of_single_environments(self, model_of, monkeypatch):
        batched, folder = model_of("BatteryRo-v0")
        monkeypatch.setattr("sb3_lac.zoo.steps_as_one_batch", lambda spec: False)
        single, _ = model_of("BatteryRo-v0")
        assert isinstance(batched.env.unwrapped, GymnasiumVecEnv) and isinstance(single.env.unwrapped, DummyVecEnv)
        assert all(is_vecenv_wrapped(model.env, VecNormalize) for model in (batched, single))
        np.testing.assert_array_equal(batched.env.reset(), single.env.reset())
        for _ in range(70):  # longer than an episode
            action = np.full((3, 1), 0.1, dtype=np.float32)
            steps = batched.env.step(action), single.env.step(action)
            for left, right in zip(steps[0][:3], steps[1][:3], strict=True):
                np.testing.assert_allclose(left, right, rtol=1e-6)
        assert len(pd.read_csv(folder / "0.monitor.csv", comment="#")) == 3

    def test_others_are_stepped_one_by_one(self, model_of):
        assert isinstance(model_of(ENV)[0].env.unwrapped, DummyVecEnv)
        assert not steps_as_one_batch(gym.spec("CartPole-v1"))  # it would go without its own choice of new episodes
