"""
The forecast of the first page: half an hour of discharge 100 of the bundled cell B0005, what the nine before let expect with
constants that were fitted to three of the first 90, and what was measured later.

.. code-block:: bash

  python -m docs.forecast_picture
"""

from __future__ import annotations

from battery_env import fit_cell, forecast, load_nasa_discharges, track_life
from battery_env.plotting import COLOUR_OF, save_figure
from docs.environment_pictures import PICTURES

CUT_OFF_V, SEEN_S = 2.7, 1800.0


def main() -> None:
    """Write docs/pictures/forecast.png."""
    discharges = load_nasa_discharges("B0005")
    fit = fit_cell([discharges[0], discharges[44], discharges[89]], cut_off_V=CUT_OFF_V)
    life = track_life(discharges[90:99], cut_off_V=CUT_OFF_V, calibrator=fit.calibrator())
    running = discharges[99]
    seen = running.until(SEEN_S).loaded_part(cut_off_V=CUT_OFF_V)
    calibrator = fit.calibrator(prior_q_mobile_C=life.prior_q_mobile_C)
    estimate = calibrator.estimate(seen)
    found = forecast(seen, estimate, cut_off_V=CUT_OFF_V, model=calibrator.model, mismatch_V=fit.mismatch_V)
    figure = found.plot()
    (axes,) = figure.axes
    end_s = running.eod_time_s(CUT_OFF_V)
    later = (running.time_s > found.now_s) & (running.time_s <= end_s)
    axes.plot(running.time_s[later], running.voltage_V[later], ":", color=COLOUR_OF["true"], lw=1.6, label="measured later")
    axes.axvline(found.now_s, color="0.4", lw=1.0, ls="--")
    axes.annotate("seen until here", (found.now_s, 4.0), (-6, 0), textcoords="offset points", ha="right", fontsize=9)
    axes.set_xlim(0.0, end_s + 60.0)
    axes.legend(frameon=False, fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 0.06))
    low_s, median_s, high_s = found.eod_quantile_s()
    print(f"{low_s:.0f} {median_s:.0f} {high_s:.0f} s; measured {end_s:.0f} s; error to expect {1e3 * fit.mismatch_V:.0f} mV")
    save_figure(figure, PICTURES / "forecast.png")


if __name__ == "__main__":
    main()
