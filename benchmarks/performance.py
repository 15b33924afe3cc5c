"""
Where the time of LAC goes: updates beside those of Stable-Baselines3's SAC, beside what their arithmetic takes, and compiled
beside not; ``learn()`` with many cells at once, growth with cells, batches and widths; and what a GPU is worth.

.. code-block:: bash

  python -m benchmarks.performance
  python -m benchmarks.performance --only updates learn
  python -m benchmarks.performance --only gpu --updates 20

Contestants take turns, as in ``benchmarks.throughput``, and ratios are taken within each round. What runs on one thread is
measured by the time of the processor, which other processes do not count in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import pandas as pd
import torch as th
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from battery_env.plotting import COLOUR_OF, new_figure
from benchmarks.study import Study, command_line, markdown, positive
from benchmarks.throughput import race, spread
from sb3_lac import LAC, GymnasiumVecEnv, PublishedLAC
from sb3_lac.costs import CostAlgorithm

SECTIONS = ("updates", "compiled", "learn", "growth", "gpu")

_ENV_ID = "BatteryQmax-v0"
_TRANSITIONS = 1_024
_WARM_UP_UPDATES = 10
_LARGE = [256, 256, 256]
_SMALL = [64, 64]
_GPU = "cuda" if th.cuda.is_available() else ""
# networks and batch sizes of the comparison of a GPU with one core, and for which part of its updates the core has time
_ON_GPU = (([64, 64], 256, 1), ([256, 256, 256], 256, 4), ([1024, 1024, 1024], 4096, 200))
_CELLS = (1, 4, 16, 64, 256)
_BATCH_SIZES = (64, 256, 1024)
_WIDTHS = (32, 64, 128, 256, 512)
# bytes that Adam and the target networks move, for each parameter in fp32: weight, gradient and two moments are read, all but
# the gradient are written; the critic's target reads the weight again, and is read and written itself
_ADAM_BYTES, _TARGET_BYTES = 7 * 4, 3 * 4
_COPIED_NUMBERS = 2**24


def many_cells(cells: int) -> VecEnv:
    """The environment as one that computes all cells at once."""
    return GymnasiumVecEnv(gym.make_vec(_ENV_ID, num_envs=cells, autoreset_mode="SameStep"))


def ready_model(
    algorithm: type[CostAlgorithm] | type[SAC],
    net_arch: list[int],
    env: VecEnv,
    batch_size: int = 256,
    policy_kwargs: dict[str, Any] | None = None,
    device: str = "cpu",
    **kwargs: Any,
) -> CostAlgorithm | SAC:
    """A model that has transitions in its replay buffer and has made its first updates."""
    model = algorithm(
        "MlpPolicy",
        env,
        learning_starts=_TRANSITIONS,
        buffer_size=100 * _TRANSITIONS,
        batch_size=batch_size,
        policy_kwargs={"net_arch": net_arch, "activation_fn": nn.LeakyReLU, **(policy_kwargs or {})},
        device=device,
        seed=0,
        **kwargs,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.learn(_TRANSITIONS)
    model.train(gradient_steps=_WARM_UP_UPDATES, batch_size=batch_size)
    return model


def update_flops(model: OffPolicyAlgorithm) -> int:
    """Floating-point operations of the matrix products of one update, as PyTorch counts them."""
    counter = FlopCounterMode(display=False)
    with counter:
        model.train(gradient_steps=1, batch_size=model.batch_size)
    return counter.get_total_flops()


def moved_bytes(model: LAC) -> int:
    """The fewest bytes that optimizers and target network move in one update."""
    actor, critic = (sum(weight.numel() for weight in net.parameters()) for net in (model.actor, model.critic))
    return (actor + critic) * _ADAM_BYTES + critic * _TARGET_BYTES


def updates_of(model: OffPolicyAlgorithm, updates: int, threads: int = 1) -> int:
    """A turn of updates."""
    th.set_num_threads(threads)
    model.train(gradient_steps=updates, batch_size=model.batch_size)
    return updates


def steps_of(model: OffPolicyAlgorithm, steps: int) -> int:
    """A turn of ``learn()``."""
    model.learn(steps * model.n_envs, reset_num_timesteps=False)
    return steps * model.n_envs


def matrix_products(width: int, threads: int) -> int:
    """A turn of matrix products as they are in a hidden layer, on a batch as large as the layer is wide."""
    th.set_num_threads(threads)
    # as long a turn for all widths
    number = max(1, 2**28 // width**3)
    left, right, product = th.ones(width, width), th.ones(width, width), th.empty(width, width)
    for _ in range(number):
        th.mm(left, right.t(), out=product)
    return number * 2 * width**3


def copies(source: th.Tensor, target: th.Tensor, threads: int) -> int:
    """A turn of copies of memory that no cache holds."""
    th.set_num_threads(threads)
    target.copy_(source)
    return 2 * source.nbytes


def clock_of(threads: int) -> Callable[[], float]:
    """The clock for contestants on some threads."""
    return time.process_time if threads == 1 else time.perf_counter


def measure_updates(rounds: int, updates: int, threads: Sequence[int]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    Updates a second of LAC and SAC with large and small networks, and how long their arithmetic takes at least; beside them
    LAC with one critic, and as published.
    """
    contestants: dict[int, dict[str, Callable[[], int]]] = {count: {} for count in threads}
    work: dict[str, tuple[int, int, int]] = {}
    source, target = th.ones(2, _COPIED_NUMBERS)
    for net_arch in (_LARGE, _SMALL):
        layers = "-".join(map(str, net_arch))
        lac, sac = (ready_model(algorithm, net_arch, many_cells(64)) for algorithm in (LAC, SAC))
        assert isinstance(lac, LAC)
        one_critic = ready_model(LAC, net_arch, many_cells(64), policy_kwargs={"n_critics": 1})
        published = ready_model(PublishedLAC, net_arch, many_cells(64))
        work[layers] = update_flops(lac), update_flops(sac), moved_bytes(lac)
        for count, turns in contestants.items():
            turns[f"LAC, {layers}, {count}"] = partial(updates_of, lac, updates, count)
            turns[f"one critic, {layers}, {count}"] = partial(updates_of, one_critic, updates, count)
            turns[f"as published, {layers}, {count}"] = partial(updates_of, published, updates, count)
            turns[f"SAC, {layers}, {count}"] = partial(updates_of, sac, updates, count)
            turns[f"products, {layers}, {count}"] = partial(matrix_products, net_arch[0], count)
            turns[f"copies, {layers}, {count}"] = partial(copies, source, target, count)
    races = (race(turns, rounds, clock_of(count)) for count, turns in contestants.items())
    speeds = pd.concat(races, axis="columns")
    rows = []
    for layers, (flops, sac_flops, moved) in work.items():
        for count in threads:
            names = ("LAC", "one critic", "as published", "SAC", "products", "copies")
            lac_speed, one_speed, published_speed, sac_speed, rate, bandwidth = (
                speeds[f"{name}, {layers}, {count}"] for name in names
            )
            floor_s = flops / rate + moved / bandwidth
            rows.append(
                {
                    "networks": layers,
                    "threads": count,
                    "LAC, updates a second": spread(lac_speed, 0),
                    "SAC": spread(sac_speed, 0),
                    "LAC is faster by a factor of": spread(lac_speed / sac_speed, 2),
                    "with one critic": spread(one_speed / sac_speed, 2),
                    "as published": spread(published_speed / sac_speed, 2),
                    "MFLOP of an update, LAC / SAC": f"{flops / 1e6:.0f} / {sac_flops / 1e6:.0f}",
                    "GFLOP/s of matrix products": spread(rate / 1e9, 0),
                    "MB of optimizers and target": f"{moved / 1e6:.1f}",
                    "LAC's time over the floor": spread(1 / (lac_speed * floor_s), 1),
                }
            )
    return speeds, pd.DataFrame(rows)


