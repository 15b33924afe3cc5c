"""The results of a discharge: one table of columns, with names, units and digits, from which all reports are made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from battery_env.estimates.findings import SETTLED_SHARES, Finding, reason_of
from battery_env.lab.forecast import Forecast, decimals
from battery_env.lab.settings import Settings
from battery_env.records.discharge import Discharge
from battery_env.records.model import VoltageForecast

#: The methods, for readers of a figure.
METHOD_NAMES = {"least-squares": "least squares", "policy": "policy"}
# The columns of the numbers that a verdict is about.
_COLUMN_OF = {"q_mobile": "q_mobile_C", "resistance_10s": "resistance_10s_ohm", "r_o": "r_o_ohm"}


def quantity(text: str = "", unit: str = "", digits: int = 0, scale: float = 1.0) -> Any:
    """A column: its name for readers (a line has the last word of it), its unit, its digits, and the scale to the unit."""
    return field(metadata={"text": text, "unit": unit, "digits": digits, "scale": scale})


@dataclass(frozen=True, repr=False)
class Calibration:
    """
    The calibration of a discharge. ``print`` shows the numbers, :meth:`row` returns the columns by name, and
    ``pd.DataFrame(each.row() for each in calibrations)`` is a table. Names of columns end with units; NaN means unknown.

    :param settings: the settings of this calibration
    :param record: the calibrated record; ``None`` if only the columns are kept
    :param forecast: the voltage of the model at the estimate; ``None`` if only the columns are kept
    :param end: the forecast for a record in progress; otherwise, or if only the columns are kept, ``None``
    """

    settings: Settings = field(compare=False)
    cycle: int | None = quantity("discharge")
    method: str = quantity()
    q_mobile_C: float = quantity("q_max", "Ah", 3, 1.0 / 3600.0)
    sd_q_mobile_C: float = quantity("sd", "Ah", 3, 1.0 / 3600.0)
    resistance_10s_ohm: float = quantity("10 s resistance", "mohm", 1, 1e3)
    sd_resistance_10s_ohm: float = quantity("sd", "mohm", 1, 1e3)
    measured_resistance_10s_ohm: float = quantity("measured", "mohm", 1, 1e3)
    r_o_ohm: float = quantity("R_o", "mohm", 1, 1e3)
    sd_r_o_ohm: float = quantity("sd", "mohm", 1, 1e3)
    settled: bool = quantity("settled")
    settled_q_mobile: bool = quantity("q_max")
    settled_resistance_10s: bool = quantity("10 s resistance")
    settled_r_o: bool = quantity("R_o")
    findings: tuple[Finding, ...] = quantity()
    initial_soc: float = quantity("charge at the start", "%", 1, 100.0)
    sd_initial_soc: float = quantity("sd", "%", 1, 100.0)
    samples: int = quantity("samples")
    load_on_time_s: float = quantity("load-on at", "s", 1)
    drawn_Ah: float = quantity("drawn", "Ah", 3)
    capacity_Ah: float = quantity("capacity", "Ah", 3)
    predicted_capacity_Ah: float = quantity("predicted capacity", "Ah", 3)
    sd_predicted_capacity_Ah: float = quantity("sd", "Ah", 3)
    nominal_Ah: float = quantity("nominal capacity", "Ah", 3)
    state_of_health: float = quantity("state of health", "", 3)
    sd_state_of_health: float = quantity("sd", "", 3)
    voltage_rmse_V: float = quantity("voltage RMSE", "mV", 1, 1e3)
    predicted_eod_time_s: float = quantity("{0.cut_off_V:g} V, predicted at", "s")
    sd_predicted_eod_time_s: float = quantity("sd", "s")
    measured_eod_time_s: float = quantity("{0.cut_off_V:g} V, measured at", "s")
    remaining_s: float = quantity("remaining", "s")
    future_current_A: float = quantity("current to come", "A")
    load_varied: bool = quantity("load varied")
    record: Discharge | None = field(default=None, compare=False)
    forecast: VoltageForecast | None = field(default=None, compare=False)
    end: Forecast | None = field(default=None, compare=False)

    def __str__(self) -> str:
        return text_of(self._name, self)

    def __repr__(self) -> str:
        return f"<{line_of(self._name, self)}>"

    @property
    def _name(self) -> str:
        return "discharge" if self.cycle is None else f"discharge {self.cycle}"

    @property
    def reason(self) -> str:
        """The findings as one text, with remedies."""
        return reason_of(self.findings)

    def row(self) -> dict[str, Any]:
        """Return the columns by name: each finding as a dictionary, and the reason as the last column."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        return columns | {"findings": [asdict(each) for each in self.findings], "reason": self.reason}

    def shown(self, name: str, digits: int | None = None, with_unit: bool = True) -> str:
        """Return a column as text for readers."""
        value, column = getattr(self, name), _COLUMNS[name]
        if isinstance(value, bool):
            return "yes" if value else "no"
        if np.isnan(value):
            return "not known"
        digits = column["digits"] if digits is None else digits
        if column["unit"] in ("Ah", "mohm"):  # more digits for small cells, as many for a standard deviation as for its value
            digits = decimals(column["scale"] * getattr(self, name.removeprefix("sd_")), digits)
        number = f"{column['scale'] * value:.{digits}f}"
        return f"{number} {column['unit']}" if column["unit"] and with_unit else number

    def sd_of(self, name: str) -> str:
        """The standard deviation of a column without its unit, for readers; empty if none is known."""
        sd = f"sd_{name}"
        return self.shown(sd, with_unit=False) if sd in _COLUMNS and not np.isnan(getattr(self, sd)) else ""

    @property
    def settled_alone(self) -> str:
        """Return the name of the only settled number; empty if both numbers are settled, or none."""
        settled = [name for name in ("settled_q_mobile", f"settled_{self.resistance}") if getattr(self, name)]
        return "" if self.settled else "".join(_COLUMNS[name]["text"] for name in settled)

    @property
    def resistance(self) -> str:
        """Which resistance counts, by its name: after ten seconds, or without this one the ohmic resistance of the model."""
        return "r_o" if np.isnan(self.resistance_10s_ohm) else "resistance_10s"

    @property
    def state(self) -> str:
        """What is settled, for readers."""
        return "settled" if self.settled else f"only {self.settled_alone} settled" if self.settled_alone else "not settled"

    @property
    def in_progress(self) -> bool:
        """Whether the record ends above the cut-off."""
        return bool(np.isnan(self.measured_eod_time_s))


