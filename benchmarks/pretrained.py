"""
Make the policy for simulated cells that comes with ``battery_env``: LAC, trained on cells whose constants are not the model's,
as an ONNX file with a card that says what made it and what it is worth.

.. code-block:: bash

  python -m benchmarks.pretrained --updates 16000 --out results/pretrained_joint

File and card are shipped from ``battery_env/policies/pretrained_policies``; :mod:`benchmarks.aging_paths` makes the policy for
recorded cells. The settings are those of ``zoo_configs``, with the options of the task below. Scores are of held-out
discharges of the same environment (mean error over the second half of each), with the constants of the model right and wrong.
Training is not repeated, nor is a part of the evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd

from battery_env.evaluation import evaluate
from battery_env.parameters import PARAMETER_NAMES
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.policies.pretrained import file_stem, policy_of_file, write_card
from battery_env.tasks.data import standard_dataset
from benchmarks.contests import HELD_OUT, SENSORS, rows_of_parameters
from benchmarks.runs import Run, made_by, train_or_load
from benchmarks.study import (
    SYMBOLS,
    Cell,
    Study,
    Tables,
    at_most,
    command_line,
    markdown,
    natural,
    positive,
    table_of,
    versions,
)
from benchmarks.zoo_runs import zoo_run
from sb3_lac.onnx import export_onnx

ENV_ID = "BatteryVoltageJoint-v0"
#: How far kn, tDiffusion, to and tsn of the cells are from the model's, in training and as the observation takes them to be.
MISMATCH = 0.2
#: Options of the task that a policy needs when it is used.
OPTIONS: dict[str, Any] = {"nuisance": MISMATCH, "reading_s": 2.0}
#: And those of its training: up to 290 s between two decisions, as by default.
TRAINED_WITH: dict[str, Any] = {**OPTIONS, "new_readings": [0, 145], "mismatch": MISMATCH, "cost": "state"}
#: How wrong the constants are in the evaluation.
MISMATCHES = (0.0, 0.1, 0.2)


def make(seed: int, updates: int, folder: Path) -> Run:
    """Train the policy, unless that has been done, and write it as ONNX, with the options that it needs beside it."""
    run = zoo_run("lac", ENV_ID, seed, updates=updates, differing={"env_kwargs": TRAINED_WITH})
    export_onnx(train_or_load(run, folder / "models"), file_of(folder), ENV_ID)
    write_card(file_of(folder), {"env_id": ENV_ID, "options": OPTIONS})
    return run


def file_of(folder: Path) -> Path:
    """File of the policy."""
    return folder / f"{file_stem(ENV_ID, recorded=False)}.onnx"


def part(recipe: str, mismatch: float, sensor: str, discharges: int, folder: Path) -> Tables:
    """Score the policy."""
    policy, options = policy_of_file(file_of(folder))
    data = standard_dataset(PARAMETER_NAMES, "piecewise", "test", mismatch=mismatch)[:discharges]
    scores = evaluate(PolicyEstimator(policy, ENV_ID, **options), data, SENSORS[sensor], seed=1)
    return {"pretrained": scores.assign(env_id=ENV_ID, recipe=recipe, mismatch=mismatch, sensor=sensor)}


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """The scores over discharges."""
    cells: dict[str, Cell] = {
        "discharges": len,
        "mean_percent": ("second_half_mape_percent", pd.Series.mean),
        "sd_percent": ("second_half_mape_percent", pd.Series.std),
        "worst_percent": ("second_half_mape_percent", pd.Series.max),
        "final_percent": ("final_error_percent", pd.Series.mean),
        "time_per_estimate_ms": ("time_per_update_s", lambda times_s: 1e3 * times_s.iloc[0]),
    }
    # both parameters of a discharge one after the other
    rows = rows_of_parameters(scores, PARAMETER_NAMES).sort_index(kind="stable")
    return table_of(rows, ["env_id", "mismatch", "sensor", "parameter"], cells)


def card_of(run: Run, scores: pd.DataFrame, command: str, minutes: float) -> dict[str, Any]:
    """Write the card of a policy."""
    return {
        "env_id": run.task,
        "options": OPTIONS,
        "algorithm": "LAC",
        "command": command,
        "recipe": asdict(run),
        "training_data": (
            f"the training part of {run.task}: 700 simulated discharges whose kn, tDiffusion, to and tsn are off by "
            f"factors with a relative standard deviation of {MISMATCH:g}, 1 to 30 mV of noise and an offset within 10 mV"
        ),
        "training_minutes": minutes,
        "scores": scores.drop(columns="env_id").round(4).to_dict("records"),
        "versions": versions(),
    }


def summary_text(table: pd.DataFrame) -> str:
    """The summary for readers."""
    errors = zip(table["mean_percent"], table["sd_percent"], table["worst_percent"], strict=True)
    columns = {
        "environment": table["env_id"],
        "constants off by": table["mismatch"].map("{:g}".format),
        "sensor": table["sensor"],
        "parameter": table["parameter"].map(SYMBOLS),
        "mean ± sd (worst) error, second half (%)": [f"{mean:.2f} ± {sd:.2f} ({worst:.1f})" for mean, sd, worst in errors],
        "last estimate (%)": table["final_percent"].map("{:.2f}".format),
    }
    return markdown(pd.DataFrame(columns))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("pretrained", __doc__, jobs=1)
    parser.add_argument("--seed", type=natural, default=0)
    parser.add_argument("--updates", type=positive, default=5000, help="gradient steps")
    parser.add_argument("--discharges", type=at_most(HELD_OUT), default=60, help="test discharges of the evaluation")
    study = Study(parser, arguments)
    chosen = study.chosen
    study.configuration |= {"trained_with": TRAINED_WITH, "options": OPTIONS}
    run = make(chosen.seed, chosen.updates, study.out)
    of_all = {"recipe": f"{run.digest}_{run.seed}", "discharges": chosen.discharges}
    parts = [{**of_all, "mismatch": mismatch, "sensor": sensor} for mismatch in MISMATCHES for sensor in SENSORS]
    scores = study.run(part, parts, folder=study.out)["pretrained"]
    table = summary(scores)
    minutes = made_by(run, study.out / "models")["training_minutes"]
    write_card(file_of(study.out), card_of(run, table, study.command, minutes))
    study.write({"pretrained": scores, "pretrained_summary": table}, {}, summary_text(table))


if __name__ == "__main__":
    main()
