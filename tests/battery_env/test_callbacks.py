"""Calibrators are evaluated while they learn, by any algorithm of Stable-Baselines3."""

import importlib
import re
import sys

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import (
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from battery_env import ClosedForm, PolicyEstimator, TrajectoryDataset, evaluate
from battery_env.callbacks import CALIBRATION_CHARTS, CalibrationCallback
from battery_env.loads import constant
from sb3_lac import GymnasiumVecEnv


def make_model(env="Pendulum-v1"):
    model = TD3("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, buffer_size=500, device="cpu")
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def callback_of(*args, **kwargs):
    """A callback for the metric of the evaluations below."""
    return CalibrationCallback(*args, **{"metrics": ("mape_percent",), **kwargs})


class Evaluation:
    """An evaluation with known results: one mean error per call after the one before the training, plus and minus one."""

    def __init__(self, *means):
        self.means = [0.0, *means]
        self.models = []

    def __call__(self, model):
        self.models.append(model)
        mean = self.means.pop(0)
        return pd.DataFrame({"mape_percent": [mean - 1, mean + 1], "bias": [0.5, 1.5], "label": ["a", "b"]})


def test_mean_and_worst_are_logged_at_their_timesteps(tmp_path):
    model = make_model()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    evaluation = Evaluation(5.0, 3.0)
    callback = callback_of(evaluation, eval_freq=10, metrics={"mape_percent": "mape", "bias": "bias"}, verbose=0)
    model.learn(25, callback=callback, log_interval=None)
    assert evaluation.models == [model] * 3
    model.logger.close()
    logged = pd.read_csv(tmp_path / "progress.csv")
    assert logged["time/total_timesteps"].tolist() == [10, 20]
    assert logged.iloc[1].filter(like="calibration").to_dict() == {
        "calibration/mape": 3.0,
        "calibration/mape_worst": 4.0,
        "calibration/bias": 1.0,
        "calibration/bias_worst": 1.5,
    }
    assert [entry["timesteps"] for entry in callback.history] == [10, 20]
    assert callback.best_objective == 3.0


def test_frequency_counts_calls_and_not_timesteps():
    callback = callback_of(Evaluation(1.0, 1.0), eval_freq=5, verbose=0)
    make_model(make_vec_env("Pendulum-v1", n_envs=3)).learn(30, callback=callback)
    assert [entry["timesteps"] for entry in callback.history] == [15, 30]
    never = callback_of(Evaluation(), eval_freq=-1)
    make_model().learn(10, callback=never)
    assert never.history == []


def test_history_and_best_model_are_saved_and_an_interrupted_run_goes_on(tmp_path):
    log_path, best_path = tmp_path / "run" / "calibration.csv", tmp_path / "best"

    def learn(model, n_steps, *means):
        callback = callback_of(
            Evaluation(*means), eval_freq=10, log_path=log_path, best_model_save_path=str(best_path), verbose=0
        )
        model.learn(n_steps, callback=callback, reset_num_timesteps=False)
        return callback

    model = make_model()
    learn(model, 30, 3.0, 2.0, 5.0)
    assert pd.read_csv(log_path)["timesteps"].tolist() == [10, 20, 30]
    assert pd.read_csv(log_path)["mape_percent"].tolist() == [3.0, 2.0, 5.0]
    assert TD3.load(best_path / "best_model").num_timesteps == 20

    # From a checkpoint of 20 steps: the evaluation at 30 is replaced, and 2.0 is still the best
    model.num_timesteps = 20
    callback = learn(model, 20, 4.0, 3.0)
    frame = pd.read_csv(log_path)
    assert frame["timesteps"].tolist() == [10, 20, 30, 40]
    assert frame["mape_percent"].tolist() == [3.0, 2.0, 4.0, 3.0]
    assert callback.best_objective == 2.0
    assert TD3.load(best_path / "best_model").num_timesteps == 20

    learn(model, 10, 1.0)
    assert TD3.load(best_path / "best_model").num_timesteps == 50
    # Nothing is left behind
    assert sorted(path.name for path in tmp_path.rglob("*.*")) == ["best_model.zip", "calibration.csv"]


def test_another_training_is_not_mixed_with_a_log(tmp_path):
    log_path = tmp_path / "calibration.csv"
    log_path.touch()
    options = {"eval_freq": 5, "log_path": log_path, "best_model_save_path": tmp_path / "best", "verbose": 0}
    make_model().learn(5, callback=callback_of(Evaluation(3.0), **options))
    content = log_path.read_bytes()
    with pytest.raises(ValueError, match=r"holds the evaluations of another training, and this one starts anew"):
        make_model().learn(5, callback=callback_of(Evaluation(4.0), **options))
    assert log_path.read_bytes() == content


def test_missing_result_of_a_trajectory_is_not_hidden():
    def evaluate(model):
        return pd.DataFrame({"mape_percent": [1.0, np.nan]})

    callback = callback_of(evaluate, eval_freq=5, verbose=0)
    make_model().learn(5, callback=callback)
    assert np.isnan(callback.history[0]["mape_percent"]) and np.isnan(callback.history[0]["mape_percent_worst"])
    assert callback.best_objective == np.inf


def test_callbacks_of_stable_baselines3_stop_the_training(capsys):
    for stop, steps in ((StopTrainingOnNoModelImprovement(1), 20), (StopTrainingOnRewardThreshold(-3.5), 10)):
        callback = callback_of(Evaluation(4.0, 3.0, 3.0, 5.0, 2.0), eval_freq=5, callback_after_eval=stop)
        assert make_model().learn(100, callback=callback).num_timesteps == steps
        assert "new_obs" in stop.locals and capsys.readouterr().out.count("New best mape_percent!") == 2
    assert callback.best_mean_reward == -callback.best_objective == -3.0


def test_wrong_columns_are_named_before_the_training(tmp_path):
    with pytest.raises(ValueError, match="at least one column"):
        callback_of(Evaluation(), metrics="mape_percent")
    model = make_model()
    callback = callback_of(Evaluation(), metrics=("rmse",), best_model_save_path=tmp_path / "best")
    with pytest.raises(ValueError, match=r"no column \['rmse'\], its columns are \['mape_percent', 'bias', 'label'\]"):
        model.learn(1, callback=callback)
    assert model.num_timesteps == 0 and not (tmp_path / "best").exists()
    # Pendulum does not say what it finds
    with pytest.raises(ValueError, match="metrics must be given"):
        model.learn(1, callback=CalibrationCallback(Evaluation()))


@pytest.mark.parametrize(
    ("env_id", "parameters", "batched"), [("BatteryRo-v0", ("r_o",), True), ("BatteryJoint-v0", ("q_mobile", "r_o"), False)]
)
def test_default_metrics_are_those_of_the_parameters_that_the_environment_finds(env_id, parameters, batched):
    data = TrajectoryDataset.generate(parameters, 2, [constant(16.0)], seed=0)
    if batched:
        env = GymnasiumVecEnv(gym.make_vec(env_id, 2, dataset=data, autoreset_mode="SameStep"))
    else:
        env = make_vec_env(env_id, env_kwargs={"dataset": data})
    callback = CalibrationCallback(lambda model: evaluate(PolicyEstimator(model, env_id), data), eval_freq=1, verbose=0)
    make_model(env).learn(1, callback=callback)
    names = [f"{parameter}_mape_percent{which}" for parameter in parameters for which in ("", "_worst")]
    assert list(callback.history[0]) == ["timesteps", *names]
    assert callback.objective == names[0]


def test_without_stable_baselines3_the_extra_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "battery_env.callbacks")
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.base_class", None)
    with pytest.raises(ImportError, match=r"callbacks needs Stable-Baselines3.* pip install './battery_env\[sb3\]'"):
        importlib.import_module("battery_env.callbacks")


def test_tensorboard_gets_a_figure_of_each_parameter_with_a_metric(tmp_path):
    scores = evaluate(ClosedForm(), TrajectoryDataset.generate("q_mobile", 3, [constant(8.0)], seed=0))
    for evaluation, metrics, parameters in (
        (lambda model: scores, ("q_mobile_mape_percent", "r_o_mape_percent"), {"q_mobile", "r_o"}),
        (lambda model: scores, ("r_o_worst",), {"r_o"}),
        (Evaluation(1.0), ("mape_percent",), set()),  # an evaluation of its own has no figure
    ):
        model, folder = make_model(), str(tmp_path / metrics[0])
        model.set_logger(configure(folder, ["tensorboard", "csv", "json"]))
        model.learn(5, callback=CalibrationCallback(evaluation, eval_freq=5, metrics=metrics, verbose=0))
        model.logger.close()
        events = EventAccumulator(folder).Reload()
        assert set(events.Tags()["images"]) == {f"calibration/{parameter}_inferred" for parameter in parameters}
        assert f"calibration/{metrics[0]}" in events.Tags()["scalars"]
        assert all([image.step for image in events.Images(tag)] == [5] for tag in events.Tags()["images"])


def test_the_charts_find_the_default_metrics_and_their_worst_value_apart():
    charts = CALIBRATION_CHARTS["Calibration"]
    (mean,), (worst,) = (tags for _, tags in charts.values())
    for metric in ("mape_percent", "q_mobile_mape_percent", "r_o_mape_percent"):
        assert re.match(mean, f"calibration/{metric}") and not re.match(worst, f"calibration/{metric}")
        assert re.match(worst, f"calibration/{metric}_worst") and not re.match(mean, f"calibration/{metric}_worst")
