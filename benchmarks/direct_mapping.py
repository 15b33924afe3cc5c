"""
Does a policy generalise better than the direct mapping of the paper? Networks that are taught with labels to tell the
parameter from two consecutive states, beside policies that never see a label and the closed form, on held-out discharges, on
loads heavier than those of the training, and on cells more aged than those of the training.

.. code-block:: bash

  python -m benchmarks.direct_mapping

Everything sees the full state of the paper's discharges. A mapping learns from random pairs of random discharges of the
training part. Policies train with the settings of ``zoo_configs``, on the less aged cells; on the other discharges they are
those of ``benchmarks.compare``. Finished parts are not run again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import Trajectory
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.closed_form import ClosedForm
from battery_env.estimators.estimator import Estimator
from battery_env.evaluation import evaluate
from battery_env.parameters import PARAMETER_NAMES
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.tasks.full_state.layout import LITERAL, OBSERVED
from battery_env.trajectories import TrajectoryDataset
from benchmarks.contests import rows_of_parameters
from benchmarks.runs import train_or_load
from benchmarks.study import (
    SYMBOLS,
    Cell,
    Study,
    Tables,
    command_line,
    digits,
    markdown,
    natural,
    of_trained,
    positive,
    table_of,
    with_spread,
)
from benchmarks.zoo_runs import zoo_run

Parameter = Literal["q_mobile", "r_o"]
Parts = tuple[TrajectoryDataset, TrajectoryDataset]

#: Of the eleven loads of the paper, 8 to 16 W, those above are tested in the division by load: four.
HEAVY_LOAD_W = 13.0
#: About how many discharges of a test part are scored, evenly spaced.
TEST_DISCHARGES = 128

_TESTED = {"trajectory": "other discharges", "load": "heavier loads", "parameter": "more aged cells"}
#: Direct mappings, as shown to readers.
MAPPINGS = {"raw": "direct mapping, raw (the paper's)", "normalised": "direct mapping, normalised"}
ENV_IDS: dict[str, str] = {"q_mobile": "BatteryQmax-v0", "r_o": "BatteryRo-v0"}

# The paper's network and optimizer; it does not name the size of a batch
_LAYERS = [256, 256, 256]
_LEARNING_RATE = 5e-4
_BATCH_SIZE = 64
# Pairs that go through the network at once when it is used
_CHUNK = 8192


def _by_load(data: TrajectoryDataset) -> Parts:
    heavy = data.load_values[data.load_start] > HEAVY_LOAD_W
    return data.subset(np.flatnonzero(~heavy)), data.subset(np.flatnonzero(heavy))


#: How the data are divided into a training and a test part. The first division is that of the registered environments.
DIVISIONS: dict[str, Callable[[TrajectoryDataset], Parts]] = {
    "trajectory": lambda data: data.split(by="trajectory"),
    "load": _by_load,
    "parameter": lambda data: data.split(by="parameter"),
}


def divided(parameter: Parameter, division: str) -> Parts:
    """The paper's data, divided."""
    return DIVISIONS[division](TrajectoryDataset.paper(parameter))


def train_policy(algo: str, parameter: Parameter, seed: int, updates: int | None, out: Path) -> BaseAlgorithm:
    """Train a policy on the less aged cells, or load it if that has been done."""
    env_id = ENV_IDS[parameter]
    run = zoo_run(algo, env_id, seed, updates=updates)
    on_less_aged = {**run.environment, "dataset": str(training_file(parameter, out))}
    return train_or_load(replace(run, environment=on_less_aged), out / "models")


def training_file(parameter: Parameter, out: Path) -> Path:
    """The discharges of the less aged cells, as a file."""
    file = out / "data" / f"{parameter}.npz"
    if not file.exists():
        with suppress(FileExistsError):  # of another part, which has made the same
            divided(parameter, "parameter")[0].save(file)
    return file


class Pairs(NamedTuple):
    """Labelled pairs of consecutive states without the temperature."""

    before: FloatArray  # x_t, shape (n, 7)
    after: FloatArray  # x_{t+1}, shape (n, 7)
    load_W: FloatArray  # u_{t+1}, the power over that second, shape (n,)
    label: FloatArray  # the true parameter, C or ohm, shape (n,)


