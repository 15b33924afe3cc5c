"""
Both packages in minutes: LAC, SAC and TD3 learn to find the resistance of simulated cells, and the command line follows a real
cell over its life.

.. code-block:: bash

  python -m benchmarks.demo

Figures and tables go to ``results/``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from battery_env import PolicyEstimator, TrajectoryDataset, evaluate
from battery_env.callbacks import CalibrationCallback
from battery_env.lab.batch import workers
from battery_env.plotting import plot_learning_curves, plot_true_against_inferred, save_figure
from benchmarks.runs import train_or_load
from benchmarks.study import importable
from benchmarks.zoo_runs import zoo_run

RESULTS = Path("results")
ENV, PARAMETER, CELL = "BatteryRo-v0", "r_o", "B0005"
ALGORITHMS = ("lac", "sac", "td3")
UPDATES = 1000  # published results have 6000
# One of so many held-out discharges is followed while a policy learns, and in the end
EVALUATIONS, EVERY, EVERY_IN_THE_END = 5, 40, 8


def learned(algo: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Train one policy by its entry in zoo_configs: its errors while it learned, and on each discharge in the end."""
    _, test = TrajectoryDataset.paper(PARAMETER).split(test=0.3, seed=0)
    run = zoo_run(algo, ENV, 0, updates=UPDATES)
    callback = CalibrationCallback(
        lambda model: evaluate(PolicyEstimator(model, ENV), test[::EVERY]),
        run.timesteps // (EVALUATIONS * run.n_envs),
        {f"{PARAMETER}_mape_percent": "mape_percent"},
        verbose=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        model = train_or_load(run, Path(folder), callbacks=[callback])
    return pd.DataFrame(callback.history), evaluate(PolicyEstimator(model, ENV), test[::EVERY_IN_THE_END])


def compared(out: Path) -> str:
    """Train the algorithms side by side, draw what they reached, and say it."""
    with workers(len(ALGORITHMS)) as executor:
        results = dict(zip(map(str.upper, ALGORITHMS), executor.map(importable(learned), ALGORITHMS), strict=True))
    curves = {algo: [curve] for algo, (curve, _) in results.items()}
    scores = {algo: of_discharges for algo, (_, of_discharges) in results.items()}
    save_figure(plot_true_against_inferred(scores, PARAMETER), out / f"{ENV}_inferred.png")
    save_figure(plot_learning_curves(curves, ENV), out / f"{ENV}_learning.png")
    errors = {algo: each[f"{PARAMETER}_mape_percent"] for algo, each in scores.items()}
    summary = ", ".join(f"{algo} {error.mean():.2g} % ({error.max():.2g} %)" for algo, error in errors.items())
    return f"R_o of held-out simulated cells, mean error (worst discharge): {summary}"


def aged(out: Path) -> str:
    """Say how the real cell aged."""
    life = pd.read_csv(out / "estimate.csv").iloc[[0, -1]]
    q_max = " -> ".join(f"{q_mobile_C / 3600.0:.3f}" for q_mobile_C in life["q_mobile_C"])
    r_o = " -> ".join(f"{1e3 * r_o_ohm:.0f}" for r_o_ohm in life["r_o_ohm"])
    return f"real cell {CELL} over {life['cycle'].iloc[1]} discharges: q_max {q_max} Ah, R_o {r_o} mohm"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both parts."""
    argparse.ArgumentParser(
        prog="python -m benchmarks.demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args(arguments)
    trained, life = RESULTS / "demo", RESULTS / "demo_life"
    print(f"1/2  LAC, SAC and TD3 learn to find R_o of simulated cells, {UPDATES} updates each")
    print("     (with the full state, as here, a closed form is exact: this compares algorithms)")
    print(f"2/2  battery-calibrate {CELL} --out {life}: all discharges of a real cell\n", flush=True)
    # meanwhile, in a process of its own
    command = [sys.executable, "-m", "battery_env", CELL, "--table-only", "--force", "--out", str(life)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            errors = compared(trained)
        except BaseException:
            process.terminate()
            raise
    print(f"Found:    {errors}; {aged(life)}")
    print(f"Pictures: {trained / f'{ENV}_inferred.png'}, {trained / f'{ENV}_learning.png'}, {life / 'life.png'}")
    print(
        "Next:     battery-calibrate with a file of your own (docs/command_line.md), LAC with your environment (docs/lac.md)"
    )


if __name__ == "__main__":
    main()
