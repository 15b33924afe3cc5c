"""What a discharge says: one table of columns, with their names, units and digits, from which each report follows."""

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
# Columns of the numbers that are judged.
_COLUMN_OF = {"q_mobile": "q_mobile_C", "resistance_10s": "resistance_10s_ohm", "r_o": "r_o_ohm"}


def quantity(text: str = "", unit: str = "", digits: int = 0, scale: float = 1.0) -> Any:
    """
    A column: its name for readers, of which a line has the last word, its unit, digits, and the scale to that unit, and what
    stands for NaN.
    """
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
        columns = {name: getattr(self, name) for name in _HOW}
        return columns | {"findings": [asdict(each) for each in self.findings], "reason": self.reason}

    def shown(self, name: str, digits: int | None = None, with_unit: bool = True) -> str:
        """Return a column as text for readers."""
        value, how = getattr(self, name), _HOW[name]
        if isinstance(value, bool):
            return "yes" if value else "no"
        if np.isnan(value):
            return "not known"
        digits = how["digits"] if digits is None else digits
        if how["unit"] in ("Ah", "mohm"):  # of cells of any size, and a standard deviation as its value
            digits = decimals(how["scale"] * getattr(self, name.removeprefix("sd_")), digits)
        number = f"{how['scale'] * value:.{digits}f}"
        return f"{number} {how['unit']}" if how["unit"] and with_unit else number

    def sd_of(self, name: str) -> str:
        """The standard deviation of a column without its unit, for readers; empty if none is known."""
        sd = f"sd_{name}"
        return self.shown(sd, with_unit=False) if sd in _HOW and not np.isnan(getattr(self, sd)) else ""

    @property
    def settled_alone(self) -> str:
        """The number that is settled though the other one is not; empty if none is."""
        known = [name for name in ("settled_q_mobile", f"settled_{self.resistance}") if getattr(self, name)]
        return "" if self.settled else "".join(_HOW[name]["text"] for name in known)

    @property
    def resistance(self) -> str:
        """Which resistance counts: that after ten seconds, or where there is none that of the model, by its name."""
        return "r_o" if np.isnan(self.resistance_10s_ohm) else "resistance_10s"

    @property
    def state(self) -> str:
        """What is settled, for readers."""
        return "settled" if self.settled else f"only {self.settled_alone} settled" if self.settled_alone else "not settled"

    @property
    def in_progress(self) -> bool:
        """Whether the record ends above the cut-off."""
        return bool(np.isnan(self.measured_eod_time_s))


_HOW = {each.name: each.metadata for each in fields(Calibration) if each.metadata}
# The columns of a line, with their widths and digits.
_IN_A_LINE = (
    ("q_mobile_C", 8, None),
    ("resistance_10s_ohm", 0, None),
    ("r_o_ohm", 0, None),
    ("drawn_Ah", 0, None),
    ("state_of_health", 0, None),
    ("voltage_rmse_V", 6, 0),
)


def text_of(name: str, found: Calibration) -> str:
    """What a discharge says, for reading."""
    lines = [
        f"{name}: {found.samples} samples from load-on at {found.shown('load_on_time_s')}, {found.shown('drawn_Ah')} drawn"
    ]
    if found.method != "least-squares":
        lines.append("calibrated by the policy that comes with the package")
    lines.append("")
    for column, remark in _rows_of_text(found):
        line = f"  {_HOW[column]['text'].format(found.settings.resolved):<22}{found.shown(column):>12}"
        lines.append(f"{line}   {remark}" if remark else line)
    if not found.settled:
        lines += ["", f"Not settled: {found.reason}"]
        if found.in_progress and not found.settled_q_mobile and found.settings.prior_q_mobile_C is None:
            lines.append("Or give the earlier discharges of this cell: battery-calibrate forecast FILE --life FOLDER")
    return "\n".join(lines)


