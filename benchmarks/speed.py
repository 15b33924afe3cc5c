"""
Updates a second of LAC, compiled and not, beside SAC of Stable-Baselines3 and of SBX (JAX), and what a GPU is worth; how long
an update of a filter and of a policy takes, beside NASA's progpy.

.. code-block:: bash

  python -m benchmarks.speed
  python -m benchmarks.speed --only updates
  python -m benchmarks.speed --only gpu --rounds 10

Contestants take turns in short blocks, so that whatever else the machine does hits all of them; ratios are taken within each
round, and their median and quartiles are reported. All run on one core: its time, other processes not counted. On a GPU it is
the time of the clock.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tqdm import trange

from battery_env import PolicyEstimator
from battery_env.electrochemistry import NEW_CELL, simulate
from battery_env.estimators.estimator import OnlineEstimator
from battery_env.records import Stream
from benchmarks.kalman_filter import PlainKalmanFilter
from benchmarks.study import Study, command_line, markdown, positive
from sb3_lac import LAC, GymnasiumVecEnv, PublishedLAC

_ENV = "BatteryQmax-v0"
_POLICY_ENV = "BatteryVoltageJoint-v0"
_TRANSITIONS = 1024
# hidden layers, updates in a call of train(), calls in a turn
_UPDATES = (([64, 64], 1, 50), ([64, 64], 50, 1), ([256, 256], 1, 10))
# hidden layers, batch size, updates in a call on the GPU and on a core, where large networks take seconds for each
_ON_GPU = (([64, 64], 256, 50, 50), ([256, 256, 256], 256, 50, 10), ([1024, 1024, 1024], 4096, 10, 1))
_GPU = "cuda" if th.cuda.is_available() else ""
# samples, 1 s apart, of a turn of those that take microseconds and milliseconds each
_SAMPLES, _PROGPY_SAMPLES, _PARTICLES_SAMPLES = 600, 20, 4


def race(contestants: dict[str, Callable[[], int]], rounds: int, clock: Callable[[], float]) -> pd.DataFrame:
    """Measure the work of each contestant a second, in turns."""
    speeds = []
    for number in trange(rounds, desc="rounds", disable=None):
        speed = {}
        # each order as often as its reverse: nobody always comes first
        for name in list(contestants)[:: 1 if number % 2 == 0 else -1]:
            start = clock()
            n_done = contestants[name]()
            speed[name] = n_done / (clock() - start)
        speeds.append(speed)
    return pd.DataFrame(speeds)[list(contestants)]


def updates_of(
    algorithm: Callable[..., OffPolicyAlgorithm],
    net_arch: list[int],
    batch_size: int,
    per_call: int,
    calls: int,
    **kwargs: Any,
) -> Callable[[], int]:
    """Turns of calls of ``train()``, of a model that has made its first updates."""
    model = algorithm(
        "MlpPolicy",
        GymnasiumVecEnv(gym.make_vec(_ENV, num_envs=64, autoreset_mode="SameStep")),
        learning_starts=_TRANSITIONS,
        buffer_size=100 * _TRANSITIONS,
        batch_size=batch_size,
        policy_kwargs={"net_arch": net_arch},
        seed=0,
        **kwargs,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.learn(_TRANSITIONS)

    def turn() -> int:
        for _ in range(calls):
            model.train(gradient_steps=per_call, batch_size=batch_size)
        return calls * per_call

    # what is compiled is compiled, and has been replayed
    for _ in range(3):
        turn()
    return turn


def measure_updates(rounds: int) -> tuple[pd.DataFrame, str]:
    """Updates a second on one core: small and large networks, one update in a call of ``train()`` and many."""
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    from sbx import SAC as SBX  # heavy, and needed here only

    th.set_num_threads(1)
    tables, rows = [], []
    for net_arch, per_call, calls in _UPDATES:
        contestant = partial(updates_of, net_arch=net_arch, batch_size=256, per_call=per_call, calls=calls)
        contestants = {
            "SAC": contestant(SAC, device="cpu"),
            "LAC": contestant(LAC, device="cpu"),
            "PublishedLAC": contestant(PublishedLAC, device="cpu"),
            "compiled LAC": contestant(LAC, device="cpu", compile_update=True),
            "SBX's SAC": contestant(SBX),
        }
        speeds = race(contestants, rounds, time.process_time)
        row: dict[str, Any] = {"networks": "-".join(map(str, net_arch)), "updates in a call": per_call}
        tables.append(speeds.assign(**row))
        rows.append(
            {
                **row,
                **{str(name): spread(values, 0) for name, values in speeds.items()},
                "LAC / SAC": spread(speeds["LAC"] / speeds["SAC"], 2),
                "compiled LAC / SBX's SAC": spread(speeds["compiled LAC"] / speeds["SBX's SAC"], 2),
            }
        )
    return pd.concat(tables), markdown(rows)


def measure_gpu(rounds: int) -> tuple[pd.DataFrame, str]:
    """Updates a second on a GPU, compiled and not, beside those of SAC there and of compiled LAC on one core."""
    th.set_num_threads(1)
    tables, rows = [], []
    for net_arch, batch_size, per_call, on_core in _ON_GPU:
        contestant = partial(updates_of, net_arch=net_arch, batch_size=batch_size, calls=1)
        contestants = {
            "SAC": contestant(SAC, per_call=per_call, device=_GPU),
            "LAC": contestant(LAC, per_call=per_call, device=_GPU),
            "compiled LAC": contestant(LAC, per_call=per_call, device=_GPU, compile_update=True),
            "compiled LAC, one core": contestant(LAC, per_call=on_core, device="cpu", compile_update=True),
        }
        speeds = race(contestants, rounds, time.perf_counter)
        row: dict[str, Any] = {"networks": "-".join(map(str, net_arch)), "batch": batch_size, "updates in a call": per_call}
        tables.append(speeds.assign(**row))
        rows.append(
            {
                **row,
                **{str(name): spread(values, 0 if values.median() > 10.0 else 2) for name, values in speeds.items()},
                "LAC / SAC": spread(speeds["LAC"] / speeds["SAC"], 2),
                "compiled / not": spread(speeds["compiled LAC"] / speeds["LAC"], 2),
                "compiled, GPU / one core": spread(speeds["compiled LAC"] / speeds["compiled LAC, one core"], 1),
            }
        )
    return pd.concat(tables).assign(GPU=th.cuda.get_device_name()), markdown(rows)


def filter_contestants() -> dict[str, Callable[[], int]]:
    """Calibrators that follow a stream of one sample a second, here and in progpy, which knows ``r_o``."""
    from benchmarks.progpy_filters import ProgpyFilter  # heavy, and needed here only

    discharge = simulate(2.0, 6000.0, 0.15, load_unit="current", thermal=True)
    record = replace(
        discharge, voltage_V=discharge.voltage_V + np.random.default_rng(0).normal(0.0, 0.005, len(discharge.time_s))
    )
    samples = list(Stream.of(record.part(0, _SAMPLES), 1.0).samples())
    # untrained networks take as long
    model = LAC("MlpPolicy", _POLICY_ENV, buffer_size=1, policy_kwargs={"net_arch": [256, 256, 256]}, device="cpu", seed=0)

    def stream(estimator: OnlineEstimator) -> int:
        estimator.reset()
        for sample in samples:
            estimator.update(*sample)
        return len(samples)

    def peer(kind: Any, count: int) -> int:
        ProgpyFilter("q_mobile", kind, 0.25 * NEW_CELL.q_mobile, 0.005).trace([record.part(0, count + 1)])
        return count

    return {
        "plain extended Kalman filter": partial(stream, PlainKalmanFilter(thermal=True)),
        "PolicyEstimator": partial(stream, PolicyEstimator(model, _POLICY_ENV)),
        "PolicyEstimator.pretrained()": partial(stream, PolicyEstimator.pretrained()),
        "progpy, unscented Kalman filter": partial(peer, "ukf", _PROGPY_SAMPLES),
        "progpy, 100 particles": partial(peer, "particles", _PARTICLES_SAMPLES),
    }


def measure_filters(rounds: int) -> tuple[pd.DataFrame, str]:
    """Measure how long an update of a calibrator takes."""
    speeds = race(filter_contestants(), rounds, time.process_time)
    return speeds, report_filters(speeds)


def report_filters(speeds: pd.DataFrame) -> str:
    """Write the measured times of calibrators as Markdown."""
    rows = []
    for name, values in speeds.items():
        ratio = speeds["progpy, unscented Kalman filter"].rdiv(values)
        rows.append(
            {
                "": name,
                "microseconds of one core for an update, median (quartiles)": spread(1e6 / values, 1),
                "faster than progpy's unscented Kalman filter by a factor of": spread(
                    ratio, 0 if ratio.median() > 10.0 else 2
                ),
            }
        )
    return markdown(rows)


def spread(values: pd.Series, digits: int) -> str:
    """Median and quartiles of many rounds, as readers see them."""
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


#: What can be measured.
SECTIONS = {"updates": measure_updates, "filters": measure_filters, "gpu": measure_gpu}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("speed", __doc__, jobs=None)
    sections = [section for section in SECTIONS if section != "gpu" or _GPU]
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=sections, help="what to measure")
    parser.add_argument("--rounds", type=positive, default=20, help="turns of each contestant")
    study = Study(parser, arguments)
    chosen = study.chosen
    if "gpu" in chosen.only and not _GPU:
        parser.error("gpu needs an NVIDIA GPU that torch can use: torch.cuda.is_available() is False")
    for section in chosen.only:
        speeds, text = SECTIONS[section](chosen.rounds)
        study.write({section: speeds}, {}, text, section)


if __name__ == "__main__":
    main()
