"""
Both packages in minutes: LAC, SAC and TD3 learn to find the resistance of simulated cells, and the command line follows a real
cell over its life.

.. code-block:: bash

  python -m benchmarks.demo

Figures and tables go to ``results/``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pandas as pd

from benchmarks import compare

RESULTS = Path("results")
ENV, CELL = "BatteryRo-v0", "B0005"
UPDATES, CELLS_AT_ONCE, LEARNING_STARTS = 800, 64, 1000  # published results have 6000 updates


def compared(out: Path) -> str:
    """Train the algorithms, and say what they reached."""
    timesteps = UPDATES * CELLS_AT_ONCE + LEARNING_STARTS
    compare.main(["--envs", ENV, "--timesteps", str(timesteps), "--evaluations", "4", "--jobs", "3", "--out", str(out)])
    trained = pd.read_csv(out / "compare.csv").dropna(subset="seed")  # the closed form has none
    errors = [f"{row.algo.upper()} {row.mape_percent:.2g} % ({row.mape_worst_percent:.2g} %)" for row in trained.itertuples()]
    return f"R_o of held-out simulated cells, mean error (worst discharge): {', '.join(errors)}"


@contextmanager
def followed(out: Path) -> Iterator[None]:
    """Calibrate to all discharges of a real cell meanwhile: with three trainings beside it no core is ever idle."""
    command = [sys.executable, "-m", "battery_env", CELL, "--table-only", "--force", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield
        except BaseException:
            process.terminate()
            raise


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
    trained, life = RESULTS / "demo_compare", RESULTS / "demo_life"
    print(f"1/2  LAC, SAC and TD3 learn to find R_o of simulated cells, {UPDATES} updates each")
    print("     (with the full state, as here, a closed form is exact: this compares algorithms)")
    print(f"2/2  battery-calibrate {CELL} --out {life}: all discharges of a real cell\n", flush=True)
    with followed(life):
        errors = compared(trained)
    print(f"\nFound:    {errors}; {aged(life)}")
    print(f"Pictures: {trained / f'{ENV}_inferred.png'}, {trained / f'{ENV}_learning.png'}, {life / 'life.png'}")
    print(
        "Next:     battery-calibrate with a file of your own (docs/command_line.md), LAC with your environment (docs/lac.md)"
    )


if __name__ == "__main__":
    main()
