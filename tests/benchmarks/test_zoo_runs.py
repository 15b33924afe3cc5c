"""A policy is trained once, with the hyperparameters it should have, and known by what was run."""

import json
from hashlib import sha256
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from filelock import FileLock
from stable_baselines3.common.envs import SimpleMultiObsEnv

pytest.importorskip("rl_zoo3")

from benchmarks import runs, zoo_runs
from benchmarks.runs import Run, record_file, train_or_load
from benchmarks.study import digest_of, own_versions
from benchmarks.zoo_runs import zoo_run
from sb3_lac import LAC

ENV_ID = "LinearCost-v0"
CONFIG = """
LinearCost-v0:
  policy: 'MlpPolicy'
  n_timesteps: 40
  learning_starts: 20
  batch_size: 8
  buffer_size: 100
  alpha3: 0.7
  policy_kwargs: "dict(net_arch=[8])"
"""


@pytest.fixture(autouse=True)
def trainings(tmp_path, monkeypatch):
    """Tiny networks, and a list of the seeds that were trained with."""
    (tmp_path / "zoo_configs").mkdir()
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    seeds, model = [], Run.model
    monkeypatch.setattr(Run, "model", lambda run, *arguments: seeds.append(run.seed) or model(run, *arguments))
    return seeds


@pytest.fixture
def model_of():
    """A model that has learned nothing yet, whose environments are closed in the end."""
    envs = []

    def model_of(run):
        envs.append(run.environments())
        return run.model(envs[-1])

    yield model_of
    for env in envs:
        env.close()


def train(timesteps, folder, algo="lac", seed=0, **chosen):
    return train_or_load(zoo_run(algo, ENV_ID, seed, timesteps), folder, **chosen)


def parameters(model):
    return np.concatenate([values.detach().numpy().ravel() for values in model.policy.parameters()])


def test_a_policy_is_trained_once(tmp_path, trainings):
    points = []
    first = train(40, tmp_path / "run", judge=lambda model, run: points.append(model.num_timesteps) or run.seed)
    assert isinstance(first, LAC) and first.num_timesteps == 40 and trainings == [0] and points == list(range(4, 41, 4))
    assert len(list((tmp_path / "run").glob("model_*.zip"))) == 1 and not list((tmp_path / "run").glob("checkpoint*"))
    # beside it stands what made it
    run = zoo_run("lac", ENV_ID, 0, 40)
    record = json.loads(record_file(run, tmp_path / "run").read_text())
    assert Run(**record["run"]) == run and record["defaults"]["tau"] == 0.005 and "torch" in record["versions"]
    assert record["training_minutes"] > 0 and record["curve"] == 10 * [0]
    again = train(40, tmp_path / "run")
    assert trainings == [0]
    np.testing.assert_array_equal(parameters(again), parameters(first))
    # another length is another policy
    assert train(25, tmp_path / "run").num_timesteps == 25
    assert trainings == [0, 0]


def test_a_policy_that_would_lose_its_normalization_is_refused():
    with pytest.raises(ValueError, match="policies with `normalize` cannot be scored here"):
        zoo_run("lac", ENV_ID, 0, differing={"normalize": True})


def test_the_seed_decides_everything(tmp_path):
    models = []
    for number, seed in enumerate((3, 3, 4)):
        th.rand(number)
        models.append(train(30, tmp_path / f"run{number}", seed=seed))
    np.testing.assert_array_equal(parameters(models[0]), parameters(models[1]))
    assert (parameters(models[0]) != parameters(models[2])).any()


def test_hyperparameters_are_those_of_zoo_configs_where_none_are_given(model_of):
    model = model_of(zoo_run("lac", ENV_ID, 0, differing={"alpha3": 0.2, "lambda_max": 5.0}))
    assert (model.alpha3, model.lambda_max, model.batch_size, model.policy_kwargs["net_arch"]) == (0.2, 5.0, 8, [8])


def test_a_digest_names_all_that_was_run_but_the_seed(tmp_path):
    def of(**chosen):
        return zoo_run("lac", ENV_ID, 0, **chosen)

    run = of()
    assert (run.timesteps, of(timesteps=40).digest) == (40, run.digest)
    assert of(defaults=True).timesteps == zoo_runs.DEFAULTS_TIMESTEPS
    others = [of(timesteps=41), of(differing={"alpha3": 0.6}), of(differing={"env_kwargs": {"control_max": 2.0}})]
    others += [of(defaults=True), zoo_run("benchmarks.metric_sac:MetricSAC", ENV_ID, 0)]
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG.replace("alpha3: 0.7", "alpha3: 0.8"))
    others.append(of())
    assert len({run.digest, *(other.digest for other in others)}) == 1 + len(others)
    assert len({run.name, *(other.name for other in others)}) == 1 + len(others)
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG)
    seeds = [zoo_run("lac", ENV_ID, seed) for seed in (0, 1)]
    assert seeds[0] == run and seeds[0].digest == seeds[1].digest and seeds[0].name != seeds[1].name


