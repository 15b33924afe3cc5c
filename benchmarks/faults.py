"""
What each fault of what a calibrator was told, of a sensor, or of the model does to each calibrator, on the same discharges.

.. code-block:: bash

  python -m benchmarks.faults
  python -m benchmarks.faults --policies lac:results/voltage/BatteryVoltageJoint-v0/lac_seed0_0123abcd/model.zip

The work is that of ``BatteryVoltageJoint-v0``: held-out discharges under power that changes every 60 to 140 s, both
parameters unknown, 5 mV of noise, calibrators start from a new cell. One thing is wrong at a time. The policy that comes with
``battery_env`` is among the calibrators; others stand beside it if their files are given. Finished parts are not run again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rl_zoo3 import ALGOS

from battery_env.calibration.data import Q_MOBILE_RANGE_C, R_O_RANGE_OHM
from battery_env.calibration.policy import PolicyEstimator
from battery_env.estimators.base import Estimator
from battery_env.estimators.closed_form import ClosedForm
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.evaluation import evaluate
from battery_env.loads import RandomPiecewise
from battery_env.parameters import PARAMETER_NAMES, PARAMETERS
from battery_env.plotting import LABELS, coloured, new_figure
from battery_env.sensors import SensorErrors
from battery_env.trajectories import TrajectoryDataset
from benchmarks.contests import held_out_trajectories
from benchmarks.peers import SEEDS, WORN_CELL, cpu_time_per_estimate_s
from benchmarks.study import SYMBOLS, Study, Tables, command_line, digits, duration, markdown, positive

ENV_ID = "BatteryVoltageJoint-v0"
NOISE_V = 0.005
#: Time between the estimates of least squares during a discharge.
WINDOW_EVERY_S = 300.0
#: Error of the model that one of the Kalman filters is told.
STATED_MISMATCH_V = 0.02


@dataclass(frozen=True)
class Fault:
    """
    One thing that is wrong.

    :param name: as shown to readers
    :param sensors: errors of the sensors
    :param told: noise that calibrators are told, as a multiple of the true one
    :param mismatch: how wrong the constants of the model are, see :meth:`TrajectoryDataset.generate`
    :param other_worn: whether one parameter is searched for, and the other one is held at a new cell's value while the cells
        are worn in it by 10 %
    """

    name: str
    sensors: SensorErrors = field(default_factory=lambda: SensorErrors(noise_V=NOISE_V))
    told: float = 1.0
    mismatch: float = 0.0
    other_worn: bool = False


_FAULTS = (
    Fault("none"),
    Fault("told a third of the noise", told=1.0 / 3.0),
    Fault("told three times the noise", told=3.0),
    Fault("voltage +10 mV", SensorErrors(noise_V=NOISE_V, offset_V=0.010)),
    Fault("current +1 %", SensorErrors(noise_V=NOISE_V, current_gain=1.01)),
    Fault("one unknown, the other 10 % worn but held new", other_worn=True),
    Fault("constants of the model off by 10 %", mismatch=0.1),
    Fault("constants of the model off by 20 %", mismatch=0.2),
)
FAULTS = {fault.name: fault for fault in _FAULTS}


@dataclass(frozen=True)
class Calibrator:
    """
    A calibrator in the comparison.

    :param name: as shown to readers
    :param needs: what it has to know
    :param make: makes it, from the names of what is unknown and the noise that it is told, V
    """

    name: str
    needs: str
    make: Callable[[Sequence[str], float], Estimator]


_POLICY_NEEDS = "training on simulated discharges, model"
_PRETRAINED = "LAC, pretrained"
_CALIBRATORS = (
    Calibrator("closed form", "full state, model", lambda unknown, noise_V: ClosedForm()),
    Calibrator(
        "least squares",
        "model; noise for what it states",
        lambda unknown, noise_V: LeastSquares(unknown, voltage_noise_V=noise_V, window_every_s=WINDOW_EVERY_S),
    ),
    Calibrator(
        "Kalman filter",
        "model, noise, prior, size of an offset",
        lambda unknown, noise_V: ExtendedKalmanFilter(unknown, voltage_noise_V=noise_V),
    ),
    Calibrator(
        "Kalman filter, told 20 mV of model error",
        "the same, error of the model",
        lambda unknown, noise_V: ExtendedKalmanFilter(
            unknown, voltage_noise_V=max(noise_V, STATED_MISMATCH_V), mismatch_V=STATED_MISMATCH_V
        ),
    ),
    Calibrator(_PRETRAINED, _POLICY_NEEDS, lambda unknown, noise_V: PolicyEstimator.pretrained(ENV_ID)),
)
CALIBRATORS = {calibrator.name: calibrator for calibrator in _CALIBRATORS}
# Exact estimates are drawn here
_FLOOR_PERCENT = 1e-3


def work(fault: Fault, unknown: Sequence[str], n: int) -> TrajectoryDataset:
    """
    The discharges: the first held-out ones of the environment, with the same ages and loads whatever the fault, but where one
    parameter alone is unknown.
    """
    if fault.other_worn:
        return TrajectoryDataset.generate(
            unknown[0],
            n,
            RandomPiecewise(),
            SEEDS[unknown[0]],
            q_mobile_range=Q_MOBILE_RANGE_C,
            r_o_range=R_O_RANGE_OHM,
            cell=WORN_CELL,
        )
    return held_out_trajectories(ENV_ID, mismatch=fault.mismatch)[:n]


def part(
    calibrator: str, fault: str, unknown: Sequence[str], discharges: int, policy: str | None, digest: str | None
) -> Tables:
    """Score one calibrator under one fault."""
    wrong = FAULTS[fault]
    data = work(wrong, unknown, discharges)
    if policy is None:
        estimator = CALIBRATORS[calibrator].make(unknown, wrong.told * wrong.sensors.noise_V)
    else:
        algo, _, file = policy.partition(":")
        estimator = PolicyEstimator(ALGOS[algo].load(file, device="cpu"), ENV_ID)
    scores = evaluate(estimator, data, wrong.sensors, seed=1)
    tables = []
    for name in unknown:
        columns = {
            "true": name,
            "second_half_mape_percent": f"{name}_second_half_mape_percent",
            "final_error_percent": f"{name}_final_error_percent",
            "coverage_percent": f"{name}_coverage_percent",
        }
        table = pd.DataFrame({column: scores[source] for column, source in columns.items()})
        table.insert(0, "parameter", name)
        tables.append(table.join(scores[["trajectory", "settled_time_s", "updates"]]))
    together = pd.concat(tables)
    together.insert(0, "fault", fault)
    together.insert(0, "calibrator", calibrator)
    if wrong is _FAULTS[0]:
        together["cpu_time_per_estimate_s"] = cpu_time_per_estimate_s(estimator, data, slow=False)
    return {"faults": together}


def parts(n: int, policies: Sequence[str]) -> list[dict[str, Any]]:
    """All parts of this study."""
    chosen = []
    for fault in FAULTS.values():
        unknowns = [(name,) for name in PARAMETERS] if fault.other_worn else [PARAMETER_NAMES]
        for unknown in unknowns:
            common = {"fault": fault.name, "unknown": list(unknown), "discharges": -(-n // len(unknowns))}
            names = [name for name in CALIBRATORS if not (fault.other_worn and name == _PRETRAINED)]
            chosen += [{**common, "calibrator": name, "policy": None, "digest": None} for name in names]
            if not fault.other_worn:
                chosen += [
                    {**common, "calibrator": _policy_name(policy), "policy": policy, "digest": _digest(policy)}
                    for policy in policies
                ]
    return chosen


def _policy_name(policy: str) -> str:
    algo, _, file = policy.partition(":")
    return f"{algo.upper()} {Path(file).stem}"


def _digest(policy: str) -> str:
    return sha256(Path(policy.partition(":")[2]).read_bytes()).hexdigest()[:8]


def calibrators_of(results: pd.DataFrame) -> list[str]:
    """Who was compared."""
    return list(dict.fromkeys([*CALIBRATORS, *results["calibrator"]]))


def faults_table(results: pd.DataFrame, parameter: str) -> pd.DataFrame:
    """Errors of the second half of the discharges."""
    rows = []
    for fault in FAULTS:
        row = {f"{SYMBOLS[parameter]}: what is wrong": fault}
        for name in calibrators_of(results):
            errors = _of(results, name, fault, parameter)["second_half_mape_percent"]
            row[name] = f"{digits(errors.mean())} ({digits(errors.max())})" if len(errors) else "-"
        rows.append(row)
    return pd.DataFrame(rows)


def honesty_table(results: pd.DataFrame) -> pd.DataFrame:
    """What calibrators state beside their estimates."""
    rows = []
    for fault in FAULTS:
        row = {"what is wrong": fault}
        for name in calibrators_of(results):
            both = [_of(results, name, fault, parameter) for parameter in PARAMETERS]
            if all(of_one["coverage_percent"].notna().any() for of_one in both):
                settled = np.isfinite(both[0]["settled_time_s"]).mean()
                row[f"{name}: within 2 sd (%), q^max / R_o"] = " / ".join(
                    digits(of_one["coverage_percent"].mean()) for of_one in both
                )
                row[f"{name}: says settled in the end (%)"] = f"{100.0 * settled:.0f}"
        rows.append(row)
    return pd.DataFrame(rows).fillna("-")


def needs_table(results: pd.DataFrame) -> pd.DataFrame:
    """What each calibrator needs to know, and what an estimate costs."""
    rows = []
    for name in calibrators_of(results):
        spent_s = results[results["calibrator"] == name]["cpu_time_per_estimate_s"].mean()
        needs = CALIBRATORS[name].needs if name in CALIBRATORS else _POLICY_NEEDS
        rows.append({"calibrator": name, "needs": needs, "time per estimate": duration(spent_s)})
    return pd.DataFrame(rows)


def _of(results: pd.DataFrame, calibrator: str, fault: str, parameter: str) -> pd.DataFrame:
    chosen = (results["calibrator"] == calibrator) & (results["fault"] == fault) & (results["parameter"] == parameter)
    return results[chosen]


def report(results: pd.DataFrame, configuration: Mapping[str, Any]) -> str:
    """All tables."""
    n = configuration["discharges"]
    tables = [needs_table(results), *(faults_table(results, name) for name in PARAMETERS), honesty_table(results)]
    needs, q_mobile, r_o, honesty = (markdown(table) for table in tables)
    noise_mV = 1e3 * NOISE_V
    return f"""{n} held-out discharges of `{ENV_ID}`, 2 to 8 W that change every 60 to 140 s, {noise_mV:g} mV of noise, both
