import argparse
import importlib
import runpy
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, is_vecenv_wrapped
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

pytest.importorskip("rl_zoo3")

import optuna
import rl_zoo3
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_lac import LAC, GymnasiumVecEnv, PublishedLAC, zoo
from sb3_lac.zoo import RL_ZOO_CONFIGS, LACExperimentManager, find_config, main, steps_as_one_batch

ENV = "Pendulum-v1"
SETTINGS = {
    "policy": "MlpPolicy",
    "n_timesteps": 60,
    "learning_rate": "lin_3e-4",
    "lambda_learning_rate": "lin_5e-5",
    "learning_starts": 40,
    "buffer_size": 500,
    "batch_size": 8,
    "normalize": "dict(norm_obs=True, norm_reward=True)",
    "policy_kwargs": "dict(net_arch=[8], activation_fn=nn.LeakyReLU, n_critics=3)",
}


@pytest.fixture
def workdir(tmp_path, monkeypatch):
    """A folder with hyperparameters in zoo_configs, as the current one."""
    (tmp_path / "zoo_configs").mkdir()
    (tmp_path / "zoo_configs" / "lac.yml").write_text(yaml.dump({ENV: SETTINGS, "default": SETTINGS}))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["python"])
    return tmp_path


def test_train_continue_and_enjoy(workdir, n_updates, capsys):
    main(["train", "--env", ENV, "--eval-freq", "-1", "--seed", "1", "--save-replay-buffer"])
    first = LAC.load(workdir / "logs" / "lac" / f"{ENV}_1" / f"{ENV}.zip")
    assert first.num_timesteps == 60 and n_updates(first) == 20
    assert first.critic.n_critics == 3 and isinstance(first.actor.latent_pi[1], nn.LeakyReLU)
    assert first.lr_schedule(0.5) == pytest.approx(1.5e-4)
    assert first.lambda_lr_schedule(0.5) == pytest.approx(2.5e-5)

    trained_agent = str(workdir / "logs" / "lac" / f"{ENV}_1" / f"{ENV}.zip")
    main(["train", "--env", ENV, "--eval-freq", "-1", "-n", "50", "-i", trained_agent])
    second = LAC.load(workdir / "logs" / "lac" / f"{ENV}_2" / f"{ENV}.zip")
    assert n_updates(second) > n_updates(first)

    capsys.readouterr()
    main(["enjoy", "--env", ENV, "-f", "logs", "--no-render", "-n", "201"])
    assert "1 Episodes" in capsys.readouterr().out


def test_logs_for_tensorboard_have_charts(workdir):
    main(["train", "--env", ENV, "--eval-freq", "-1", "-tb", "runs", "-n", "201", "--log-interval", "1"])
    events = EventAccumulator(str(workdir / "runs" / ENV / "LAC_1")).Reload()
    assert "custom_scalars__config__" in events.Tags()["tensors"] and "train/lambda" in events.Tags()["scalars"]


def test_optimize(workdir):
    options = ["--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1"]
    storage = ["--storage", str(workdir / "study.log"), "--study-name", "lac"]
    main(["optimize", "--env", ENV, "-n", "50", *options, *storage, "--no-optim-plots", "--seed", "0"])
    storage_backend = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(workdir / "study.log")))
    trials = optuna.load_study(study_name="lac", storage=storage_backend).trials
    assert len(trials) == 2
    assert {"ent_coef_init", "n_critics"} <= set(trials[0].params)