def draw_pairs(data: TrajectoryDataset, parameter: Parameter, n: int, seed: int) -> Pairs:
    """Labelled pairs from random seconds of random discharges, as episodes of the environments start."""
    rng = np.random.default_rng(seed)
    discharge = rng.integers(len(data), size=n)
    sample = rng.integers(data.first[discharge], data.stop[discharge] - 1)
    before, after = (data.states_at(discharge, at)[:, OBSERVED] for at in (sample, sample + 1))
    return Pairs(before, after, data.load_values[data.load_start[discharge] + sample], getattr(data, parameter)[discharge])


def _inputs(pairs: Pairs) -> FloatArray:
    # in the authors' scales
    scaled = (pairs.before / LITERAL.state_scale, pairs.after / LITERAL.state_scale)
    return np.concatenate([*scaled, pairs.load_W[:, None] / LITERAL.load_scale], axis=1)


class _Scale:
    """Shift and scale of columns, from what they are on the training pairs."""

    def __init__(self, values: FloatArray, used: bool) -> None:
        self.mean = values.mean(axis=0) if used else np.zeros(values.shape[1])
        spread = values.std(axis=0) if used else np.ones(values.shape[1])
        # what does not vary says nothing
        self.spread = np.where(spread > 0.0, spread, 1.0)

    def to_tensor(self, values: FloatArray) -> th.Tensor:
        return th.as_tensor((values - self.mean) / self.spread, dtype=th.float32)


class DirectMapping(Estimator):
    """The paper's rival: the policy's network, taught with labels to tell a parameter from two consecutive states."""

    def __init__(self, normalised: bool, parameter: Parameter, pairs: Pairs, epochs: int, seed: int) -> None:
        self.parameter = parameter
        inputs, labels = _inputs(pairs), pairs.label[:, None]
        self._inputs, self._labels = (_Scale(values, normalised) for values in (inputs, labels))
        th.manual_seed(seed)
        self.network = nn.Sequential(*create_mlp(inputs.shape[1], 1, _LAYERS, nn.LeakyReLU))
        self._fit(self._inputs.to_tensor(inputs), self._labels.to_tensor(labels), epochs)

    def _fit(self, inputs: th.Tensor, labels: th.Tensor, epochs: int) -> None:
        optimizer = th.optim.Adam(self.network.parameters(), lr=_LEARNING_RATE, fused=True)
        for _ in range(epochs):
            for batch in th.randperm(len(inputs)).split(_BATCH_SIZE):
                loss = nn.functional.mse_loss(self.network(inputs[batch]), labels[batch])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()

    def infer(self, pairs: Pairs) -> FloatArray:
        """The parameter of each pair."""
        with th.no_grad():
            inferred = [self.network(chunk) for chunk in self._inputs.to_tensor(_inputs(pairs)).split(_CHUNK)]
        scaled = th.cat(inferred).numpy().astype(np.float64)
        return (self._labels.mean + self._labels.spread * scaled)[:, 0]

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """One estimate for every step of many discharges."""
        discharges = list(records)
        pairs = Pairs(
            np.concatenate([record.state[:-1, OBSERVED] for record in discharges]),
            np.concatenate([record.state[1:, OBSERVED] for record in discharges]),
            np.concatenate([record.load[:-1] for record in discharges]),
            np.empty(0),
        )
        ends = np.cumsum([len(record.time_s) - 1 for record in discharges])[:-1]
        traces = []
        for record, inferred in zip(discharges, np.split(self.infer(pairs), ends), strict=True):
            values = {name: np.full(len(inferred), getattr(record, name)) for name in PARAMETER_NAMES} | {
                self.parameter: inferred
            }
            traces.append(EstimateTrace(record.time_s[1:], values["q_mobile"], values["r_o"]))
        return traces

    def estimate(self, record: Trajectory) -> Estimate:  # type: ignore[override]
        """The estimate from the last two samples of a discharge."""
        trace = self.trace([record])[0]
        return Estimate(q_mobile=float(trace.q_mobile[-1]), r_o=float(trace.r_o[-1]))


