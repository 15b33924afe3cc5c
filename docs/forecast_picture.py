"""
The forecast of the first page: half an hour of discharge 100 of the bundled cell B0005, what the nine before let expect, and
what was measured later.

.. code-block:: bash

  python -m docs.forecast_picture
"""

from __future__ import annotations

from battery_env import LeastSquares, forecast, load_nasa_discharges, track_life
from battery_env.plotting import COLOUR_OF, save_figure
from docs.environment_pictures import PICTURES


def main() -> None:
    """Write docs/pictures/forecast.png."""
    *before, running = load_nasa_discharges("B0005")[90:100]
    life = track_life(before, cut_off_V=2.7)
    seen = running.until(1800.0).loaded_part(cut_off_V=2.7)
    fit = LeastSquares(thermal=True, mismatch_V=0.05, prior_q_mobile_C=life.prior_q_mobile_C)
    found = forecast(seen, fit.estimate(seen), cut_off_V=2.7, model=fit.model)
    figure = found.plot()
    (axes,) = figure.axes
    later = (running.time_s > found.now_s) & (running.time_s < running.eod_time_s(2.7) + 60.0)
    axes.plot(running.time_s[later], running.voltage_V[later], ":", color=COLOUR_OF["true"], lw=1.4, label="measured later")
    axes.axvline(found.now_s, color="0.4", lw=1.0, ls="--")
    axes.annotate("seen until here", (found.now_s, 4.0), (-6, 0), textcoords="offset points", ha="right", fontsize=9)
    axes.set_xlim(left=0.0)
    axes.legend(frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 0.06))
    low_s, median_s, high_s = found.eod_quantile_s()
    print(f"{low_s:.0f} {median_s:.0f} {high_s:.0f} s; measured {running.eod_time_s(2.7):.0f} s")
    save_figure(figure, PICTURES / "forecast.png")


if __name__ == "__main__":
    main()
