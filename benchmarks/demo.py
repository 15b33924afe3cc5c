"""
The main job in minutes: a short comparison of LAC, SAC and TD3 on two tasks, then q^max and R_o over the life of a real cell.

.. code-block:: bash

  python -m benchmarks.demo

Figures and tables go to ``results/``. Interrupted, it goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks import cells, compare

RESULTS = Path("results")
TIMESTEPS = 154_560  # 2400 updates


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both parts."""
    argparse.ArgumentParser(
        prog="python -m benchmarks.demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args(arguments)
    print("1/2  LAC, SAC and TD3 calibrate simulated cells (2400 updates each; the full runs take 12 000)\n", flush=True)
    envs = ["--envs", "BatteryRo-v0", "BatteryQmax-v0"]
    compare.main([*envs, "--timesteps", str(TIMESTEPS), "--evaluations", "6", "--out", str(RESULTS / "demo_compare")])
    print("\n2/2  q^max and R_o of NASA's cell B0005, from its recorded discharges\n", flush=True)
    cells.main(["real_cells", "--cells", "B0005", "--out", str(RESULTS / "demo_real_cells")])
    print(f"\nFigures and tables: {RESULTS.resolve()}")


if __name__ == "__main__":
    main()
