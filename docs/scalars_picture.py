"""
The pictures of the page on TensorBoard that are drawn from event files, as the example of that page writes them.

.. code-block:: bash

  python -m docs.scalars_picture runs
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from battery_env.plotting import COLOUR_OF, new_figure, save_figure
from docs.environment_pictures import PICTURES

#: Folders of the runs, by the name that the figure has for them
RUNS = {"LAC": "LAC_1", "LAC as published": "PublishedLAC_1", "SAC": "SAC_1", "TD3": "TD3_1"}
#: Tag, title, scale of the vertical axis, and its sign: rewards are shown as costs
PANELS = (
    ("eval/mean_reward", "cost of an evaluation episode", "log", -1.0),
    ("train/critic_loss", "train/critic_loss", "log", 1.0),
    ("train/ent_coef", "train/ent_coef", "log", 1.0),
    ("train/lambda", "train/lambda", "linear", 1.0),
    ("train/lyapunov_difference", "train/lyapunov_difference", "symlog", 1.0),
    ("lyapunov/decrease", "lyapunov/decrease, 95 % band", "symlog", 1.0),
)
_WIDTH_OF_REPORT = 950


def main(arguments: Sequence[str] | None = None) -> None:
    """Write docs/pictures/scalars.png and docs/pictures/lyapunov_report.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="what the example had for tensorboard_log")
    folder = parser.parse_args(arguments).folder
    runs = {name: EventAccumulator(str(folder / run)).Reload() for name, run in RUNS.items()}
    figure = new_figure(9.5, 5.2)
    for axes, (tag, title, scale, sign) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
        for name, run in runs.items():
            tags = run.Tags()["scalars"]
            if tag in tags:
                steps, values = zip(*((event.step, sign * event.value) for event in run.Scalars(tag)), strict=True)
                axes.plot(steps, values, color=COLOUR_OF[name], lw=1.3, label=name)
            if f"{tag}_low" in tags:
                low, high = ([event.value for event in run.Scalars(f"{tag}_{end}")] for end in ("low", "high"))
                axes.fill_between(steps, low, high, color=COLOUR_OF[name], alpha=0.2, lw=0)
        axes.set_yscale(scale, **({"linthresh": 0.01} if scale == "symlog" else {}))
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step", fontsize=9)
        axes.tick_params(labelsize=8)
        if scale == "symlog":
            axes.axhline(0.0, color="0.4", lw=0.8)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs), frameon=False)
    save_figure(figure, PICTURES / "scalars.png")

    report = Image.open(BytesIO(runs["LAC"].Images("lyapunov/report")[-1].encoded_image_string)).convert("RGB")
    report.thumbnail((_WIDTH_OF_REPORT, _WIDTH_OF_REPORT))
    report.quantize(255).save(PICTURES / "lyapunov_report.png", optimize=True)


if __name__ == "__main__":
    main()