def test_every_sample_is_a_valid_model(make_env):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for algo in ("lac", "published_lac") * 3:
        trial = study.ask()
        hyperparams = HYPERPARAMS_SAMPLER[algo](trial, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
        # What is loaded from a finished trial is what was tried, with schedules as a configuration has them
        loaded = HYPERPARAMS_CONVERTER[algo](trial.params)
        if trial.params["learning_rate_falls"]:
            schedule, rate = hyperparams["learning_rate"], trial.params["learning_rate"]
            assert loaded.pop("learning_rate") == f"lin_{rate}"
            assert (schedule(1.0), schedule(0.5), schedule(0.0)) == pytest.approx((rate, rate / 2, 0.0))
            loaded["learning_rate"] = schedule
        assert loaded == hyperparams
        # Those of the configuration belong together
        assert not {"train_freq", "gradient_steps", "n_envs"} & set(hyperparams)
        model = rl_zoo3.ALGOS[algo]("MlpPolicy", make_env(), buffer_size=10, device="cpu", **hyperparams)
        assert model.critic.n_critics == trial.params["n_critics"]


def manager_of(env_id, folder, algo="lac", **options):
    arguments = {"config": "zoo_configs/lac.yml", "eval_freq": -1, "verbose": 0, "seed": 5, **options}
    return LACExperimentManager(argparse.Namespace(), algo, env_id, str(folder), **arguments)


def test_trials_on_batteries_are_scored_on_held_out_discharges(workdir):
    manager = manager_of("BatteryRo-v0", workdir, optimize_hyperparameters=True, env_kwargs={"initial_perturbation": 0.1})
    datasets = [manager.create_envs(1, no_log=True, eval_env=each).get_attr("task")[0].dataset for each in (False, True)]
    training, evaluation = (set(zip(data.r_o, data.eod_time_s, strict=True)) for data in datasets)
    assert training and evaluation and not training & evaluation
    asked = manager_of("BatteryRo-v0", workdir, eval_env_kwargs={"split": "all"}, optimize_hyperparameters=True)
    assert asked.eval_env_kwargs == {"split": "all"}


@pytest.fixture
def set_up():
    models = []

    def set_up(manager):
        models.append(manager.setup_experiment()[0])
        return models[-1]

    yield set_up
    for model in models:
        model.env.close()


@pytest.mark.parametrize(("gamma", "of_normalization"), [("auto", 0.99), (0.5, 0.5)])
def test_discount_of_normalized_rewards(gamma, of_normalization, workdir, set_up):
    (workdir / "zoo_configs" / "lac.yml").write_text(yaml.dump({"default": {**SETTINGS, "gamma": gamma}}))
    model = set_up(manager_of(ENV, workdir))
    assert model.get_vec_normalize_env().gamma == of_normalization
    model.learn(10)


@pytest.mark.parametrize("command", ["train", "optimize"])
def test_a_training_without_an_update_is_refused_before_anything_is_written(command, workdir):
    with pytest.raises(ValueError, match="n_timesteps=40 must be more than learning_starts=40"):
        main([command, "--env", ENV, "-n", "40", "--eval-freq", "-1"])
    assert not (workdir / "logs").exists()


def test_other_algorithms_and_configs_can_be_chosen(workdir, monkeypatch):
    calls = []
    for command in ("train", "enjoy"):
        monkeypatch.setattr(getattr(rl_zoo3, command), command, lambda: calls.append(sys.argv[1:]))
    main(["train", "--env", ENV])
    # One that LAC can learn, whose actions are no discrete ones
    main(["train"])
    main(["enjoy", "--algo", "published_lac", "-f", "logs"])
    main(["optimize", "--algo=ppo", "-conf", "my.yml", "--env", ENV])
    # One that only the RL Zoo has hyperparameters of
    main(["train", "--algo", "a2c"])
    assert calls == [
        ["--algo", "lac", "--env", ENV, "--conf-file", str(workdir / "zoo_configs" / "lac.yml")],
        ["--algo", "lac", "--env", "Pendulum-v1", "--conf-file", str(workdir / "zoo_configs" / "lac.yml")],
        ["-f", "logs", "--algo", "published_lac", "--env", "Pendulum-v1"],
        ["--algo", "ppo", "--env", ENV, "--conf-file", "my.yml", "--optimize-hyperparameters"],
        ["--algo", "a2c", "--env", "CartPole-v1", "--conf-file", str(RL_ZOO_CONFIGS / "a2c.yml")],
    ]


def test_the_published_algorithm_needs_a_file_only(workdir):
    arguments = ["--algo", "published_lac", "--env", ENV, "--eval-freq", "-1"]
    settings = {**SETTINGS, "critic_learning_rate": "lin_1e-3", "train_freq": 1, "gradient_steps": 1}
    (workdir / "zoo_configs" / "published_lac.yml").write_text(yaml.dump({ENV: settings}))
    main(["train", *arguments])
    model = PublishedLAC.load(workdir / "logs" / "published_lac" / f"{ENV}_1" / f"{ENV}.zip")
    assert model.num_timesteps == 60 and model.critic_learning_rate(0.5) == 5e-4


def test_algorithm_without_a_file_is_told_what_to_do(workdir, monkeypatch):
    monkeypatch.setitem(zoo.ALGORITHMS, "other_lac", LAC)
    with pytest.raises(FileNotFoundError, match=r"there is no .*zoo_configs/other_lac\.yml"):
        manager_of(ENV, workdir, "other_lac", config=None)


# Which hyperparameters


def test_hyperparameters_are_of_the_first_file_that_knows_the_environment(workdir):
    brought, tuned = find_config("sac"), RL_ZOO_CONFIGS / "sac.yml"
    own = workdir / "zoo_configs" / "sac.yml"
    own.write_text("{Own-v0: {}, default: {}}")
    assert find_config("sac") == own != brought != tuned
    assert find_config("sac", "Own-v0") == own
    assert find_config("sac", ENV) == brought
    assert find_config("sac", "BipedalWalker-v3") == tuned
    assert find_config("sac", "Unknown-v0") == own
    own.write_text("# nothing yet")
    assert find_config("sac", "Unknown-v0") == brought
    assert find_config("ppo", "Unknown-v0") == RL_ZOO_CONFIGS / "ppo.yml"


@pytest.fixture
def stating():
    """The id of an environment that states a discount of 0.8."""
    spaces = {"observation_space": gym.spaces.Box(-1, 1, (1,)), "action_space": gym.spaces.Box(-1, 1, (1,))}
    stating = type("Stating", (gym.Env,), {"metadata": {"render_modes": [], "discount": 0.8}, **spaces})
    gym.register("Stating-v0", entry_point=stating)
    yield "Stating-v0"
    del gym.registry["Stating-v0"]


def hyperparameters_of(folder, env_id, algo, entries, **options):
    config = folder / "entries.yml"
    config.write_text(yaml.dump(entries))
    manager = manager_of(env_id, folder, algo, config=str(config), **options)
    return manager.read_hyperparameters()[1]


@pytest.mark.parametrize("algo", ["lac", "sac", "td3", "tqc", "ppo"])
def test_default_entry_has_the_discount_that_the_environment_states(algo, workdir, stating, monkeypatch):
    entry = {"policy": "MlpPolicy", "n_timesteps": 10}
    for named in ({}, {"gamma": 0.99}):
        default = {"default": {**entry, **named}}
        assert hyperparameters_of(workdir, stating, algo, default)["gamma"] == 0.8
        # Unless somebody says otherwise
        assert hyperparameters_of(workdir, stating, algo, default, hyperparams={"gamma": 0.9})["gamma"] == 0.9
        assert hyperparameters_of(workdir, stating, algo, {stating: {**entry, "gamma": 0.7}, **default})["gamma"] == 0.7
        # Where none is stated it is that of the entry, or of the algorithm
        assert hyperparameters_of(workdir, ENV, algo, default).get("gamma") == named.get("gamma")
    monkeypatch.setattr(LACExperimentManager, "load_trial", lambda *_: {"gamma": 0.6})
    of_trial = {"storage": "study.log", "study_name": "study", "trial_id": 1}
    assert hyperparameters_of(workdir, stating, algo, default, **of_trial)["gamma"] == 0.6


def test_algorithm_without_a_discount_is_told_none(workdir, stating):
    assert "gamma" not in hyperparameters_of(workdir, stating, "ars", {"default": {"policy": "LinearPolicy"}})


def test_where_hyperparameters_are_from_is_printed(workdir, stating, capsys):
    def said(algo, env_id):
        config = str(find_config(algo, env_id))
        manager_of(env_id, workdir, algo, config=config).read_hyperparameters()
        return next(line for line in capsys.readouterr().out.splitlines() if line.startswith("hyperparameters of"))

    tuned, brought, own = RL_ZOO_CONFIGS / "sac.yml", find_config("sac"), workdir / "zoo_configs" / "lac.yml"
    assert said("sac", "BipedalWalker-v3") == f"hyperparameters of sac on BipedalWalker-v3: the RL Zoo's ({tuned})"
    assert said("sac", ENV) == f"hyperparameters of sac on {ENV}: {brought}"
    assert said("lac", ENV) == f"hyperparameters of lac on {ENV}: {own}"
    of_ppo = RL_ZOO_CONFIGS / "ppo.yml"
    assert said("ppo", "LinearCost-v0").endswith(f"on LinearCost-v0: the RL Zoo's ({of_ppo}), entry 'default'")
    assert said("lac", stating).endswith(f"{own}, entry 'default', with the discount that the environment states, 0.8")


def test_missing_zoo_names_the_extra(monkeypatch):
    monkeypatch.delitem(sys.modules, "sb3_lac.zoo")
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(ImportError, match=r"pip install 'sb3_lac\[zoo\]'"):
        importlib.import_module("sb3_lac.zoo")


class TestEnvironments:
    """Copies of an environment are stepped by one call where it is registered with a vector environment that can."""

    @pytest.fixture
    def model_of(self, workdir, set_up):
        (workdir / "zoo_configs" / "lac.yml").write_text(yaml.dump({"default": {**SETTINGS, "n_envs": 3}}))

        def model_of(env_id):
            manager = manager_of(env_id, workdir)
            return set_up(manager), Path(manager.save_path)

        return model_of

    def test_one_call_steps_all_from_the_same_starts_and_monitors_them(self, model_of, monkeypatch):
        batched, folder = model_of("BatteryRo-v0")
        monkeypatch.setattr("sb3_lac.zoo.steps_as_one_batch", lambda spec: False)
        single, _ = model_of("BatteryRo-v0")
        assert isinstance(batched.env.unwrapped, GymnasiumVecEnv) and isinstance(single.env.unwrapped, DummyVecEnv)
        assert all(is_vecenv_wrapped(model.env, VecNormalize) for model in (batched, single))
        np.testing.assert_array_equal(batched.env.reset(), single.env.reset())
        for _ in range(70):  # longer than an episode
            batched.env.step(np.full((3, 1), 0.1, dtype=np.float32))
        assert len(pd.read_csv(folder / "0.monitor.csv", comment="#")) == 3

    def test_others_are_stepped_one_by_one(self, model_of):
        assert isinstance(model_of(ENV)[0].env.unwrapped, DummyVecEnv)
        assert not steps_as_one_batch(gym.spec("CartPole-v1"))  # it would go without its own choice of new episodes


@pytest.mark.attacks
def test_a_model_goes_to_the_hub_and_comes_back(workdir, monkeypatch):
    class Hub:
        """What is uploaded lies in a folder."""

        def create_repo(self, **kwargs):
            return "a folder"

        def snapshot_download(self, repo_id, local_dir):
            local_dir.mkdir(parents=True)

        def upload_folder(self, repo_id, folder_path, commit_message):
            shutil.copytree(folder_path, workdir / "uploaded" / repo_id)

    def run(command, *options):
        monkeypatch.setattr(sys, "argv", ["-c", "--algo", "lac", "--env", ENV, "-f", "logs", "-orga", "me", *options])
        runpy.run_module(f"rl_zoo3.{command}", None, "__main__")

    main(["train", "--env", ENV, "--eval-freq", "-1", "--seed", "1"])
    trained = LAC.load(workdir / "logs" / "lac" / f"{ENV}_1" / f"{ENV}.zip")
    # rl_zoo3 2.9.2 asks for a function by the name that it had before: without this it pushes no model of any algorithm
    pushing = sys.modules["huggingface_sb3.push_to_hub"]
    if not hasattr(pushing, "generate_metadata"):
        monkeypatch.setattr(pushing, "generate_metadata", pushing._generate_metadata, raising=False)
    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    monkeypatch.setattr("huggingface_sb3.load_from_hub", lambda repo, name: str(workdir / "uploaded" / repo / name))
    run("push_to_hub", "--no-render")
    run("load_from_hub")
    loaded = LAC.load(workdir / "logs" / "lac" / f"{ENV}_2" / f"{ENV}.zip")
    for name, tensor in loaded.policy.state_dict().items():
        th.testing.assert_close(tensor, trained.policy.state_dict()[name], rtol=0, atol=0)
    card = (workdir / "hub" / f"lac-{ENV}" / "README.md").read_text()
    assert "trained model of a **LAC** agent" in card
    main(["enjoy", "--env", ENV, "-f", "logs", "--no-render", "-n", "10"])