def scores(estimator: Estimator, parameter: Parameter, division: str, method: str, seed: int | None) -> Tables:
    """Score a calibrator on the test part of a division."""
    test = divided(parameter, division)[1]
    scores_of_test = evaluate(estimator, test.subset(range(0, len(test), max(len(test) // TEST_DISCHARGES, 1))))
    shown = {"load": "load_W", "hat": "inferred", "time_per_update_s": "time_per_estimate_s"}
    rows = rows_of_parameters(scores_of_test, [parameter]).rename(columns=shown)
    columns = ["method", "parameter", "division", "seed", "load_W", "true", "inferred", "mape_percent", "final_error_percent"]
    columns += ["worst", "bias", "spread", "time_per_estimate_s"]
    return {"direct_mapping": rows.assign(method=method, division=division, seed=seed)[columns]}


def mapping_part(kind: str, parameter: Parameter, division: str, seed: int, pairs: int, epochs: int) -> Tables:
    """Teach one direct mapping, and score it."""
    th.set_num_threads(1)
    sampled = draw_pairs(divided(parameter, division)[0], parameter, pairs, seed)
    mapping = DirectMapping(kind == "normalised", parameter, sampled, epochs, seed)
    return scores(mapping, parameter, division, MAPPINGS[kind], seed)


def policy_part(algo: str, parameter: Parameter, seed: int, updates: int | None, out: Path) -> Tables:
    """Train one policy, unless that has been done, and score it; the model runs free over whole discharges."""
    estimator = PolicyEstimator(train_policy(algo, parameter, seed, updates, out), ENV_IDS[parameter])
    return scores(estimator, parameter, "parameter", algo.upper(), seed)


def exact_part(parameter: Parameter, division: str) -> Tables:
    """Score the closed form."""
    return scores(ClosedForm(), parameter, division, "closed form", None)


def report(results: pd.DataFrame, configuration: Mapping[str, Any]) -> str:
    """Write the text and the table."""

    def seeds(group: pd.DataFrame) -> pd.Series:
        return group.groupby("seed", sort=False, dropna=False)["mape_percent"].mean()

    results = results.assign(
        symbol=results["parameter"].map(SYMBOLS),
        tested=results["division"].map(_TESTED),
        **{f"{name}_percent": 100.0 * results[name] / results["true"] for name in ("bias", "spread")},
    )
    cells: dict[str, Cell] = {
        "seeds": of_trained(lambda group: str(len(seeds(group)))),
        "MAPE (%)": lambda group: with_spread(seeds(group)),
        "worst discharge (%)": ("mape_percent", lambda errors: digits(errors.max())),
        "bias (%)": ("bias_percent", lambda biases: f"{biases.mean():+.2g}"),
        "spread (%)": ("spread_percent", lambda spreads: digits(spreads.mean())),
    }
    table = table_of(results, {"symbol": "parameter", "tested": "tested on", "method": "calibrator"}, cells)
    text = f"""The paper's data, the full state, trimmed to 5 to 95 % of each discharge. Other discharges: a random 30 %,
trained on the other 70 %. Heavier loads: trained up to 12.8 W, tested above {HEAVY_LOAD_W:g} W. More aged cells: trained on
the 70 % least aged, tested on the others. Mappings learn from {configuration["pairs"]} labelled pairs, shown
{configuration["epochs"]} times each. Errors are means over whole test discharges, ± the standard deviation over seeds;
worst: of any seed; spread: standard deviation within a discharge.

"""
    return text + markdown(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("direct_mapping", __doc__, jobs=1)
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2])
    parser.add_argument("--pairs", type=positive, default=12_800, help="labelled pairs that a mapping learns from")
    parser.add_argument("--epochs", type=positive, default=30)
    parser.add_argument("--algos", nargs="*", default=["lac"], choices=["lac", "sac", "td3"], metavar="ALGO", help="policies")
    parser.add_argument("--updates", type=positive, help="gradient steps of policies; those of zoo_configs by default")
    study = Study(parser, arguments)
    chosen = study.chosen
    places = [{"parameter": parameter, "division": division} for parameter in ENV_IDS for division in DIVISIONS]
    mappings = [
        {"kind": kind, **place, "seed": seed, "pairs": chosen.pairs, "epochs": chosen.epochs}
        for kind in MAPPINGS
        for seed in chosen.seeds
        for place in places
    ]
    policies = [
        {"algo": algo, "parameter": parameter, "seed": seed, "updates": chosen.updates}
        for algo in chosen.algos
        for seed in chosen.seeds
        for parameter in ENV_IDS
    ]
    tables_of_parts = [study.run(mapping_part, mappings), study.run(policy_part, policies, out=study.out)]
    tables_of_parts.append(study.run(exact_part, places))
    results_in_order = pd.concat([tables["direct_mapping"] for tables in tables_of_parts if tables], ignore_index=True)
    groups = results_in_order.groupby(["parameter", "division"])
    results = pd.concat([groups.get_group(tuple(place.values())) for place in places], ignore_index=True)
    text = report(results, study.configuration)
    study.write({"direct_mapping": results}, {}, text)


if __name__ == "__main__":
    main()