def measure_compiled(rounds: int, updates: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    Updates a second of LAC on one thread, compiled and not, beside those of SAC, with large and small networks; and steps of
    64 cells a second of ``learn()`` with one update per step of all cells.
    """
    # code is compiled for a number of threads
    th.set_num_threads(1)
    contestants: dict[str, Callable[[], int]] = {}
    networks = ["-".join(map(str, net_arch)) for net_arch in (_LARGE, _SMALL)]
    for layers, net_arch in zip(networks, (_LARGE, _SMALL), strict=True):
        models = {
            "SAC": ready_model(SAC, net_arch, many_cells(64)),
            "eager": ready_model(LAC, net_arch, many_cells(64)),
            "compiled": ready_model(LAC, net_arch, many_cells(64), compile_update=True),
        }
        for name, model in models.items():
            contestants[f"{name}, {layers}"] = partial(updates_of, model, updates)
            contestants[f"{name}, learn, {layers}"] = partial(steps_of, model, updates)
    speeds = race(contestants, rounds, clock_of(1))
    rows = []
    for layers in networks:
        sac, eager, compiled = (speeds[f"{name}, {layers}"] for name in ("SAC", "eager", "compiled"))
        rows.append(
            {
                "networks": layers,
                "LAC, updates a second": spread(eager, 0),
                "compiled": spread(compiled, 0),
                "compiled is faster by a factor of": spread(compiled / eager, 2),
                "and than SAC by": spread(compiled / sac, 2),
                "learn(), than SAC's by": spread(speeds[f"compiled, learn, {layers}"] / speeds[f"SAC, learn, {layers}"], 2),
            }
        )
    return speeds, pd.DataFrame(rows)


def measure_learn(cells: int, rounds: int, steps: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Environment steps a second of ``learn()`` with one update per step of all cells."""
    models = {
        "LAC, all cells at once": ready_model(LAC, _LARGE, many_cells(cells)),
        "SAC, all cells at once": ready_model(SAC, _LARGE, many_cells(cells)),
        "SAC, one after another": ready_model(SAC, _LARGE, make_vec_env(_ENV_ID, cells)),
    }
    th.set_num_threads(1)
    speeds = race({name: partial(steps_of, model, steps) for name, model in models.items()}, rounds, clock_of(1))
    lac = speeds.iloc[:, 0]
    rows = [
        {"": name, "steps a second": spread(values, 0), "LAC is faster by a factor of": spread(lac / values, 2)}
        for name, values in speeds.items()
    ]
    return speeds, pd.DataFrame(rows)


def measure_growth(rounds: int, updates: int) -> pd.DataFrame:
    """How LAC's speed changes with cells, batch size and width."""
    contestants: dict[str, Callable[[], int]] = {}
    for cells in _CELLS:
        contestants[f"cells {cells}"] = partial(steps_of, ready_model(LAC, _LARGE, many_cells(cells)), updates)
    for batch_size in _BATCH_SIZES:
        model = ready_model(LAC, _LARGE, many_cells(64), batch_size)
        contestants[f"batch {batch_size}"] = partial(updates_of, model, updates)
    for width in _WIDTHS:
        contestants[f"width {width}"] = partial(updates_of, ready_model(LAC, [width] * 3, many_cells(64)), updates)
    th.set_num_threads(1)
    table = race(contestants, rounds, clock_of(1)).melt(var_name="name", value_name="speed")
    names = table.pop("name").str.split(expand=True)
    return table.assign(over=names[0], value=names[1].astype(int))[["over", "value", "speed"]]


def measure_gpu(rounds: int, updates: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    Updates a second of LAC on a GPU, compiled and not, beside those of SAC there and of LAC on one core; and ``learn()`` with
    64 cells and one update per step of all of them.
    """

    def with_tf32(model: OffPolicyAlgorithm) -> int:
        th.set_float32_matmul_precision("high")
        try:
            return updates_of(model, updates)
        finally:
            th.set_float32_matmul_precision("highest")

    th.set_num_threads(1)
    contestants: dict[str, Callable[[], int]] = {}
    for net_arch, batch_size, slower in _ON_GPU:
        ready = partial(ready_model, net_arch=net_arch, env=many_cells(64), batch_size=batch_size)
        sac, eager, core = ready(SAC, device=_GPU), ready(LAC, device=_GPU), ready(LAC)
        compiled = ready(LAC, device=_GPU, compile_update=True)
        with_tf32(compiled)  # compiles it once more
        less = max(1, updates // slower)
        turns = {
            "SAC": partial(updates_of, sac, updates),
            "eager": partial(updates_of, eager, updates),
            "compiled": partial(updates_of, compiled, updates),
            "TF32": partial(with_tf32, compiled),
            "core": partial(updates_of, core, less),
            "learn": partial(steps_of, compiled, updates),
            "learn, core": partial(steps_of, core, less),
        }
        contestants |= {f"{name}, {'-'.join(map(str, net_arch))}, {batch_size}": turn for name, turn in turns.items()}
    speeds = race(contestants, rounds, time.perf_counter)
    rows = []
    for net_arch, batch_size, _ in _ON_GPU:
        layers = "-".join(map(str, net_arch))
        of = {name: speeds[f"{name}, {layers}, {batch_size}"] for name in turns}
        rows.append(
            {
                "networks": layers,
                "batch": batch_size,
                "LAC, updates a second": spread(of["eager"], 0),
                "than SAC, times": spread(of["eager"] / of["SAC"], 2),
                "compiled": spread(of["compiled"], 0),
                "than not compiled, times": spread(of["compiled"] / of["eager"], 2),
                "with TF32, than without": spread(of["TF32"] / of["compiled"], 2),
                "one core": spread(of["core"], 1),
                "not compiled, than one core, times": spread(of["eager"] / of["core"], 2),
                "compiled, than one core": spread(of["compiled"] / of["core"], 1),
                "learn(), than on one core": spread(of["learn"] / of["learn, core"], 1),
            }
        )
    return speeds, pd.DataFrame(rows).assign(GPU=th.cuda.get_device_name())


def plot_growth(table: pd.DataFrame) -> Figure:
    """Draw LAC's speed over cells, batch size and width."""
    figure = new_figure(10.0, 3.2)
    panels = {
        "cells": ("cells, one update per step of all", "cell steps a second"),
        "batch": ("batch size", "updates a second"),
        "width": ("width of three hidden layers", "updates a second"),
    }
    for position, (over, (x_label, y_label)) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(1, 3, position)
        speeds = table[table["over"] == over].groupby("value")["speed"].quantile([0.25, 0.5, 0.75]).unstack()
        axes.fill_between(speeds.index, speeds[0.25], speeds[0.75], color=COLOUR_OF["LAC"], alpha=0.3, lw=0)
        axes.plot(speeds.index, speeds[0.5], marker="o", color=COLOUR_OF["LAC"])
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.set_xticks(speeds.index, [str(value) for value in speeds.index])
        for of_axis in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            of_axis(LogFormatter(labelOnlyBase=False, minor_thresholds=(2.0, 0.5)))
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.grid(alpha=0.3)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("performance", __doc__, jobs=None)
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, default=list(SECTIONS if _GPU else SECTIONS[:-1]), help="all by default"
    )
    parser.add_argument("--rounds", type=positive, default=20, help="turns of each contestant")
    parser.add_argument("--updates", type=positive, default=6, help="updates of a turn, and steps of all cells")
    parser.add_argument("--cells", type=positive, default=64, help="cells of learn()")
    parser.add_argument("--threads", type=positive, nargs="+", default=[1, 2], help="threads of torch")
    study = Study(parser, arguments)
    chosen = study.chosen
    if "gpu" in chosen.only and not _GPU:
        parser.error("gpu needs an NVIDIA GPU that torch can use: torch.cuda.is_available() is False")

    if "updates" in chosen.only:
        speeds, table = measure_updates(chosen.rounds, chosen.updates, chosen.threads)
        study.write({"updates": speeds}, {}, markdown(table), "updates")
    if "compiled" in chosen.only:
        speeds, table = measure_compiled(chosen.rounds, chosen.updates)
        study.write({"compiled": speeds}, {}, markdown(table), "compiled")
    if "learn" in chosen.only:
        speeds, table = measure_learn(chosen.cells, chosen.rounds, chosen.updates)
        study.write({"learn": speeds}, {}, markdown(table), "learn")
    if "growth" in chosen.only:
        growth = measure_growth(max(1, chosen.rounds // 2), chosen.updates)
        medians = growth.groupby(["over", "value"], sort=False)["speed"].apply(spread, digits=0).reset_index()
        study.write({"growth": growth}, {"growth": plot_growth(growth)}, markdown(medians), "growth")
    if "gpu" in chosen.only:
        speeds, table = measure_gpu(chosen.rounds, chosen.updates)
        study.write({"gpu": speeds}, {}, markdown(table), "gpu")


if __name__ == "__main__":
    main()
