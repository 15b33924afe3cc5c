"""Fit the constants of a cell to three of its discharges, and use them for another cell of the kind."""

from battery_env import Settings, fit_cell, load_nasa_discharges
from battery_env.plotting import plot_cell_fit, save_figure

discharges = load_nasa_discharges("B0005")
fit = fit_cell([discharges[0], discharges[84], discharges[167]], cut_off_V=2.7)
print(fit.summary())
fit.to_json("my_cell.json")  # CellFit.from_json reads it

# the end of a discharge of the other cell, predicted when half of it is over, with the new cell's constants and with these
record = load_nasa_discharges("B0006")[60].loaded_part(cut_off_V=2.7)
half = record.until(0.5 * (record.time_s[0] + record.time_s[-1]))
for name, calibrator in (("new cell", Settings().calibrator()), ("fitted", fit.calibrator())):
    forecast = calibrator.model.forecast(half, calibrator.estimate(half), cut_off_V=2.7)
    print(f"{name}: end of discharge at {forecast.eod_time_s:.0f} s, measured {record.time_s[-1]:.0f} s")
save_figure(plot_cell_fit(fit, [record]), "my_cell.png")
