"""
Policies for a cell of one's own: trained on simulations of the constants that were fitted to one real cell, and tested on
another one, beside least squares and the Kalman filter with the same constants. NASA's B0005 and B0006, both ways round.

.. code-block:: bash

  python -m benchmarks.own_cell --every 4

A cell is fitted to its first, middle and last discharge. The policies learn on simulated cells with these constants, under
the recorded loads of that cell, with ages from a wide range; their constants are off by factors, and what is left of
the error of the model is noise on their overpotentials that wanders. Of the tested cell nothing is known but that it is of the
same kind. Rivals with a prior know that range of ages too: its mean and standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.arrays import FloatArray
from battery_env.calibration.policy import PolicyEstimator, Predictor
from battery_env.cells import NASA_CITATION, load_nasa_discharges
from battery_env.estimators import Estimator, ExtendedKalmanFilter
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V, CellFit
from battery_env.loads import recorded
from battery_env.plotting import COLOURS, LABELS, new_figure
from battery_env.record_model import RecordModel
from battery_env.trajectories import TrajectoryDataset
from benchmarks.fit_cell import CUT_OFF_V, PAIRS, SHARES, fitted_to
from benchmarks.mismatch import ENV_ID, Follow
from benchmarks.pretrained import MISMATCH, OPTIONS, RECORDED
from benchmarks.pretrained import TRAINED_WITH as PRETRAINED_WITH
from benchmarks.study import Study, Tables, command_line, digest_of, markdown, natural, positive
from benchmarks.training import Recipe, timesteps_of, train_or_load

#: Of the cells that policies learn on, C and ohm.
Q_MOBILE_RANGE_C = (4000.0, 8000.0)
R_O_RANGE_OHM = (0.06, 0.3)
#: What rivals with a prior know of ``q_mobile``: mean and standard deviation of that range, C.
PRIOR_C = (sum(Q_MOBILE_RANGE_C) / 2.0, float(np.ptp(Q_MOBILE_RANGE_C) / np.sqrt(12.0)))
#: Options of the task in training: as of the policies for recorded cells, but for the mismatch, which is in the data. With
#: these constants the noise makes the voltage wander by 29 mV, twice the error that the fits leave.
TRAINED_WITH = {name: value for name, value in (PRETRAINED_WITH | RECORDED).items() if name != "mismatch"}

_CELLS = 1000


def simulated(fit: CellFit, cell: str, folder: Path) -> Path:
    """The discharges that policies learn on, unless the file is there."""
    made_from = {"cell": asdict(fit.cell), "q": Q_MOBILE_RANGE_C, "r": R_O_RANGE_OHM, "mismatch": MISMATCH, "n": _CELLS}
    file = folder / f"{cell}_{digest_of(made_from)}.npz"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        loads = [recorded(discharge.loaded_part(CUT_OFF_V), "power", 1.0) for discharge in load_nasa_discharges(cell)]
        ranges: dict[str, Any] = {"q_mobile_range": Q_MOBILE_RANGE_C, "r_o_range": R_O_RANGE_OHM}
        aged = ("q_mobile", "r_o")
        TrajectoryDataset.generate(aged, _CELLS, loads, 0, **ranges, cell=fit.cell, mismatch=MISMATCH).save(file)
    return file


class Together:
    """
    Several policies as one: the mean of their actions.

    :param policies: which
    """

    def __init__(self, policies: Sequence[Predictor]) -> None:
        self.policies = policies

    def predict(self, observation: FloatArray, /, *, deterministic: bool = False) -> tuple[FloatArray, None]:
        """The mean action."""
        actions = [policy.predict(observation, deterministic=deterministic)[0] for policy in self.policies]
        return np.mean(actions, axis=0), None


#: Calibrators without learning, by name, with the fitted constants.
CLASSICAL: dict[str, Callable[[CellFit], Estimator]] = {
    "least squares": lambda fit: fit.calibrator(),
    "least squares, prior": lambda fit: fit.calibrator(prior_q_mobile_C=PRIOR_C),
    "Kalman filter": lambda fit: _filter(fit),
    "Kalman filter, prior": lambda fit: _filter(fit, prior_q_mobile_C=PRIOR_C),
    "the fit that policies see": lambda fit: PolicyEstimator(Follow(), ENV_ID, cell=fit.cell, **OPTIONS),
}


def _filter(fit: CellFit, **arguments: Any) -> ExtendedKalmanFilter:
    # told what the fit expects, 13 to 15 mV, it loses discharges in their first quarter
    return ExtendedKalmanFilter(cell=fit.cell, thermal=fit.thermal, mismatch_V=UNFITTED_MISMATCH_V, **arguments)


def trained(algo: str, seed: int, updates: int, dataset: Path, folder: Path) -> Predictor:
    """A policy for a cell, trained unless that has been done."""
    chosen = {"env_kwargs": {**TRAINED_WITH, "dataset": str(dataset)}}
    timesteps = timesteps_of(updates, Recipe.of(algo, ENV_ID, seed).hyperparameters)
    return train_or_load(algo, ENV_ID, seed, timesteps, folder, chosen)


def part(calibrator: str, seeds: list[int], updates: int, fitted: str, tested: str, every: int, folder: Path) -> Tables:
    """
    Fit a cell, make a calibrator with its constants, and let it estimate discharges of the other cell, whole and in progress.
    """
    fit = fitted_to(fitted)
    if calibrator in CLASSICAL:
        estimator = CLASSICAL[calibrator](fit)
    else:
        dataset = simulated(fit, fitted, folder / "data")
        policies = [trained(calibrator.lower(), seed, updates, dataset, folder / "models") for seed in seeds]
        estimator = PolicyEstimator(policies[0] if len(seeds) == 1 else Together(policies), ENV_ID, cell=fit.cell, **OPTIONS)
    model, rows = RecordModel(fit.cell, fit.thermal), []
    for discharge in load_nasa_discharges(tested)[::every]:
        record = discharge.loaded_part(CUT_OFF_V)
        start_s, end_s = record.time_s[[0, -1]]
        for share in (*SHARES, 1.0):
            seen = record if share == 1.0 else record.until(start_s + share * (end_s - start_s))
            estimate = estimator.estimate(seen)
            eod_time_s = model.forecast(seen, estimate, CUT_OFF_V).eod_time_s
            rows.append(
                {
                    "fitted": fitted,
                    "tested": tested,
                    "calibrator": calibrator if len(seeds) < 2 else f"{calibrator}, {len(seeds)} together",
                    "seed": seeds[0] if len(seeds) == 1 else None,
                    "cycle": discharge.meta["cycle"],
                    "capacity_Ah": discharge.meta["capacity_Ah"],
                    "share": share,
                    "q_mobile_C": estimate.q_mobile,
                    "r_o_ohm": estimate.r_o,
                    "settled": estimate.settled,
                    "eod_error_percent": 100.0 * (eod_time_s - end_s) / (end_s - start_s),
                }
            )
    return {"own_cell": pd.DataFrame(rows)}


def with_departure(found: pd.DataFrame) -> pd.DataFrame:
    """
    How far each estimate of ``q_mobile`` is from that of least squares for the whole discharge, which stand for the truth.
    """
    key = ["tested", "cycle"]
    whole = found[(found["calibrator"] == "least squares") & (found["share"] == 1.0)]
    truth = whole.set_index(key)["q_mobile_C"].rename("expected_C")
    joined = found.join(truth, on=key)
    return joined.assign(departure_percent=100.0 * (joined["q_mobile_C"] / joined["expected_C"] - 1.0))


def _over_seeds(rows: pd.DataFrame, column: str, decimals: int) -> str:
    # mean over discharges: of each seed side by side, and the worst of all
    means = rows[column].abs().groupby(rows["seed"].fillna(-1)).mean()
    return f"{' / '.join(f'{mean:.{decimals}f}' for mean in means)} ({rows[column].abs().max():.{decimals - 1}f})"


def summary(found: pd.DataFrame) -> pd.DataFrame:
    """The table for readers."""
    rows = []
    for (tested, calibrator), of_both in with_departure(found).groupby(["tested", "calibrator"], sort=False):
        whole = of_both[of_both["share"] == 1.0]
        mean_C = whole.groupby("cycle")[["q_mobile_C", "capacity_Ah"]].mean()
        row = {
            "tested on": tested,
            "calibrator": calibrator,
            "q^max of whole discharges, departure: mean (worst) (%)": _over_seeds(whole, "departure_percent", 2),
            "corr(q^max, capacity)": f"{mean_C['q_mobile_C'].corr(mean_C['capacity_Ah']):.4f}",
        }
        for share in SHARES:
            at_share = of_both[of_both["share"] == share]
            row[f"end at {100 * share:.0f} %: mean (worst) (%)"] = _over_seeds(at_share, "eod_error_percent", 1)
        rows.append(row)
    return pd.DataFrame(rows)


def plot(found: pd.DataFrame) -> Figure:
    """
    How far ``q_mobile`` of whole discharges is from that of least squares over the life of a cell, and how far off the end of
    discharge is that is predicted on the way.
    """
    names = [name for name in found["calibrator"].unique() if "together" not in name and not name.startswith("the fit")]
    families = list(dict.fromkeys(name.partition(",")[0] for name in names))
    figure = new_figure(10.4, 6.6)
    panels = figure.subplots(2, found["tested"].nunique(), sharey="row", squeeze=False)
    for (upper, lower), (tested, of_cell) in zip(panels.T, with_departure(found).groupby("tested", sort=False), strict=True):
        for name in names:
            family = name.partition(",")[0]
            of_name, colour = of_cell[of_cell["calibrator"] == name], COLOURS[families.index(family)]
            style = "-" if name == family else "--"
            whole = of_name[of_name["share"] == 1.0].groupby("cycle")["departure_percent"].mean()
            upper.plot(whole.index, whole, ls=style, lw=1.2, color=colour)
            in_progress = of_name[of_name["share"] < 1.0]
            errors = in_progress["eod_error_percent"].abs().groupby(in_progress["share"]).mean()
            lower.plot(100.0 * errors.index, errors, "o", ls=style, color=colour, label=name)
        title = f"{tested}, with the constants of {of_cell['fitted'].iloc[0]}"
        upper.set(title=title, xlabel="cycle", ylabel=f"{LABELS['q_mobile'].split(' (')[0]}, from least squares (%)")
        lower.set(yscale="log", xlabel="seen of the discharge (%)", ylabel="mean error of its end (%)", xticks=(25, 50, 75))
        for axes in (upper, lower):
            axes.grid(alpha=0.25)
    figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names), fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("own_cell", __doc__)
    parser.add_argument("--algos", nargs="+", choices=("lac", "sac", "td3"), default=["lac", "sac", "td3"])
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2])
    parser.add_argument("--updates", type=positive, default=5000, help="gradient steps of each training")
    parser.add_argument("--every", type=positive, default=1, help="test on every so manieth discharge (default: all)")
    study = Study(parser, arguments)
    chosen = study.chosen
    study.configuration |= {
        "trained_with": TRAINED_WITH,
        "prior_C": PRIOR_C,
        "kalman_mismatch_V": UNFITTED_MISMATCH_V,
        "data": NASA_CITATION,
    }
    for fitted, _ in PAIRS:
        simulated(fitted_to(fitted), fitted, study.out / "data")  # here, as parts that make the same file meet
    pairs = [{"fitted": fitted, "tested": tested, "every": chosen.every} for fitted, tested in PAIRS]
    alone = [{"calibrator": algo.upper(), "seeds": [seed]} for seed in chosen.seeds for algo in chosen.algos]
    together = [{"calibrator": algo.upper(), "seeds": chosen.seeds} for algo in chosen.algos if len(chosen.seeds) > 1]
    tables = []
    # policies act together when each is trained
    for who in ([{"calibrator": name, "seeds": []} for name in CLASSICAL], alone, together):
        parts = [{**one, "updates": chosen.updates, **pair} for pair in pairs for one in who]
        tables += [study.run(part, parts, folder=study.out)] if parts else []
    found = pd.concat([table["own_cell"] for table in tables], ignore_index=True)
    found = found.sort_values("tested", kind="stable", ignore_index=True)
    study.write({"own_cell": found}, {"own_cell": plot(found)}, markdown(summary(found)))


if __name__ == "__main__":
    main()