def _rows_of_text(found: Calibration) -> Iterator[tuple[str, str]]:
    """The columns that a text has, in their order, each with a remark."""
    if found.initial_soc < 1.0 or found.sd_initial_soc:
        yield "initial_soc", f"sd {found.shown('sd_initial_soc')}"
    for name, column in _COLUMN_OF.items():
        if np.isnan(getattr(found, column)):
            continue
        sd = f"sd {found.shown(f'sd_{column}')}" if found.sd_of(column) else "no sd stated"
        value, sd_value, needed = getattr(found, column), getattr(found, f"sd_{column}"), SETTLED_SHARES[name]
        too_wide = f", {sd_value / value:.0%}: settled below {needed:.0%}" if sd_value > needed * value > 0.0 else ""
        measured = f", measured {found.shown('measured_resistance_10s_ohm')}" if name == "resistance_10s" else ""
        of_model = ", of the model with its constants" if name != found.resistance and name == "r_o" else ""
        yield column, f"{sd}{too_wide}{measured}{of_model}"
    yield "settled", f"only {found.settled_alone} is" if found.settled_alone else ""
    yield "drawn_Ah", _of_the_charge(found)
    if not np.isnan(found.nominal_Ah):
        yield "state_of_health", _of_the_health(found)
    yield "voltage_rmse_V", ""
    yield "predicted_eod_time_s", ""
    if found.in_progress:
        yield "remaining_s", _of_the_load(found)
    else:
        yield "measured_eod_time_s", ""


def _of_the_charge(found: Calibration) -> str:
    cut_off = f"{found.settings.resolved.cut_off_V:g} V"
    if found.in_progress:
        return "so far"
    if np.isnan(found.predicted_capacity_Ah):
        return f"to {cut_off}; not the capacity, as not all of the charge is known"
    if found.initial_soc < 1.0:
        return f"to {cut_off}; from full it would have been {found.shown('predicted_capacity_Ah')}"
    return f"the capacity to {cut_off}"


def _of_the_health(found: Calibration) -> str:
    if np.isnan(found.state_of_health):
        return "as the capacity is not"
    how = "predicted" if found.in_progress or found.initial_soc < 1.0 else "drawn"
    of = "" if found.settings.nominal_Ah is not None else ", what the given cell yields at this load"
    sd = f"sd {found.shown('sd_predicted_capacity_Ah')}"
    return f"{found.shown('predicted_capacity_Ah')} ({sd}), {how}, of {found.nominal_Ah:.4g} Ah{of}"


def _of_the_load(found: Calibration) -> str:
    sd = f"sd {found.shown('sd_predicted_eod_time_s')}, " if found.sd_of("predicted_eod_time_s") else ""
    goes_on = "on average, as so far, an assumption: the load varied" if found.load_varied else "to go on"
    return f"{sd}{found.future_current_A:.3g} A {goes_on}"


def _numbers(found: Calibration) -> list[str]:
    """The columns of a line."""
    parts = []
    for column, width, digits in _IN_A_LINE:
        is_second = column == "r_o_ohm" and found.resistance != "r_o"
        if not (np.isnan(getattr(found, column)) or is_second):
            sd, label = found.sd_of(column), _HOW[column]["text"].split()[-1]
            parts.append(f"{label} {found.shown(column, digits):>{width}}" + (f" sd {sd:>3}" if sd else ""))
    return parts


def line_of(name: str, found: Calibration) -> str:
    """The same in one line."""
    return f"{name:<18} " + "  ".join([*_numbers(found), f"{found.state}: {found.reason}" if found.findings else found.state])


def change_of(first: Calibration, last: Calibration) -> str:
    """How the numbers of a cell went from one discharge to another."""
    columns = ("q_mobile_C", f"{last.resistance}_ohm")
    return ", ".join(f"{_HOW[each]['text']} {first.shown(each, with_unit=False)} -> {last.shown(each)}" for each in columns)


def title_of(name: str, found: Calibration) -> str:
    """The same above a figure."""
    numbers = ", ".join(" ".join(each.split()) for each in _numbers(found))
    return f"{name}: {found.state}\n{numbers}"
