"""TensorBoard shows the runs of a folder as one comparison: what it serves is read back over HTTP."""

import json
import re
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import ARS
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import ConstantSchedule
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from sb3_lac import LAC, CertificateCallback, DashboardCallback, LyapunovCallback
from sb3_lac.dashboard import CHARTS, hyperparameters_of

READY_WITHIN_S = 120
RUNS = ["LAC_1", "SAC_1", "TD3_1"]
STEPS = 24
CALIBRATION = {"Calibration": {"MAPE (%)": ["Multiline", ["calibration/mape_percent$"]]}}
OPTIONS = {"learning_starts": 8, "batch_size": 4, "buffer_size": 100, "seed": 0, "device": "cpu"}


def make_env():
    return Monitor(gym.make("LinearCost-v0", max_episode_steps=8))


def make_model(algorithm, **options):
    return algorithm("MlpPolicy", make_env(), policy_kwargs={"net_arch": [4]}, **OPTIONS, **options)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with a run of each algorithm."""
    folder = tmp_path_factory.mktemp("runs")
    for algorithm in (TD3, SAC, LAC):
        model = make_model(algorithm, tensorboard_log=str(folder))
        callbacks = [
            EvalCallback(make_env(), n_eval_episodes=1, eval_freq=12, verbose=0),
            DashboardCallback(CALIBRATION, {"env": "LinearCost-v0", "own": [1, 2]}),
            CertificateCallback(make_env(), n_eval_episodes=2, eval_freq=12, verbose=0),
        ]
        if algorithm is LAC:
            callbacks.append(LyapunovCallback(make_env(), n_eval_episodes=2, eval_freq=12, verbose=0))
        model.learn(STEPS, callback=callbacks, log_interval=1)
        model.logger.close()
    return folder


class TensorBoard:
    """
    A server in a process of its own, on a port that it chooses.

    :param runs: what it shows
    :param log: where it says what it does
    """

    def __init__(self, runs, log):
        self.log = log
        options = ["--logdir", str(runs), "--port", "0", "--host", "127.0.0.1", "--load_fast", "false"]
        with log.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tensorboard.main", *options], stdout=subprocess.DEVNULL, stderr=output
            )
        # not through a proxy
        self.opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))

    def wait_until(self, ready):
        """What ``ready`` returns, as soon as that is true."""
        end = time.monotonic() + READY_WITHIN_S
        while not (found := ready()):
            assert self.process.poll() is None, f"TensorBoard ended: {self.log.read_text()}"
            assert time.monotonic() < end, f"TensorBoard is not ready: {self.log.read_text()}"
            time.sleep(0.1)
        return found

    def start(self):
        """Wait until it has read all runs, each of which ends with the end of an episode."""
        self.url = self.wait_until(lambda: re.search(r"http://127\.0\.0\.1:\d+/", self.log.read_text())).group() + "data"
        self.wait_until(lambda: [self.last(run, "rollout/ep_rew_mean")[1] for run in RUNS] == [STEPS] * 3)
        return self

    def last(self, run, tag):
        """Value and step of the last entry, if any."""
        scalars = self.get("plugin/custom_scalars/scalars", run=run, tag=f"{tag}$")["tag_to_events"]
        return (scalars[tag][-1][2], scalars[tag][-1][1]) if scalars else (None, None)

    def get(self, route, body=None, **query):
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(f"{self.url}/{route}?{urllib.parse.urlencode(query)}", data, headers)
        try:
            with self.opener.open(request, timeout=READY_WITHIN_S) as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{request.full_url}: {error.code}, {error.read().decode()}") from error

    def stop(self):
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def tensorboard(runs, tmp_path_factory):
    server = TensorBoard(runs, tmp_path_factory.mktemp("server") / "log.txt")
    try:
        yield server.start()
    finally:
        server.stop()


def test_every_tab_has_the_runs(tensorboard):
    assert sorted(tensorboard.get("runs")) == RUNS
    active = tensorboard.get("plugins_listing")
    assert all(active[tab]["enabled"] for tab in ("custom_scalars", "hparams", "scalars", "images"))
    tags = {run: set(tags) for run, tags in tensorboard.get("plugin/scalars/tags").items()}
    common = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/cost_mean", "eval/mean_reward", "eval/mean_ep_length"}
    assert all(common <= tags[run] for run in tags)
    assert {"lyapunov/decrease", "lyapunov/decrease_low", "lyapunov/decrease_high", "train/lambda"} <= tags["LAC_1"]
    images = tensorboard.get("plugin/images/tags")
    certificates = {"certificate/drift", "certificate/statements"}
    of_lac = {run for run in RUNS if run.startswith("LAC")}
    expected = {run: certificates | ({"lyapunov/report"} if run in of_lac else set()) for run in RUNS}
    assert {run: set(tags) for run, tags in images.items()} == expected


def test_the_layout_is_that_of_the_callback_and_has_all_runs_in_one_chart(tensorboard):
    layout = {
        category["title"]: {chart["title"]: chart for chart in category["chart"]}
        for category in tensorboard.get("plugin/custom_scalars/layout")["category"]
    }
    # not one for each run
    assert {title: list(charts) for title, charts in layout.items()} == {
        title: list(charts) for title, charts in {**CALIBRATION, **CHARTS}.items()
    }
    assert layout["Calibration"]["MAPE (%)"]["multiline"]["tag"] == ["calibration/mape_percent$"]
    (margin,) = layout["Lyapunov"]["decrease along roll-outs"]["margin"]["series"]
    assert margin == {f: f"lyapunov/decrease{s}" for f, s in (("value", ""), ("lower", "_low"), ("upper", "_high"))}

    def shown(category, title):
        (tag,) = layout[category][title]["multiline"]["tag"]
        answers = {run: tensorboard.get("plugin/custom_scalars/scalars", run=run, tag=tag) for run in RUNS}
        return {run: set(answer["tag_to_events"]) for run, answer in answers.items() if answer["tag_to_events"]}

    for title, tag in (
        ("return of an evaluation", "eval/mean_reward"),
        ("cost per step of the training", "rollout/cost_mean"),
    ):
        assert shown("Returns and costs", title) == {run: {tag} for run in RUNS}
    # and not lambda_loss
    assert shown("Lyapunov", "lambda") == {"LAC_1": {"train/lambda"}}
    assert shown("Certificates of any algorithm", "mean cost settles below") == {
        run: {"certificate/cost_bound"} for run in RUNS
    }
    assert shown("Updates", "entropy coefficient") == {run: {"train/ent_coef"} for run in ("LAC_1", "SAC_1")}


def test_every_chart_of_a_run_of_lac_has_data(runs):
    events = EventAccumulator(str(runs / "LAC_1"))
    events.Reload()
    tags = events.Tags()["scalars"]
    for charts in CHARTS.values():
        for _, patterns in charts.values():
            for pattern in patterns:
                assert len([tag for tag in tags if re.fullmatch(pattern, tag)]) == 1, pattern


def test_the_table_has_the_hyperparameters_of_all_algorithms_beside_the_last_values(tensorboard):
    experiment = tensorboard.get("plugin/hparams/experiment", {"experimentName": ""})
    columns = {info["name"] for info in experiment["hparamInfos"]}
    # of all, of LAC, of SAC and LAC, of TD3
    assert {"algorithm", "gamma", "env", "n_envs", "net_arch", "seed", "train_freq"} <= columns
    assert {"alpha3", "ent_coef", "target_policy_noise"} <= columns
    assert not columns & {"device", "verbose", "tensorboard_log", "env_", "policy"}
    statuses = ["STATUS_UNKNOWN", "STATUS_SUCCESS", "STATUS_FAILURE", "STATUS_RUNNING"]
    wanted = {"experimentName": "", "allowedStatuses": statuses, "startIndex": 0, "sliceSize": 10}
    groups = tensorboard.get("plugin/hparams/session_groups", {**wanted, "colParams": column_parameters(experiment)})
    rows = {group["hparams"]["algorithm"]: group for group in groups["sessionGroups"]}
    assert set(rows) == {"LAC", "SAC", "TD3"}
    assert rows["LAC"]["hparams"]["alpha3"] == 1.0 and "alpha3" not in rows["TD3"]["hparams"]
    assert rows["TD3"]["hparams"]["target_policy_noise"] == 0.2
    assert rows["SAC"]["hparams"]["net_arch"] == "[4]" and rows["SAC"]["hparams"]["own"] == "[1, 2]"
    for algorithm, row in rows.items():
        last, _ = tensorboard.last(f"{algorithm}_1", "eval/mean_reward")
        values = {metric["name"]["tag"]: metric["value"] for metric in row["metricValues"]}
        assert values["eval/mean_reward"] == pytest.approx(last) and values["eval/mean_reward"] < 0


def column_parameters(experiment):
    """All columns, as the page asks for them."""
    return [{"hparam": info["name"]} for info in experiment["hparamInfos"]] + [
        {"metric": info["name"]} for info in experiment["metricInfos"]
    ]


@pytest.mark.parametrize("algorithm", [LAC, SAC])
def test_the_training_is_not_changed(algorithm, tmp_path):
    def weights(**options):
        model = make_model(algorithm, tensorboard_log=str(tmp_path)).learn(24, **options)
        return th.cat([parameter.detach().flatten() for parameter in model.policy.parameters()])

    alone = weights()
    callbacks = [DashboardCallback()]
    if algorithm is LAC:
        callbacks.append(LyapunovCallback(make_env(), n_eval_episodes=2, eval_freq=12, verbose=0))
    assert th.equal(weights(callback=callbacks), alone)


def test_cost_is_that_of_the_environment(tmp_path):
    costs = []

    class Collect(DashboardCallback):
        def _on_step(self):
            costs.append(self.locals["infos"][0]["cost"])
            return super()._on_step()

    make_model(SAC, tensorboard_log=str(tmp_path)).learn(16, callback=Collect(), log_interval=1)
    events = EventAccumulator(str(tmp_path / "SAC_1"))
    events.Reload()
    logged = [event.value for event in events.Scalars("rollout/cost_mean")]
    np.testing.assert_allclose(logged, [np.mean(costs[:8]), np.mean(costs[8:])], rtol=1e-6)


def test_an_environment_without_costs_has_no_entry_for_them(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, tensorboard_log=str(tmp_path), **OPTIONS)
    model.learn(10, callback=DashboardCallback())
    assert "rollout/cost_mean" not in model.logger.name_to_value


def test_algorithms_without_infos_train_too(tmp_path):
    model = ARS("LinearPolicy", make_env(), n_delta=1, tensorboard_log=str(tmp_path), device="cpu").learn(
        16, callback=DashboardCallback()
    )
    model.logger.close()
    assert "custom_scalars__config__" in EventAccumulator(str(tmp_path / "ARS_1")).Reload().Tags()["tensors"]


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
