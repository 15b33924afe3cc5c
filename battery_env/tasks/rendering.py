"""The picture of a calibration episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from battery_env.parameters import PARAMETERS
from battery_env.tasks.base import CalibrationTask


def draw_frame(history: Sequence[dict[str, Any]], task: CalibrationTask) -> NDArray[np.uint8]:
    """Draw voltage and parameters of cell and model over an episode of a task."""
    figure = Figure(figsize=(6, 4), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    time = task.decision_s * np.arange(1, len(history) + 1)
    labels = {"voltage": "voltage (V)"} | {name: PARAMETERS[name].label for name in task.parameters}
    for axes, (name, label) in zip(figure.subplots(len(labels), 1, sharex=True), labels.items(), strict=True):
        axes.plot(time, [info[name] for info in history], color="0.2", lw=2.5, label="cell")
        axes.plot(time, [info[f"{name}_hat"] for info in history], color="#d55e00", lw=1.2, label="model")
        axes.set(ylabel=label, xlim=(0.0, task.episode_steps * task.decision_s))
        axes.ticklabel_format(useOffset=False)
    axes.set_xlabel("time in the episode (s)")
    axes.legend(loc="best", fontsize="small", frameon=False)
    canvas.draw()
    return np.array(np.asarray(canvas.buffer_rgba())[..., :3])
