"""
How many updates a second LAC makes on the CPU, beside Stable-Baselines3's SAC and TD3 at equal networks.

.. code-block:: bash

  python -m benchmarks.throughput

The algorithms take turns in short blocks, so that whatever else the machine does hits all of them; the ratio is taken within
each turn, and its median and quartiles are reported. A profile says where the time of an update goes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from tabulate import tabulate
from torch import nn
from tqdm import trange

from benchmarks.reporting import write_csv, write_text
from sb3_lac import LAC

_ALGORITHMS: dict[str, type[LAC] | type[SAC] | type[TD3]] = {"LAC": LAC, "SAC": SAC, "TD3": TD3}
_TRANSITIONS = 5_000
_WARM_UP_UPDATES = 10

# which operators of torch belong to what, by the beginnings of their names; the first that fits counts
_PARTS = {
    "matrix products": ("aten::mm", "aten::addmm"),
    "activations": ("aten::leaky_relu",),
    "optimizers and target networks": ("Optimizer", "aten::_fused_adam", "aten::_foreach", "aten::lerp"),
    "other operators": ("aten::",),
    "autograd": ("autograd::", "torch::autograd", "AddmmBackward", "LeakyReluBackward"),
}


def filled_model(algo: str, env_id: str, net_arch: list[int], batch_size: int) -> OffPolicyAlgorithm:
    """
    A model with transitions in its replay buffer, ready for updates.

    :param algo: ``LAC``, ``SAC`` or ``TD3``
    :param env_id: id of the environment
    :param net_arch: widths of the hidden layers, of all networks
    :param batch_size: batch size
    :return: the model
    """
    model = _ALGORITHMS[algo](
        "MlpPolicy",
        env_id,
        learning_starts=_TRANSITIONS,
        buffer_size=_TRANSITIONS,
        batch_size=batch_size,
        policy_kwargs={"net_arch": net_arch, "activation_fn": nn.LeakyReLU},
        device="cpu",
        seed=0,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.learn(_TRANSITIONS)
    model.train(gradient_steps=_WARM_UP_UPDATES, batch_size=batch_size)
    return model


def measure(models: dict[str, OffPolicyAlgorithm], rounds: int, updates: int, batch_size: int) -> pd.DataFrame:
    """
    Updates a second of each model, in turns.

    :param models: by name
    :param rounds: how often each model has its turn
    :param updates: updates of a turn
    :param batch_size: batch size
    :return: one row per round, one column per model
    """
    speeds = []
    for number in trange(rounds, desc="rounds", disable=None):
        speed = {}
        # each order as often as its reverse: nobody always comes first
        for name in list(models)[:: 1 if number % 2 == 0 else -1]:
            start = time.perf_counter()
            models[name].train(gradient_steps=updates, batch_size=batch_size)
            speed[name] = updates / (time.perf_counter() - start)
        speeds.append(speed)
    return pd.DataFrame(speeds)[list(models)]


def profile(model: OffPolicyAlgorithm, updates: int, batch_size: int) -> dict[str, float]:
    """
    Where the time of an update goes.

    :param model: any model
    :param updates: updates to profile
    :param batch_size: batch size
    :return: share of the time by part; what no operator accounts for is Python
    """
    start = time.perf_counter()
    with th.profiler.profile(activities=[th.profiler.ProfilerActivity.CPU]) as profiler:
        model.train(gradient_steps=updates, batch_size=batch_size)
        wall_us = 1e6 * (time.perf_counter() - start)
    shares = dict.fromkeys(_PARTS, 0.0)
    for event in profiler.key_averages():
        part = next((part for part, names in _PARTS.items() if event.key.startswith(names)), "autograd")
        shares[part] += event.self_cpu_time_total / wall_us
    return {**shares, "Python": 1.0 - sum(shares.values())}


def report(speeds: pd.DataFrame, parts: pd.DataFrame) -> str:
    """
    What was measured, as Markdown.

    :param speeds: see ``measure()``
    :param parts: shares by part, one row per algorithm
    :return: two tables
    """

    def spread(values: pd.Series, digits: int) -> str:
        low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
        return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"

    lac = speeds["LAC"]
    rows = [[name, spread(values, 1), spread(lac / values, 2)] for name, values in speeds.items()]
    header = ["algorithm", "updates a second, median (quartiles)", "LAC is faster by a factor of"]
    shares = [
        [name, *(f"{100 * share:.0f} %" for share in row)] for name, row in zip(parts.index, parts.to_numpy(), strict=True)
    ]
    return (
        tabulate(rows, headers=header, tablefmt="github")
        + "\n\n"
        + tabulate(shares, headers=["share of the time", *parts.columns], tablefmt="github")
        + "\n"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command line.

    :param arguments: of the command line by default
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40, help="turns of each algorithm")
    parser.add_argument("--updates", type=int, default=25, help="updates of a turn")
    parser.add_argument("--env", default="BatteryQmax-v0", help="id of the environment, for the sizes of the input layers")
    parser.add_argument("--net-arch", type=int, nargs="+", default=[256, 256, 256], help="widths of the hidden layers")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--out", type=Path, default=Path("results/throughput"))
    chosen = parser.parse_args(arguments)
    if min(chosen.rounds, chosen.updates, chosen.batch_size, chosen.threads, *chosen.net_arch) < 1:
        parser.error("--rounds, --updates, --net-arch, --batch-size and --threads must be at least 1")

    th.set_num_threads(chosen.threads)
    models = {name: filled_model(name, chosen.env, chosen.net_arch, chosen.batch_size) for name in _ALGORITHMS}
    speeds = measure(models, chosen.rounds, chosen.updates, chosen.batch_size)
    parts = pd.DataFrame({name: profile(model, chosen.updates, chosen.batch_size) for name, model in models.items()}).T
    configuration = {name: value for name, value in vars(chosen).items() if name != "out"}
    write_csv(chosen.out / "updates.csv", speeds, configuration)
    write_csv(chosen.out / "updates_profile.csv", parts.rename_axis("algorithm").reset_index(), configuration)
    text = report(speeds, parts)
    write_text(chosen.out / "updates.md", text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