_COLUMNS = {each.name: each.metadata for each in fields(Calibration) if each.metadata}
# The columns of a line, with their widths and digits.
_IN_A_LINE = (
    ("q_mobile_C", 8, None),
    ("resistance_10s_ohm", 0, None),
    ("r_o_ohm", 0, None),
    ("drawn_Ah", 0, None),
    ("state_of_health", 0, None),
    ("voltage_rmse_V", 6, 0),
)


def text_of(name: str, calibration: Calibration) -> str:
    """Return a calibration as text for readers."""
    lines = [
        f"{name}: {calibration.samples} samples from load-on at {calibration.shown('load_on_time_s')}, "
        f"{calibration.shown('drawn_Ah')} drawn"
    ]
    if calibration.method != "least-squares":
        lines.append("calibrated by the policy that comes with the package")
    lines.append("")
    for column, remark in _rows_of_text(calibration):
        line = f"  {_COLUMNS[column]['text'].format(calibration.settings.resolved):<22}{calibration.shown(column):>12}"
        lines.append(f"{line}   {remark}" if remark else line)
    if not calibration.settled:
        lines += ["", f"Not settled: {calibration.reason}"]
        if calibration.in_progress and not calibration.settled_q_mobile and calibration.settings.prior_q_mobile_C is None:
            lines.append("Or give the earlier discharges of this cell: battery-calibrate forecast FILE --life FOLDER")
    return "\n".join(lines)


