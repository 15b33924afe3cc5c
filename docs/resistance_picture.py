"""
The picture of the resistance after ten seconds over the lives of both bundled cells, of the fitted model and as measured.

.. code-block:: bash

  python -m docs.resistance_picture
"""

from __future__ import annotations

import numpy as np

from battery_env import calibrate, load_nasa_discharges
from battery_env.plotting import COLOURS, new_figure, save_figure
from docs.environment_pictures import PICTURES

# Every so many discharges, as a meter would be put to a cell now and then.
EVERY = 12


def main() -> None:
    """Write docs/pictures/resistance.png."""
    figure = new_figure(6.4, 3.4)
    axes = figure.subplots()
    for cell, colour in zip(("B0005", "B0006"), COLOURS, strict=False):
        discharges = load_nasa_discharges(cell)[::EVERY]
        found = [calibrate(discharge) for discharge in discharges]
        number = 1 + EVERY * np.arange(len(found))
        model, sd, measured = (
            1e3 * np.array([getattr(each, f"{name}resistance_10s_ohm") for each in found]) for name in ("", "sd_", "measured_")
        )
        axes.errorbar(number, model, sd, color=colour, elinewidth=0.6, lw=1.2, label=f"{cell}, fitted model")
        axes.plot(number, measured, "o", ms=4, mfc="white", mec=colour, label=f"{cell}, measured")
    axes.set(xlabel="discharge", ylabel=r"resistance after ten seconds (m$\Omega$)", ylim=(0.0, None))
    axes.legend(frameon=False, fontsize=8, loc="lower right", ncols=2)
    save_figure(figure, PICTURES / "resistance.png")


if __name__ == "__main__":
    main()
