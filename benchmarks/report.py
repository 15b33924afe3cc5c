"""
One page with the errors of all calibrators on held-out discharges: what is typical, how sure that is, and how the errors are
spread. It is made from the raw CSV files of ``docs/results`` alone, and holds its figures; its tables also stand beside it as
Markdown.

.. code-block:: bash

  python -m benchmarks.report --results docs/results --out results/report.html
"""

from __future__ import annotations

import argparse
import base64
import html
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import bootstrap, trim_mean

from battery_env.arrays import FloatArray
from battery_env.parameters import PARAMETER_NAMES
from battery_env.plotting import coloured, new_figure
from benchmarks.study import markdown, write_text

_RESAMPLES = 999

_TITLE = "Errors on held-out discharges"
_HEAD = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{_TITLE}</title>
<style>
body {{ font-family: sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; }}
table {{ border-collapse: collapse; margin: 1em 0; }}
th, td {{ padding: 0.3em 0.8em; border-bottom: 1px solid #ccc; text-align: right; }}
th:first-child, td:first-child {{ text-align: left; }}
img {{ max-width: 100%; }}
.source {{ color: #555; font-size: 85%; }}
</style>
</head>
<body>
<h1>{_TITLE}</h1>
<p>The error of a discharge is the mean absolute error of the estimates during it, or in its second half where the
title says so, in per cent of the true value; where there is no estimate, it is infinite. Mean: over discharges, then
over seeds, &plusmn; the standard deviation over seeds. Interquartile mean: of the half in the middle of the errors of
all seeds and discharges, with the 95 % interval of a bootstrap that resamples the seeds and the discharges of each
calibrator. With one seed the interval says nothing about another training; with two or three it says little. The
figures show which share of the discharges has an error below a value; lines are means over seeds, bands reach from
the least to the largest seed.</p>
"""


def read_errors(results: Path) -> pd.DataFrame:
    """The errors of single discharges in all CSV files of a folder that hold such."""
    tables = []
    for file in sorted(results.rglob("*.csv")):
        columns = set(pd.read_csv(file, nrows=0).columns)
        if "trajectory" not in columns or not columns & {"algo", "calibrator"}:
            continue
        table = pd.read_csv(file).rename(columns={"algo": "calibrator"})
        for name in PARAMETER_NAMES:
            # the estimates of the first half are those of a calibrator that has seen next to nothing
            measures = {f"{name}_second_half_mape_percent": ", second half", f"{name}_mape_percent": ""}
            column = next((measure for measure in measures if measure in columns), None)
            if column is None:
                continue
            # a task with two parameters has a file for each
            title = f"{file.stem.rsplit('_', 1)[0].removesuffix(f'_{name}')}, {name}{measures[column]}"
            # the same discharges under several conditions
            conditions = pd.Series("", index=table.index)
            if "mismatch" in columns:
                conditions += table["mismatch"].map(lambda share: f", constants off by {100 * share:g} %" if share else "")
            if "sensor" in columns:
                conditions += ", " + table["sensor"]
            of_parameter = pd.DataFrame(
                {
                    "source": file.relative_to(results).as_posix(),
                    "comparison": title + conditions,
                    "calibrator": table["calibrator"],
                    # a calibrator that does not learn has none
                    "seed": table["seed"].fillna(0).astype(int) if "seed" in columns else 0,
                    "trajectory": table["trajectory"],
                    "error_percent": table[column],
                }
            )
            tables.append(of_parameter)
    if not tables:
        raise FileNotFoundError(
            f"{results} has no CSV file with errors of discharges (columns trajectory, algo or calibrator, "
            "<parameter>_mape_percent): run python -m benchmarks.compare first"
        )
    return pd.concat(tables, ignore_index=True)


def interquartile_mean(errors: FloatArray, seed: int = 0) -> tuple[float, float, float]:
    """
    Mean of the half in the middle, with a bootstrap interval over seeds and discharges (percentiles). See Agarwal et al. 2021,
    Deep Reinforcement Learning at the Edge of the Statistical Precipice; there every task has runs of its own, here all
    discharges of a seed share its policy, so that seeds are resampled as a whole.
    """
    if errors.ndim != 2 or errors.shape[1] < 2:
        raise ValueError(f"errors must have the shape (seeds, discharges) with at least two discharges, got {errors.shape}")

    def of_resamples(*chosen: np.ndarray, axis: int = -1) -> np.ndarray:
        # shape (..., seeds) and (..., discharges); one seed cannot be resampled
        columns = chosen[-1]
        rows = chosen[0] if len(chosen) == 2 else np.zeros_like(columns[..., :1])
        sample = errors[rows[..., :, np.newaxis], columns[..., np.newaxis, :]]
        return trim_mean(sample.reshape(*sample.shape[:-2], -1), 0.25, axis=axis)

    indices = [np.arange(n) for n in errors.shape if n > 1]
    # scipy also computes a standard error, which infinite errors have none of
    with np.errstate(invalid="ignore"):
        interval = bootstrap(
            indices,
            of_resamples,
            n_resamples=_RESAMPLES,
            batch=100,
            vectorized=True,
            method="percentile",
            random_state=np.random.default_rng(seed),
        ).confidence_interval
    return float(of_resamples(*indices)), float(interval.low), float(interval.high)


def summary(errors: pd.DataFrame) -> pd.DataFrame:
    """What one comparison says."""
    rows = []
    for calibrator, of_calibrator in errors.groupby("calibrator", sort=False):
        matrix = _by_seed(of_calibrator)
        means = matrix.mean(axis=1)
        typical, low, high = interquartile_mean(matrix)
        row = {"calibrator": calibrator, "seeds": matrix.shape[0], "discharges": matrix.shape[1], "mean": means.mean()}
        spread = means.std(ddof=1) if len(means) > 1 and np.isfinite(means).all() else np.nan
        row |= {"sd": spread, "worst": matrix.max()}
        rows.append({**row, "interquartile_mean": typical, "low": low, "high": high})
    return pd.DataFrame(rows)


def profile(errors: FloatArray, thresholds: FloatArray) -> FloatArray:
    """The share of the discharges with an error below each of several values."""
    return (errors[:, :, np.newaxis] < thresholds).mean(axis=1)


def plot_profiles(errors: pd.DataFrame, title: str) -> Figure:
    """Performance profiles: one line per calibrator, with a band from the least to the largest seed."""
    positive = errors["error_percent"][(errors["error_percent"] > 0) & np.isfinite(errors["error_percent"])]
    thresholds = np.geomspace(positive.min(), 1.05 * positive.max(), 200)
    figure = new_figure(6.4, 3.4)
    axes = figure.subplots()
    for colour, (calibrator, of_calibrator) in coloured(errors.groupby("calibrator", sort=False)):
        shares = 100.0 * profile(_by_seed(of_calibrator), thresholds)
        axes.plot(thresholds, shares.mean(axis=0), color=colour, lw=1.5, label=calibrator)
        axes.fill_between(thresholds, shares.min(axis=0), shares.max(axis=0), color=colour, alpha=0.25, lw=0)
    axes.set(xscale="log", xlabel="error (%)", ylabel="discharges with less (%)", ylim=(0, 102))
    axes.set_title(title, fontsize=10)
    axes.grid(which="both", alpha=0.25)
    axes.legend(frameon=False, fontsize=9)
    return figure


def _by_seed(errors: pd.DataFrame) -> FloatArray:
    # shape (seeds, discharges); a discharge without an estimate is not left out
    table = errors.pivot(index="seed", columns="trajectory", values="error_percent")
    return table.fillna(np.inf).to_numpy(dtype=np.float64)


def pages(results: Path) -> tuple[str, str]:
    """The report."""
    page, tables = [_HEAD], [f"# {_TITLE}\n"]
    for (source, comparison), errors in read_errors(results).groupby(["source", "comparison"], sort=False):
        title, table = html.escape(str(comparison)), _shown(summary(errors))
        page.append(f"<h2>{title}</h2>\n<p class='source'>From {html.escape(str(source))}")
        tables.append(f"## {comparison}\n\nFrom {source}")
        record = (results / str(source)).with_suffix(".json")
        if record.exists():
            command = json.loads(record.read_text(encoding="utf-8")).get("command", "")
            page.append(f", made by <code>{html.escape(command)}</code>")
            tables[-1] += f", made by `{command}`"
        page.append(f"</p>\n{table.to_html(index=False, border=0)}\n")
        tables[-1] += f"\n\n{markdown(table)}"
        buffer = io.BytesIO()
        plot_profiles(errors, str(comparison)).savefig(buffer, format="png", dpi="figure")
        image = base64.b64encode(buffer.getvalue()).decode("ascii")
        page.append(f'<img alt="{title}" src="data:image/png;base64,{image}">\n')
    return "".join([*page, "</body>\n</html>\n"]), "\n".join(tables)


def _shown(table: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for row in table.to_dict("records"):
        spread = "" if np.isnan(row["sd"]) else f" ± {row['sd']:.1g}"
        lines.append(
            {
                "calibrator": row["calibrator"],
                "seeds": row["seeds"],
                "discharges": row["discharges"],
                "mean (%)": f"{row['mean']:.2g}{spread}",
                "worst discharge (%)": f"{row['worst']:.2g}",
                "interquartile mean (%)": f"{row['interquartile_mean']:.2g}",
                "95 % interval": f"{row['low']:.2g} to {row['high']:.2g}",
            }
        )
    return pd.DataFrame(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=Path("docs/results"), help="folder with the raw CSV files")
    parser.add_argument("--out", type=Path, default=Path("results/report.html"), help="the page; its tables stand beside it")
    chosen = parser.parse_args(arguments)
    try:
        page, tables = pages(chosen.results)
    except FileNotFoundError as error:
        parser.error(str(error))
    beside = chosen.out.with_suffix(".md")
    write_text(chosen.out, page)
    write_text(beside, tables)
    sys.stdout.write(f"{chosen.out}\n{beside}\n")


if __name__ == "__main__":
    main()
