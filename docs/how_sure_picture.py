"""
The picture of how sure a number is: what the model misses of discharges of the bundled cell B0005, and what the standard
deviation of q_max is made of while discharge 100 goes on, beside the error that it turned out to have.

.. code-block:: bash

  python -m docs.how_sure_picture
"""

from __future__ import annotations

import numpy as np

from battery_env import LeastSquares, Settings, load_nasa_discharges
from battery_env.electrochemistry.model_error import UNFITTED_ERROR_RATIO
from battery_env.estimates.findings import SETTLED_SHARES
from battery_env.plotting import COLOURS, new_figure, save_figure
from battery_env.records import integrate_load
from docs.environment_pictures import PICTURES

CUT_OFF_V = 2.7


def main() -> None:
    """Write docs/pictures/how_sure.png."""
    discharges = load_nasa_discharges("B0005")
    figure = new_figure(9.0, 3.6)
    voltage, doubt = figure.subplots(1, 2)
    everything = Settings(method="least-squares").calibrator()
    drift_mV = 1e3 * UNFITTED_ERROR_RATIO * everything.mismatch_V
    for number, colour in zip((1, 84, 168), COLOURS, strict=False):
        record = discharges[number - 1].loaded_part(CUT_OFF_V)
        model = everything.model.forecast(record, everything.estimate(record), CUT_OFF_V)
        model_V = np.interp(record.time_s, model.time_s, model.voltage_V)
        charge_C = integrate_load(record.time_s, record.current_A, record.time_s)
        share = charge_C / charge_C[-1]
        voltage.plot(100.0 * share, 1e3 * (record.voltage_V - model_V), color=colour, label=f"discharge {number}")
    voltage.axhspan(-drift_mV, drift_mV, color="0.9", label="drift that is expected (one sd)")
    voltage.set_ylabel("measured - model (mV)")
    voltage.set_xlabel("charge drawn (%)")
    voltage.set_ylim(-200.0, 100.0)
    voltage.legend(frameon=False, fontsize=8, loc="lower left")

    whole = discharges[99].loaded_part(CUT_OFF_V)
    end_q_C = everything.estimate(whole).q_mobile
    calibrators = {
        "all": everything,
        "drift": LeastSquares(thermal=True, mismatch_V=everything.mismatch_V),
        "noise": LeastSquares(thermal=True),
    }
    shares = np.append(np.arange(0.4, 0.9, 0.1), np.arange(0.9, 1.001, 0.02))
    rows = []
    for share in shares:
        seen = whole.until(whole.time_s[0] + share * (whole.time_s[-1] - whole.time_s[0]))
        found = {name: calibrator.estimate(seen) for name, calibrator in calibrators.items()}
        of_all, of_drift, of_noise = (found[name].sd_q_mobile / found[name].q_mobile for name in calibrators)
        gain = everything.current_gain_sd
        constants = np.sqrt(np.clip(of_all**2 - of_drift**2 - gain**2, 0.0, None))
        error = abs(found["all"].q_mobile / end_q_C - 1.0)
        rows.append((of_all, of_drift, constants, gain, of_noise, error))
    names = ("all of it", "drift of the model", "constants of the cell", "gain of the current sensor", "noise")
    for name, colour, column in zip(names, ("black", *COLOURS), np.transpose(rows), strict=False):
        doubt.semilogy(100.0 * shares, 100.0 * column, color=colour, label=name)
    doubt.semilogy(100.0 * shares[:-1], 100.0 * np.transpose(rows)[5][:-1], "x", color="0.4", label="how far off it was")
    doubt.axhline(100.0 * SETTLED_SHARES["q_mobile"], color="0.4", lw=1.0, ls="--")
    doubt.annotate("settled below", (40.0, 110.0 * SETTLED_SHARES["q_mobile"]), fontsize=8)
    doubt.set_ylim(1e-2, 100.0)
    doubt.set_xlabel("seen of the discharge (% of its time)")
    doubt.set_ylabel("standard deviation of q_max (%)")
    doubt.legend(frameon=False, fontsize=8, loc="lower left")
    save_figure(figure, PICTURES / "how_sure.png")
    print(*zip(shares.round(2), np.round(100.0 * np.array(rows), 2).tolist(), strict=True), sep="\n")


if __name__ == "__main__":
    main()
