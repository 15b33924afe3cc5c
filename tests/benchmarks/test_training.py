"""A policy is trained once, with the hyperparameters it should have, and known by what it was made from."""

import gc
import json
import warnings
from hashlib import sha256
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from filelock import FileLock
from stable_baselines3.common.envs import SimpleMultiObsEnv

from benchmarks import training
from benchmarks.study import digest_of
from sb3_lac import LAC
from sb3_lac.compiled import update as compiled

ENV_ID = "LinearCost-v0"
PUBLISHED = Path(__file__).parents[2] / "docs" / "results"
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


@pytest.fixture(autouse=True, scope="module")
def _nothing_left_open():
    """What tests of other modules have left open is not of these."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gc.collect()


@pytest.fixture(autouse=True)
def trainings(tmp_path, monkeypatch):
    """Tiny networks, whose environments are closed in the end, and a list of the seeds that were trained with."""
    (tmp_path / "zoo_configs").mkdir()
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG)
    monkeypatch.chdir(tmp_path)
    seeds, models, set_up = [], [], training.set_up

    def kept(*arguments, **named):
        manager, model = set_up(*arguments, **named)
        models.append(model)
        return manager, model

    class Manager(training.LACExperimentManager):
        def __init__(self, *args, **kwargs):
            seeds.append(kwargs["seed"])
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(training, "LACExperimentManager", Manager)
    monkeypatch.setattr(training, "set_up", kept)
    yield seeds
    for model in models:
        model.env.close()


def train(timesteps, folder, algo="lac", seed=0, compile_update=False, **differing):
    recipe = training.Recipe.of(algo, ENV_ID, seed, timesteps, **differing)
    return training.train_or_load(recipe, folder, compile_update=compile_update)


def parameters(model):
    return np.concatenate([values.detach().numpy().ravel() for values in model.policy.parameters()])


def test_a_policy_is_trained_once(tmp_path, trainings):
    first = train(40, tmp_path / "run")
    assert isinstance(first, LAC) and first.num_timesteps == 40 and trainings == [0]
    assert [path.name for path in (tmp_path / "run").glob("*.csv")] == ["progress.csv"]
    assert len(list((tmp_path / "run").glob("model_*.zip"))) == 1
    # beside it stands what made it
    recipe = training.Recipe.of("lac", ENV_ID, 0, 40)
    record = json.loads(training.record_file(recipe, tmp_path / "run").read_text())
    assert training.Recipe(**record["recipe"]) == recipe and "torch" in record["versions"]
    assert record["training_minutes"] > 0
    again = train(40, tmp_path / "run")
    assert trainings == [0]
    np.testing.assert_array_equal(parameters(again), parameters(first))
    # another length is another policy
    assert train(25, tmp_path / "run").num_timesteps == 25
    assert trainings == [0, 0]


def test_a_policy_that_would_lose_its_normalization_is_refused(tmp_path):
    with pytest.raises(ValueError, match="policies with `normalize` cannot be scored here"):
        train(2000, tmp_path / "models", hyperparameters={"normalize": True})
    assert not list((tmp_path / "models").glob("model_*"))


def test_the_seed_decides_everything(tmp_path):
    models = []
    for number, seed in enumerate((3, 3, 4)):
        th.rand(number)
        models.append(train(30, tmp_path / f"run{number}", seed=seed))
    np.testing.assert_array_equal(parameters(models[0]), parameters(models[1]))
    assert (parameters(models[0]) != parameters(models[2])).any()


def test_hyperparameters_are_those_of_zoo_configs_where_none_are_given(tmp_path):
    recipe = training.Recipe.of("lac", ENV_ID, 0, hyperparameters={"alpha3": 0.2, "lambda_max": 5.0})
    model = training.set_up(recipe, tmp_path)[1]
    assert (model.alpha3, model.lambda_max, model.batch_size, model.policy_kwargs["net_arch"]) == (0.2, 5.0, 8, [8])


def test_a_recipe_names_all_that_a_policy_depends_on(tmp_path, monkeypatch):
    def of(**chosen):
        return training.Recipe.of("lac", ENV_ID, 0, **chosen)

    class OtherDefault(LAC):
        def __init__(self, policy, env, tau=0.006, **others):
            super().__init__(policy, env, tau=tau, **others)

    recipe = of()
    assert (recipe.timesteps, of(timesteps=40).digest) == (40, recipe.digest)
    assert of(defaults=True).timesteps == training.DEFAULTS_TIMESTEPS
    others = [of(timesteps=41), of(hyperparameters={"alpha3": 0.6}), of(defaults=True), of(evaluations=3), of(evaluations=4)]
    with monkeypatch.context() as patch:
        patch.setitem(training.ALGOS, "lac", OtherDefault)
        others.append(of())
    with monkeypatch.context() as patch:
        patch.setattr(training, "own_versions", lambda: {"sb3_lac": "99.0.0"})
        others.append(of())
    with monkeypatch.context() as patch:
        patch.setitem(gym.registry[ENV_ID].kwargs, "control_max", 1.5)
        training._environment.cache_clear()
        others.append(of())
    training._environment.cache_clear()
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG.replace("alpha3: 0.7", "alpha3: 0.8"))
    others.append(of())
    assert len({recipe.digest, *(other.digest for other in others)}) == 1 + len(others)
    assert len({recipe.name, *(other.name for other in others)}) == 1 + len(others)

    # seeds of one recipe share the digest, not the name
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG)
    seeds = [training.Recipe.of("lac", ENV_ID, seed) for seed in (0, 1)]
    assert seeds[0] == recipe and seeds[0].digest == seeds[1].digest and seeds[0].name != seeds[1].name


def test_recipe_holds_the_discount_that_the_environment_states():
    recipe = training.Recipe.of("lac", "BatteryQmax-v0", 0, 200, defaults=True)
    assert recipe.arguments["gamma"] == gym.spec("BatteryQmax-v0").make().metadata["discount"] == 0.8
    assert training.Recipe.of("lac", "Pendulum-v1", 0, 200, defaults=True).arguments["gamma"] == 0.99
    assert training.Recipe.of("sac", "BatteryQmax-v0", 0, 200, defaults=True).arguments["gamma"] == 0.99


def test_training_follows_the_recipe_even_if_the_file_has_changed_since(tmp_path):
    recipe = training.Recipe.of("lac", ENV_ID, 0)
    (tmp_path / "zoo_configs" / "lac.yml").write_text(CONFIG.replace("alpha3: 0.7", "alpha3: 0.8"))
    assert training.set_up(recipe, tmp_path / "run")[1].alpha3 == 0.7


@pytest.mark.attacks
def test_compilation_is_no_part_of_the_recipe(tmp_path, monkeypatch, trainings):
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    model = train(25, tmp_path, compile_update=True)
    assert model.compile_update and not training.set_up(training.Recipe.of("lac", ENV_ID, 0, 25), tmp_path)[1].compile_update
    trainings.clear()
    assert train(25, tmp_path).num_timesteps == 25 and not trainings


def test_an_algorithm_may_name_whose_settings_it_has(tmp_path):
    recipe = training.Recipe.of("benchmarks.metric_sac:MetricSAC", ENV_ID, 0)
    assert recipe.hyperparameters == training.Recipe.of("lac", ENV_ID, 0).hyperparameters
    assert training.set_up(recipe, tmp_path)[1].alpha3 == 0.7
    # of this package only the file that is named counts
    source = Path(training.__file__).with_name("metric_sac.py")
    assert recipe.packages["benchmarks.metric_sac"] == digest_of({source.name: sha256(source.read_bytes()).hexdigest()})


def test_an_interrupted_training_leaves_no_model(tmp_path, monkeypatch, trainings):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(LAC, "train", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(40, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*.zip"))
    assert train(40, tmp_path / "run").num_timesteps == 40 and trainings == [0, 0]


@pytest.mark.parametrize("damaged", ["", "[]", "{}", '{"recipe": '])
def test_a_training_whose_record_is_damaged_is_made_again(damaged, tmp_path, trainings, capsys):
    train(25, tmp_path)
    (record,) = tmp_path.glob("model_*.json")
    record.write_text(damaged)
    train(25, tmp_path)
    assert trainings == [0, 0] and f"{record} is damaged" in capsys.readouterr().err


def test_two_processes_do_not_train_the_same_policy(tmp_path, trainings):
    recipe = training.Recipe.of("lac", ENV_ID, 0, 25)
    with FileLock(tmp_path / f".{recipe.name}.lock"), pytest.raises(RuntimeError, match="another process is busy with"):
        train(25, tmp_path)
    assert trainings == []


@pytest.mark.parametrize("study", ["compare", "compare_defaults"])
def test_published_runs_keep_their_names(study):
    recipes = json.loads((PUBLISHED / study / "compare.json").read_text())["configuration"]["recipes"]
    for digest, recorded in recipes.items():
        seeds = [run["seed"] for run in recorded.pop("runs")]
        assert {training.Recipe(seed=seed, **recorded).digest for seed in seeds} == {digest}


def test_an_algorithm_and_an_environment_of_ones_own_are_named_by_their_modules(tmp_path, monkeypatch, request):
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
    recipe = training.Recipe.of("own_module_a:Mine", "own_module_a:Mine-v0", 0, 150, defaults=True)
    assert recipe.label == "Mine defaults" and recipe.environment["max_episode_steps"] == 9
    assert recipe.name.startswith("mine_defaults_seed0_")
    _, model = training.set_up(recipe, tmp_path / "run")
    assert type(model).__name__ == "Mine" and model.env.get_attr("spec")[0].id == "Mine-v0"
    # its source is part of the recipe
    assert set(recipe.packages) == {"sb3_lac", "battery_env", "own_module_a"}
    (tmp_path / "zoo_configs" / "mine.yml").write_text(CONFIG.replace(ENV_ID, "Mine-v0").replace("alpha3", "gamma"))
    tuned = training.Recipe.of("own_module_a:Mine", "own_module_a:Mine-v0", 0)
    assert (tuned.label, tuned.timesteps, tuned.hyperparameters["gamma"]) == ("Mine", 40, 0.7)


def test_a_module_without_a_file_is_named():
    with pytest.raises(ValueError, match="sys has no file of its own"):
        training.Recipe.of("sac", "sys:LinearCost-v0", 0, 150, defaults=True)


def test_defaults_are_for_dicts_too(tmp_path, request):
    gym.register("Named-v0", lambda: SimpleMultiObsEnv(discrete_actions=False))
    request.addfinalizer(lambda: gym.registry.pop("Named-v0"))
    _, model = training.set_up(training.Recipe.of("lac", "Named-v0", 0, 150, defaults=True), tmp_path / "run")
    assert set(model.observation_space.spaces) == {"vec", "img"}


def test_all_files_of_a_package_are_part_of_the_recipe(tmp_path, monkeypatch):
    (package := tmp_path / "own_package_a").mkdir()
    (package / "__init__.py").write_text("from own_package_a.algorithm import Mine")
    (package / "algorithm.py").write_text("from stable_baselines3 import SAC\n\nclass Mine(SAC):\n    pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = training.Recipe.of("own_package_a:Mine", "LinearCost-v0", 0, 150, defaults=True)
    (package / "algorithm.py").write_text("from stable_baselines3 import SAC\n\nclass Mine(SAC):\n    changed = True\n")
    assert training.Recipe.of("own_package_a:Mine", "LinearCost-v0", 0, 150, defaults=True).digest != before.digest
