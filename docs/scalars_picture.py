"""
The picture of the page on TensorBoard that is drawn from event files, as the example of that page writes them.

.. code-block:: bash

  python -m docs.scalars_picture comparison
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from battery_env.plotting import COLOUR_OF, new_figure, save_figure
from docs.environment_pictures import PICTURES

#: Folders of the runs without the number of the seed, by the name that the figure has for them
RUNS = {"LAC": "LAC", "LAC as published": "PublishedLAC", "SAC": "SAC", "TD3": "TD3"}
#: Tag and scale of the vertical axis
PANELS = (
    ("eval/cost_log10", "linear"),
    ("rollout/cost_mean", "log"),
    ("train/critic_loss", "log"),
    ("train/ent_coef", "linear"),
    ("train/lyapunov_difference", "symlog"),
    ("lyapunov/decrease", "symlog"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write docs/pictures/scalars.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what the example had for tensorboard_log")
    folder = parser.parse_args(arguments).folder
    runs = {
        name: [EventAccumulator(str(run)).Reload() for run in sorted(folder.glob(f"{algorithm}_*"))]
        for name, algorithm in RUNS.items()
    }
    figure = new_figure(9.5, 5.2)
    for axes, (tag, scale) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
        for name, seeds in runs.items():
            if all(tag in seed.Tags()["scalars"] for seed in seeds):
                logged = list(zip(*(seed.Scalars(tag) for seed in seeds), strict=True))
                steps = [events[0].step for events in logged]
                values = np.array([[event.value for event in events] for events in logged])
                axes.plot(steps, np.median(values, axis=1), color=COLOUR_OF[name], lw=1.3, label=name)
                axes.fill_between(steps, values.min(axis=1), values.max(axis=1), color=COLOUR_OF[name], alpha=0.2, lw=0)
        axes.set_yscale(scale, **({"linthresh": 0.01} if scale == "symlog" else {}))
        axes.set_title(tag, fontsize=10)
        axes.set_xlabel("step", fontsize=9)
        axes.tick_params(labelsize=8)
        if scale == "symlog":
            axes.axhline(0.0, color="0.4", lw=0.8)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs), frameon=False)
    save_figure(figure, PICTURES / "scalars.png")


if __name__ == "__main__":
    main()