parameters unknown, from the estimate of a new cell; one thing wrong at a time. Where one parameter is unknown, {-(-n // 2)}
discharges for each. Constants of the model: kn, tDiffusion, to and tsn of each cell are multiplied by log-normal factors. The
closed form sees the exact state and the current of the sensor. Least squares estimate every {WINDOW_EVERY_S:g} s, the filters
every second, the policy every minute. Times are CPU times on one core.

{needs}
Error in the second half of a discharge: mean over discharges (worst discharge), %.

{q_mobile}
{r_o}
Share of all estimates of a discharge within two stated standard deviations of the truth, and of discharges whose last
estimate the calibrator takes for settled. Where one parameter is unknown, settled is that of q^max.

{honesty}"""


def plot_faults(results: pd.DataFrame) -> Figure:
    """The errors of all discharges."""
    names = calibrators_of(results)
    figure = new_figure(10.4, 1.2 + 0.7 * len(FAULTS))
    panels = figure.subplots(1, len(PARAMETERS), sharey=True)
    shifts = np.linspace(-0.32, 0.32, len(names))
    for axes, parameter in zip(panels, PARAMETERS, strict=True):
        for row, fault in enumerate(FAULTS):
            for shift, (colour, name) in zip(shifts, coloured(names), strict=False):
                errors = _of(results, name, fault, parameter)["second_half_mape_percent"].to_numpy()
                visible = np.maximum(errors, _FLOOR_PERCENT)
                axes.plot(visible, np.full(len(visible), row + shift), "o", ms=3, mew=0, alpha=0.35, color=colour)
                if len(errors):
                    mean = max(errors.mean(), _FLOOR_PERCENT)
                    axes.plot([mean] * 2, [row + shift - 0.1, row + shift + 0.1], color=colour, lw=2.2, label=name)
        axes.set(xscale="log", xlabel="error in the second half (%)", title=LABELS[parameter].split(" (")[0])
        axes.grid(axis="x", alpha=0.25)
    panels[0].set_yticks(range(len(FAULTS)), FAULTS)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    figure.legend(once.values(), once.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("faults", __doc__, jobs=1)
    parser.add_argument("--discharges", type=positive, default=60)
    parser.add_argument(
        "--policies",
        nargs="*",
        default=[],
        metavar="ALGO:FILE",
        help=f"models that were trained on {ENV_ID}, like lac:model.zip",
    )
    study = Study(parser, arguments)
    for policy in study.chosen.policies:
        algo, _, file = policy.partition(":")
        if algo not in ALGOS or not Path(file).is_file():
            parser.error(f"{policy}: name an algorithm of the RL Zoo and the file of a model, like lac:model.zip")
    study.configuration |= {
        "faults": [asdict(fault) for fault in FAULTS.values()],
        "window_every_s": WINDOW_EVERY_S,
        "stated_mismatch_V": STATED_MISMATCH_V,
        "worn_cell": {name: getattr(WORN_CELL, name) for name in PARAMETERS},
        "seed_of_noise": 1,
    }
    tables = study.run(part, parts(study.chosen.discharges, study.chosen.policies))
    results = tables["faults"]
    study.write(tables, {"faults": plot_faults(results)}, report(results, study.configuration))


if __name__ == "__main__":
    main()
