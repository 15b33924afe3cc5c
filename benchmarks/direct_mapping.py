"""
Does a policy generalise better than the direct mapping of the paper? Networks that are taught with labels to tell the
parameter from two consecutive states, beside policies that never see a label and the closed form, on held-out discharges, on
loads heavier than those of the training, and on cells more aged than those of the training.

.. code-block:: bash

  python -m benchmarks.direct_mapping
  python -m benchmarks.direct_mapping --algos lac sac td3 --policies-on q_mobile/trajectory q_mobile/parameter

Everything sees the full state of the paper's discharges. A mapping learns from random pairs of random discharges of the
training part; a policy trains on the same part with the settings of ``zoo_configs``. Finished parts are not run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from battery_env.plotting import LABELS, coloured, new_figure
from benchmarks.generalization import (
    DIVISIONS,
    ENV_IDS,
    HEAVY_LOAD_W,
    MAPPINGS,
    Parameter,
    divided,
    exact_part,
    mapping_part,
    policy_part,
)
from benchmarks.study import SYMBOLS, Study, command_line, digits, markdown, natural, positive, with_spread

_TESTED = {"trajectory": "other discharges", "load": "heavier loads", "parameter": "more aged cells"}


def report(results: pd.DataFrame, configuration: Mapping[str, Any]) -> str:
    """What is compared, and the table."""
    rows = []
    for (parameter, division, method), group in results.groupby(["parameter", "division", "method"], sort=False):
        seeds = [of_seed for _, of_seed in group.groupby("seed", dropna=False)]
        bias, spread = (100.0 * group[name] / group["true"] for name in ("bias", "spread"))
        learned = group["seed"].notna().all()
        rows.append(
            {
                "parameter": SYMBOLS[str(parameter)],
                "tested on": _TESTED[str(division)],
                "calibrator": str(method),
                "seeds": str(len(seeds)) if learned else "",
                "MAPE (%)": with_spread(pd.Series([of_seed["mape_percent"].mean() for of_seed in seeds])),
                "worst discharge (%)": digits(group["mape_percent"].max()),
                "bias (%)": f"{bias.mean():+.2g}",
                "spread (%)": digits(spread.mean()),
            }
        )
    text = f"""The paper's data, the full state, trimmed to 5 to 95 % of each discharge. Other discharges: a random 30 %,
trained on the other 70 %. Heavier loads: trained up to 12.8 W, tested above {HEAVY_LOAD_W:g} W. More aged cells: trained on
the 70 % least aged, tested on the others. Mappings learn from {configuration["pairs"]} labelled pairs, shown
{configuration["epochs"]} times each. Errors are means over whole test discharges, ± the standard deviation over seeds;
worst: of any seed; spread: standard deviation within a discharge.

"""
    return text + markdown(rows)


def plot_errors(results: pd.DataFrame) -> Figure:
    """The error of every test discharge."""
    learned = results[results["seed"].notna()]
    methods = list(dict.fromkeys(learned["method"]))
    figure = new_figure(10.4, 5.8)
    panels = figure.subplots(len(ENV_IDS), len(DIVISIONS), sharex="row", sharey="row", squeeze=False)
    for row, parameter in zip(panels, get_args(Parameter), strict=True):
        for axes, division in zip(row, DIVISIONS, strict=True):
            values = getattr(divided(parameter, division)[0], parameter)
            axes.axvspan(values.min(), values.max(), color="0.93", zorder=0, label="values trained on")
            of_panel = learned[(learned["parameter"] == parameter) & (learned["division"] == division)]
            for colour, method in coloured(methods):
                group = of_panel[of_panel["method"] == method]
                axes.plot(group["true"], group["mape_percent"], "o", ms=2.5, mew=0, alpha=0.5, color=colour, label=method)
            axes.set(yscale="log", title=f"{LABELS[parameter].split(' (')[0]}: {_TESTED[division]}")
            axes.set_xlabel(f"true {LABELS[parameter]}")
            axes.grid(which="major", alpha=0.25)
        row[0].set_ylabel("mean error of a discharge (%)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9, markerscale=2.5)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line("direct_mapping", __doc__, jobs=1)
    parser.add_argument("--mappings", nargs="*", default=list(MAPPINGS), choices=list(MAPPINGS), metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=natural, default=[0, 1, 2], help="of the mappings")
    parser.add_argument("--pairs", type=positive, default=12_800, help="labelled pairs that a mapping learns from")
    parser.add_argument("--epochs", type=positive, default=30)
    parser.add_argument("--algos", nargs="*", default=["lac"], choices=["lac", "sac", "td3"], metavar="ALGO", help="policies")
    parser.add_argument("--policy-seeds", nargs="+", type=natural, default=[0])
    parser.add_argument(
        "--policies-on",
        nargs="+",
        default=[f"{parameter}/{division}" for parameter in ENV_IDS for division in ("trajectory", "parameter")],
        choices=[f"{parameter}/{division}" for parameter in ENV_IDS for division in DIVISIONS],
        metavar="PARAMETER/DIVISION",
    )
    parser.add_argument("--updates", type=positive, help="gradient steps of policies; those of zoo_configs by default")
    study = Study(parser, arguments)
    chosen = study.chosen
    places = [{"parameter": parameter, "division": division} for parameter in ENV_IDS for division in DIVISIONS]
    # all of the first seed come first, so that an interrupted study has something of everything
    mappings = [
        {"kind": kind, **place, "seed": seed, "pairs": chosen.pairs, "epochs": chosen.epochs}
        for seed in chosen.seeds
        for kind in chosen.mappings
        for place in places
    ]
    policies = [
        {"algo": algo, **place, "seed": seed, "updates": chosen.updates}
        for seed in chosen.policy_seeds
        for algo in chosen.algos
        for place in places
        if f"{place['parameter']}/{place['division']}" in chosen.policies_on
    ]
    made = [study.run(mapping_part, mappings), study.run(policy_part, policies, models=study.out / "models")]
    made.append(study.run(exact_part, places))
    results = _in_order(pd.concat([tables["direct_mapping"] for tables in made if tables], ignore_index=True))
    text = report(results, study.configuration)
    study.write({"direct_mapping": results}, {"direct_mapping": plot_errors(results)}, text)


def _in_order(results: pd.DataFrame) -> pd.DataFrame:
    # as they were made, but parameter by parameter and division by division; what has no seed is the closed form
    numbered = results.assign(seed=results["seed"].astype(float))
    places = [numbered[name].map(list(names).index) for name, names in (("division", DIVISIONS), ("parameter", ENV_IDS))]
    methods = numbered["method"].map(list(dict.fromkeys(numbered["method"])).index)
    return numbered.iloc[np.lexsort([numbered["seed"], methods, *places])].reset_index(drop=True)


if __name__ == "__main__":
    main()