def _rows_of_text(calibration: Calibration) -> Iterator[tuple[str, str]]:
    """The columns of a text in their order, each with a remark."""
    if calibration.initial_soc < 1.0 or calibration.sd_initial_soc:
        yield "initial_soc", f"sd {calibration.shown('sd_initial_soc')}"
    for name, column in _COLUMN_OF.items():
        if np.isnan(getattr(calibration, column)):
            continue
        sd = f"sd {calibration.shown(f'sd_{column}')}" if calibration.sd_of(column) else "no sd stated"
        value, sd_value, limit = getattr(calibration, column), getattr(calibration, f"sd_{column}"), SETTLED_SHARES[name]
        too_wide = f", {sd_value / value:.0%}: settled below {limit:.0%}" if sd_value > limit * value > 0.0 else ""
        measured = f", measured {calibration.shown('measured_resistance_10s_ohm')}" if name == "resistance_10s" else ""
        of_model = ", of the model with its constants" if name != calibration.resistance and name == "r_o" else ""
        yield column, f"{sd}{too_wide}{measured}{of_model}"
    yield "settled", f"only {calibration.settled_alone} is" if calibration.settled_alone else ""
    yield "drawn_Ah", _charge_remark(calibration)
    if not np.isnan(calibration.nominal_Ah):
        yield "state_of_health", _health_remark(calibration)
    yield "voltage_rmse_V", ""
    yield "predicted_eod_time_s", ""
    if calibration.in_progress:
        yield "remaining_s", _load_remark(calibration)
    else:
        yield "measured_eod_time_s", ""


def _charge_remark(calibration: Calibration) -> str:
    cut_off = f"{calibration.settings.resolved.cut_off_V:g} V"
    if calibration.in_progress:
        return "so far"
    if np.isnan(calibration.predicted_capacity_Ah):
        return f"to {cut_off}; not the capacity, as not all of the charge is known"
    if calibration.initial_soc < 1.0:
        return f"to {cut_off}; from full it would have been {calibration.shown('predicted_capacity_Ah')}"
    return f"the capacity to {cut_off}"


def _health_remark(calibration: Calibration) -> str:
    if np.isnan(calibration.state_of_health):
        return "as the capacity is not"
    how = "predicted" if calibration.in_progress or calibration.initial_soc < 1.0 else "drawn"
    of = "" if calibration.settings.nominal_Ah is not None else ", what the given cell yields at this load"
    sd = f"sd {calibration.shown('sd_predicted_capacity_Ah')}"
    return f"{calibration.shown('predicted_capacity_Ah')} ({sd}), {how}, of {calibration.nominal_Ah:.4g} Ah{of}"


def _load_remark(calibration: Calibration) -> str:
    sd = f"sd {calibration.shown('sd_predicted_eod_time_s')}, " if calibration.sd_of("predicted_eod_time_s") else ""
    goes_on = "on average, as so far, an assumption: the load varied" if calibration.load_varied else "to go on"
    return f"{sd}{calibration.future_current_A:.3g} A {goes_on}"


def _numbers(calibration: Calibration) -> list[str]:
    """The columns of a line."""
    texts = []
    for column, width, digits in _IN_A_LINE:
        is_second = column == "r_o_ohm" and calibration.resistance != "r_o"
        if not (np.isnan(getattr(calibration, column)) or is_second):
            sd, label = calibration.sd_of(column), _COLUMNS[column]["text"].split()[-1]
            texts.append(f"{label} {calibration.shown(column, digits):>{width}}" + (f" sd {sd:>3}" if sd else ""))
    return texts


def line_of(name: str, calibration: Calibration) -> str:
    """Return a calibration in one line."""
    verdict = f"{calibration.state}: {calibration.reason}" if calibration.findings else calibration.state
    return f"{name:<18} " + "  ".join([*_numbers(calibration), verdict])


def change_of(first: Calibration, last: Calibration) -> str:
    """Return the change of a cell between two discharges."""
    names = ("q_mobile_C", f"{last.resistance}_ohm")
    return ", ".join(f"{_COLUMNS[each]['text']} {first.shown(each, with_unit=False)} -> {last.shown(each)}" for each in names)


def title_of(name: str, calibration: Calibration) -> str:
    """Return the title of a figure."""
    numbers = ", ".join(" ".join(each.split()) for each in _numbers(calibration))
    return f"{name}: {calibration.state}\n{numbers}"
