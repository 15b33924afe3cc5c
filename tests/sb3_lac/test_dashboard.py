"""TensorBoard shows the runs of a folder as one comparison: what it would show is read from their files."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import ConstantSchedule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch import nn

from sb3_lac import LAC, CertificateCallback, DashboardCallback, LyapunovCallback
from sb3_lac.dashboard import CHARTS, hyperparameters_of

CALIBRATION = {"Calibration": {"MAPE (%)": ["Multiline", ["calibration/mape_percent$"]]}}
OPTIONS = {"learning_starts": 8, "batch_size": 4, "buffer_size": 100, "seed": 0, "device": "cpu"}


def make_env():
    return Monitor(gym.make("LinearCost-v0", max_episode_steps=8))


def make_model(algorithm, **options):
    return algorithm("MlpPolicy", make_env(), policy_kwargs={"net_arch": [4]}, **OPTIONS, **options)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """What TensorBoard reads of a run of each algorithm."""
    folder = tmp_path_factory.mktemp("runs")
    for algorithm in (TD3, SAC, LAC):
        model = make_model(algorithm, tensorboard_log=str(folder))
        callbacks = [
            EvalCallback(make_env(), n_eval_episodes=1, eval_freq=12, verbose=0),
            DashboardCallback(CALIBRATION, {"env": "LinearCost-v0", "own": [1, 2]}),
            CertificateCallback(make_env(), n_episodes=2, eval_freq=24, verbose=0),
        ]
        if algorithm is LAC:
            callbacks.append(LyapunovCallback(make_env(), n_episodes=2, eval_freq=24, verbose=0))
        model.learn(24, callback=callbacks, log_interval=1)
        model.logger.close()
    return {name: EventAccumulator(str(folder / f"{name}_1")).Reload() for name in ("LAC", "SAC", "TD3")}


def test_every_run_has_its_scalars_and_images(runs):
    common = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/cost_mean", "eval/mean_reward", "eval/mean_ep_length"}
    certificates = {"certificate/drift", "certificate/statements"}
    for name, events in runs.items():
        tags = set(events.Tags()["scalars"])
        assert common <= tags and not [tag for tag in tags if tag.endswith(("_low", "_high"))]
        returns = [event.value for event in events.Scalars("eval/mean_reward")]
        shown = [event.value for event in events.Scalars("eval/cost_log10")]
        np.testing.assert_allclose(shown, np.log10(np.negative(returns)), rtol=1e-5)
        assert set(events.Tags()["images"]) == certificates | ({"lyapunov/report"} if name == "LAC" else set())


def test_the_layout_is_that_of_the_callback(runs):
    for events in runs.values():
        (event,) = events.Tensors("custom_scalars__config__")
        layout = Layout.FromString(event.tensor_proto.string_val[0])
        charts = {category.title: {chart.title: chart for chart in category.chart} for category in layout.category}
        assert {title: list(of_category) for title, of_category in charts.items()} == {
            title: list(of_category) for title, of_category in {**CALIBRATION, **CHARTS}.items()
        }
        assert charts["Calibration"]["MAPE (%)"].multiline.tag == ["calibration/mape_percent$"]


def test_every_chart_of_a_run_of_lac_has_data_and_common_charts_have_that_of_all(runs):
    for charts in CHARTS.values():
        for _, patterns in charts.values():
            for pattern in patterns:
                found = {name: [tag for tag in runs[name].Tags()["scalars"] if re.fullmatch(pattern, tag)] for name in runs}
                # One, so that for instance the chart of lambda has no lambda_loss
                assert len(found["LAC"]) == 1 and all(len(tags) <= 1 for tags in found.values()), pattern
                if pattern.startswith(("eval", "rollout", "certificate")):
                    assert found["SAC"] == found["TD3"] == found["LAC"]


def test_the_table_has_the_hyperparameters_of_all_algorithms(runs):
    rows = {}
    for name, events in runs.items():
        content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
        rows[name] = HParamsPluginData.FromString(content).session_start_info.hparams
    for name, row in rows.items():
        assert {"algorithm", "gamma", "env", "n_envs", "net_arch", "seed", "train_freq"} <= set(row)
        assert not set(row) & {"device", "verbose", "tensorboard_log", "env_", "policy"}
        assert row["algorithm"].string_value == name and row["own"].string_value == "[1, 2]"
    assert rows["LAC"]["alpha3"].number_value == 1.0 and "alpha3" not in rows["TD3"]
    assert rows["TD3"]["target_policy_noise"].number_value == 0.2 and rows["SAC"]["net_arch"].string_value == "[4]"


@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_the_training_is_not_changed(algorithm, tmp_path):
    def weights(**options):
        model = make_model(algorithm, tensorboard_log=str(tmp_path)).learn(24, **options)
        return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])

    alone = weights()
    assert th.equal(weights(callback=DashboardCallback()), alone)


def test_cost_is_that_of_the_environment(tmp_path):
    costs = []

    class Collect(DashboardCallback):
        def _on_step(self):
            costs.append(self.locals["infos"][0]["cost"])
            return super()._on_step()

    make_model(SAC, tensorboard_log=str(tmp_path)).learn(16, callback=Collect(), log_interval=1)
    events = EventAccumulator(str(tmp_path / "SAC_1")).Reload()
    logged = [event.value for event in events.Scalars("rollout/cost_mean")]
    np.testing.assert_allclose(logged, [np.mean(costs[:8]), np.mean(costs[8:])], rtol=1e-6)


@pytest.mark.parametrize(
    ("said", "logged"),
    [
        *[(number, 2.0) for number in (2, np.float32(2), np.array(2.0), np.array([2]), th.tensor([2.0]))],
        *[(other, None) for other in (None, "high", {"energy": 1.0}, [1.0, [2.0]], np.ones(2), np.nan, np.inf, 10**400, 2j)],
    ],
)
def test_what_is_no_number_is_no_cost(said, logged, tmp_path):
    class Saying(gym.Wrapper):
        def step(self, action):
            *step, info = self.env.step(action)
            return *step, {**info, "cost": said}

    model = SAC("MlpPolicy", Saying(make_env()), policy_kwargs={"net_arch": [4]}, tensorboard_log=str(tmp_path), **OPTIONS)
    model.learn(10, callback=DashboardCallback(), log_interval=100)
    assert model.logger.name_to_value.get("rollout/cost_mean") == logged


def test_what_a_class_hands_on_is_in_the_table():
    class Handing(SAC):
        def __init__(self, *args, fall=2.0, **kwargs):
            super().__init__(*args, **kwargs)
            self.fall = fall

    handed, plain = (hyperparameters_of(make_model(algorithm)) for algorithm in (Handing, SAC))
    assert handed == {**plain, "algorithm": "Handing", "fall": 2.0} and plain["seed"] == 0


def test_numbers_of_numpy_are_numbers_in_the_table():
    model = make_model(SAC, gamma=np.float32(0.5), target_update_interval=np.int64(4))
    found = hyperparameters_of(model)
    assert (found["gamma"], found["target_update_interval"]) == (0.5, 4)
    assert DashboardCallback(hparams={"factor": np.float32(0.5), "n": np.array(3), "all": np.ones(2)}).hparams == {
        "factor": 0.5,
        "n": 3,
        "all": "[1. 1.]",
    }


def test_without_tensorboard_there_is_no_dashboard():
    model = make_model(SAC)
    model.set_logger(Logger(folder=None, output_formats=[]))
    with pytest.raises(ValueError, match="no TensorBoard file to write to: create the model with tensorboard_log"):
        model.learn(10, callback=DashboardCallback())


def test_schedules_are_named():
    def halved(progress_remaining):
        return 1e-3 * progress_remaining

    assert hyperparameters_of(make_model(TD3, learning_rate=halved))["learning_rate"] == "halved"
    model = make_model(LAC, learning_rate=ConstantSchedule(1e-3), train_freq=(2, "step"))
    model.policy_kwargs = {"activation_fn": nn.ReLU}
    found = hyperparameters_of(model)
    assert (found["learning_rate"], found["train_freq"]) == (1e-3, "2 step") and "net_arch" not in found
    assert hyperparameters_of(make_model(LAC, reward_bound=5.0))["reward_bound"] == 5.0
