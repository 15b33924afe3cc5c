"""
LAC, SAC and TD3 side by side where the model is a little wrong: policies of ``BatteryVoltageJoint-v0`` that learn as those
that come with ``battery_env`` do, each algorithm with its own settings, several seeds.

.. code-block:: bash

  python -m benchmarks.mismatch_policies

Held-out discharges, both parameters unknown; kn, tDiffusion, to and tsn of each cell are off by factors with a relative
standard deviation of 0 or 0.2. What needs no learning, on the same discharges: ``python -m benchmarks.mismatch``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import pandas as pd

from battery_env.calibration.data import standard_dataset
from battery_env.calibration.policy import PolicyEstimator
from battery_env.evaluation import evaluate
from benchmarks.contests import SENSORS, check_discharges
from benchmarks.mismatch import ENV_ID, MISMATCHES, plot_scores
from benchmarks.pretrained import OPTIONS, TRAINED_WITH
from benchmarks.study import SYMBOLS, Study, Tables, command_line, digits, markdown, natural, positive
from benchmarks.training import Recipe, timesteps_of, train_or_load


def part(algo: str, seed: int, updates: int, discharges: int, folder: Path) -> Tables:
    """Train a policy, unless that has been done, and score it under all conditions."""
    timesteps = timesteps_of(updates, Recipe.of(algo, ENV_ID, seed).hyperparameters)
    model = train_or_load(algo, ENV_ID, seed, timesteps, folder / "models", {"env_kwargs": TRAINED_WITH})
    estimator, scores = PolicyEstimator(model, ENV_ID, **OPTIONS), []
    for mismatch in MISMATCHES:
        data = standard_dataset(("q_mobile", "r_o"), "piecewise", "test", mismatch=mismatch)[:discharges]
        for sensor, errors in SENSORS.items():
            found = evaluate(estimator, data, errors, seed=1)
            scores.append(found.assign(calibrator=algo.upper(), seed=seed, mismatch=mismatch, sensor=sensor))
    return {"mismatch_policies": pd.concat(scores, ignore_index=True)}


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """The table for readers."""
    rows = []
    groups = dict(list(scores.groupby(["mismatch", "sensor", "calibrator"])))
    for mismatch, sensor, algo in product(MISMATCHES, SENSORS, scores["calibrator"].unique()):
        group = groups[mismatch, sensor, algo]
        row = {"constants off by": f"{mismatch:g}", "sensor": sensor, "algorithm": algo}
        for name, symbol in SYMBOLS.items():
            column = f"{name}_second_half_mape_percent"
            means = group.groupby("seed")[column].mean()
            row[f"{symbol}: mean of each seed (worst discharge) (%)"] = (
                f"{' / '.join(f'{mean:.2f}' for mean in means)} ({digits(group[column].max())})"
            )
            row[f"{symbol}, within two stated sd (%)"] = digits(group[f"{name}_coverage_percent"].mean())
        rows.append(row)
    return pd.DataFrame(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("mismatch_policies", __doc__)
    parser.add_argument("--algos", nargs="+", choices=("lac", "sac", "td3"), default=["lac", "sac", "td3"])
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2])
    parser.add_argument("--updates", type=positive, default=5000, help="gradient steps of each training")
    parser.add_argument("--discharges", type=positive, default=60, help="simulated test discharges, up to 300")
    study = Study(parser, arguments)
    chosen = study.chosen
    check_discharges(parser, chosen.discharges)
    study.configuration |= {"trained_with": TRAINED_WITH}
    parts = [
        {"algo": algo, "seed": seed, "updates": chosen.updates, "discharges": chosen.discharges}
        for algo in chosen.algos
        for seed in chosen.seeds
    ]
    tables = study.run(part, parts, folder=study.out)
    scores = tables["mismatch_policies"]
    study.write(tables, {"mismatch_policies": plot_scores(scores)}, markdown(summary(scores)))


if __name__ == "__main__":
    main()