def test_an_algorithm_may_name_whose_settings_it_has(model_of):
    run = zoo_run("benchmarks.metric_sac:MetricSAC", ENV_ID, 0)
    assert run.settings == zoo_run("lac", ENV_ID, 0).settings and model_of(run).alpha3 == 0.7
    # of this package only the file that is named counts
    source = Path(zoo_runs.__file__).with_name("metric_sac.py")
    digest = digest_of({source.name: sha256(source.read_bytes()).hexdigest(), **own_versions()})
    assert run.key["package"] == f"benchmarks.metric_sac {digest}"


@pytest.mark.parametrize("damaged", ["", "[]", "{}", '{"run": '])
def test_a_training_whose_record_is_damaged_is_made_again(damaged, tmp_path, trainings, capsys):
    train(25, tmp_path)
    (record,) = tmp_path.glob("model_*.json")
    record.write_text(damaged)
    train(25, tmp_path)
    assert trainings == [0, 0] and f"{record} is damaged" in capsys.readouterr().err


def test_two_processes_do_not_train_the_same_policy(tmp_path, trainings):
    run = zoo_run("lac", ENV_ID, 0, 25)
    with FileLock(tmp_path / f".{run.name}.lock"), pytest.raises(RuntimeError, match="another process is busy with"):
        train(25, tmp_path)
    assert trainings == []


def test_an_algorithm_and_an_environment_of_ones_own_are_named_by_their_modules(tmp_path, monkeypatch, request, model_of):
    source = """
import gymnasium as gym
from stable_baselines3 import SAC

class Mine(SAC):
    pass

if "Mine-v0" not in gym.registry:
    gym.register("Mine-v0", "sb3_lac.envs.linear:LinearCostEnv", max_episode_steps=9)
"""
    (tmp_path / "own_module_a.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    request.addfinalizer(lambda: gym.registry.pop("Mine-v0"))
    run = zoo_run("own_module_a:Mine", "own_module_a:Mine-v0", 0, 150, defaults=True)
    assert run.algorithm == "Mine defaults" and run.name.startswith("own_module_a_Mine-v0_Mine_defaults_seed0_")
    model = model_of(run)
    assert type(model).__name__ == "Mine" and model.env.get_attr("spec")[0].id == "Mine-v0"
    # its source is part of the run, and so is that of the environment
    assert run.key["package"].count("own_module_a") == 2
    (tmp_path / "zoo_configs" / "mine.yml").write_text(CONFIG.replace(ENV_ID, "Mine-v0").replace("alpha3", "gamma"))
    tuned = zoo_run("own_module_a:Mine", "own_module_a:Mine-v0", 0)
    assert (tuned.algorithm, tuned.timesteps, tuned.settings["gamma"]) == ("Mine", 40, 0.7)


def test_a_module_without_a_file_is_named():
    with pytest.raises(ValueError, match="sys has no file of its own"):
        _ = zoo_run("sac", "sys:LinearCost-v0", 0, 150, defaults=True).key


def test_defaults_are_for_dicts_too(request, model_of):
    gym.register("Named-v0", lambda: SimpleMultiObsEnv(discrete_actions=False))
    request.addfinalizer(lambda: gym.registry.pop("Named-v0"))
    model = model_of(zoo_run("lac", "Named-v0", 0, 150, defaults=True))
    assert set(model.observation_space.spaces) == {"vec", "img"}


def test_all_files_of_a_package_are_part_of_a_run(tmp_path, monkeypatch):
    (package := tmp_path / "own_package_a").mkdir()
    (package / "__init__.py").write_text("from own_package_a.algorithm import Mine")
    (package / "algorithm.py").write_text("from stable_baselines3 import SAC\n\nclass Mine(SAC):\n    pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    run = zoo_run("own_package_a:Mine", "LinearCost-v0", 0, 150, defaults=True)
    before = run.digest
    (package / "algorithm.py").write_text("from stable_baselines3 import SAC\n\nclass Mine(SAC):\n    changed = True\n")
    assert run.digest != before


def test_settings_of_the_rl_zoo_are_understood(model_of):
    differing = {"noise_type": "ornstein-uhlenbeck", "noise_std": 0.2, "train_freq": [2, "step"], "learning_rate": "lin_1e-3"}
    model = model_of(Run(ENV_ID, "TD3", "stable_baselines3:TD3", 0, 300, differing))
    assert model.action_noise._sigma.tolist() == [0.2] and model.train_freq.frequency == 2
    assert model.lr_schedule(0.5) == pytest.approx(5e-4)
    assert runs.control_networks(4) in (Path(zoo_runs.__file__).parents[1] / "zoo_configs" / "lac.yml").read_text()
