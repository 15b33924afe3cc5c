"""Calibrate the model to discharges: estimate, capacity and end of discharge, as numbers and as text."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args, overload

import numpy as np
import pandas as pd

from battery_env.checks import ZERO_CELSIUS_K, check_not_negative, check_positive
from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.electrochemistry.cell import TB
from battery_env.estimates import Estimate
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V, CellFit
from battery_env.estimators.diagnosis.conditions import Condition
from battery_env.estimators.diagnosis.gaps import DRAWN, find_gaps
from battery_env.estimators.diagnosis.rest import InitialSoc, Start, check_initial_soc, soc_from_rest
from battery_env.estimators.diagnosis.samples import start_condition, watched
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.readers.discharges import each_usable
from battery_env.parameters import PARAMETER_NAMES, check_parameters
from battery_env.policies.estimator import PolicyEstimator
from battery_env.policies.pretrained import policy_of_file, pretrained_policy
from battery_env.records import CUT_OFF_V, ExpectedCurrent, Samples, drawn, expected_current, mean_current_A
from battery_env.records.discharge import Discharge
from battery_env.records.model import RecordModel, VoltageForecast

Method = Literal["least-squares", "kalman", "policy"]
METHODS: tuple[Method, ...] = get_args(Method)
#: For readers of a figure.
METHOD_NAMES: dict[str, str] = {"least-squares": "least squares", "kalman": "Kalman filter", "policy": "policy"}

# A record of more samples than this is averaged over the time step of the model, or longer where it lasts longer than so many
# steps: what lies between says nothing to the model.
_MANY_SAMPLES = 100_000
_MODEL_STEP_S = 1.0
# What is drawn after the cut-off is worth a word if it is more than this share of what was drawn before.
_MORE_SHARE = 0.2
# Constants that were fitted at one load moved q_mobile by 5 % at twice that load, and so by less than the 2 % of a settled
# estimate within this ratio.
_SAME_LOAD = 1.25
# Without a load for longer than this a discharge is over, or pauses.
_REST_S = 60.0
_AMBIENT_LIMITS_C = (-60.0, 100.0)
# The model of a cell in air warms by 2 K at 2 A, where the bundled cells warm by 16 K: that alone moves q_mobile by less than
# 0.1 %. What is farther off than this is another cell, load or chamber than these.
_WARMTH_LIMIT_K = 20.0
# Policies that come with the package, by what they find.
_PRETRAINED = {
    frozenset({"q_mobile"}): "BatteryVoltageQmax-v0",
    frozenset({"r_o"}): "BatteryVoltageRo-v0",
    frozenset(PARAMETER_NAMES): "BatteryVoltageJoint-v0",
}
# What a policy cannot be told: it has learned on one model.
_NOT_FOR_POLICIES = (
    "prior_q_mobile_C",
    "mismatch_V",
    "current_gain_sd",
    "ambient_C",
    "q_mobile_bounds_C",
    "initial_soc",
)


@dataclass(frozen=True)
class Settings:
    """
    How a discharge of a real cell is looked at. ``Settings().calibrator()`` is least squares, and
    ``Settings(method="kalman").calibrator()`` the filter, with what such a cell needs.

    :param method: of calibration; ``None``: least squares; and where they do not settle a record in progress at a constant
        load that goes on, of a cell of which neither a prior nor the constants are known, the filter
    :param parameters: which to search for; the other is held at the cell's value
    :param cut_off_V: voltage at which the discharge ends, V
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before the discharge, C; ``None``: nothing is known
    :param mismatch_V: error to expect of the model itself, V
    :param current_gain_sd: standard deviation of the gain of the current sensor, as a share of it
    :param future_current_A: current beyond the end of a record, A; ``None``: as
        :func:`battery_env.records.expected_current` has it
    :param thermal: whether the temperature of the model moves
    :param ambient_C: temperature at the start and of the surroundings, degC; ``None``: the first one measured, or what
        else the record says of its surroundings, or the cell's
    :param nominal_Ah: nominal capacity, which the state of health refers to, Ah; ``None``: the charge that ``cell``, with its
        own ``q_mobile`` and ``r_o``, gives from full at the current of the discharge, or not known if there is no ``cell``
    :param cell: constants of the model; ``None``: those of a new 18650
    :param cell_currents_A: lowest and highest mean current that these constants were fitted to, A: beyond them by more than a
        quarter no estimate is settled, and no nominal capacity is told. ``None``: they hold for all
    :param q_mobile_bounds_C: where to search for ``q_mobile``, C; ``None``: where the calibrator does by default
    :param initial_soc: state of charge when the load is switched on, after a rest: a number, (mean, standard deviation), or
        ``"rest"``: told from the voltage of the rest before the load, of a minute at least
    :param policy: ONNX file of the policy that the method ``"policy"`` follows; ``None``: the one that comes with the package.
        Its model is at constant temperature, the new cell's or, of a policy of the user's own, ``cell``; and it takes no prior
    :raises ValueError: for an argument out of range, and for what a policy cannot be told. What the calibrators refuse they
        refuse when :meth:`calibrator` makes them
    """

    method: Method | None = None
    parameters: tuple[str, ...] = PARAMETER_NAMES
    cut_off_V: float = CUT_OFF_V
    prior_q_mobile_C: tuple[float, float] | None = None
    mismatch_V: float = UNFITTED_MISMATCH_V
    current_gain_sd: float = 0.005
    future_current_A: float | None = None
    thermal: bool = True
    ambient_C: float | None = None
    nominal_Ah: float | None = None
    cell: CellParameters | None = None
    cell_currents_A: tuple[float, float] | None = None
    q_mobile_bounds_C: tuple[float, float] | None = None
    initial_soc: InitialSoc | Literal["rest"] = 1.0
    policy: Path | None = None

    def __post_init__(self) -> None:
        if self.method not in (None, *METHODS):
            raise ValueError(f"the method is {' or '.join(METHODS)}, got {self.method!r}")
        if self.nominal_Ah is not None:
            check_positive("the nominal capacity in Ah", self.nominal_Ah)
        low, high = _AMBIENT_LIMITS_C
        if self.ambient_C is not None and not low <= self.ambient_C <= high:
            raise ValueError(f"the ambient temperature must lie within {low:g} .. {high:g} degC, got {self.ambient_C!r}")
        if not 0.0 < self.cut_off_V < np.inf:
            raise ValueError(f"the cut-off must be a voltage above 0 V, got {self.cut_off_V!r}")
        if self.future_current_A is not None:
            check_not_negative(future_current_A=self.future_current_A)
        if self.method == "policy":
            defaults = {field.name: field.default for field in fields(self)}
            for name in _NOT_FOR_POLICIES:
                if getattr(self, name) != defaults[name]:
                    raise ValueError(f"a policy takes no {name}: leave it out, or take another method")
            if self.cell is not None and self.policy is None:
                raise ValueError(
                    "the policy that comes with the package takes no cell: it has learned on a new 18650. Take another "
                    "method, or a policy of your own that was trained with these constants"
                )
        elif self.policy is not None:
            raise ValueError(f"a policy is for the method policy, got {self.method!r}")

    @classmethod
    def for_cell(cls, cell: CellFit | CellParameters | None = None, **others: Any) -> Settings:
        """
        Settings that use all that is known of a cell.

        :param cell: what ``fit_cell`` found; or the constants alone
        :param others: further settings, which replace what the fit knows
        :return: the settings
        """
        if isinstance(cell, CellFit):
            known: dict[str, Any] = {"cut_off_V": cell.cell.VEOD}
            if others.get("method") != "policy":
                known |= {
                    "mismatch_V": cell.mismatch_V,
                    "thermal": cell.thermal,
                    "cell_currents_A": cell.currents_A,
                    "q_mobile_bounds_C": cell.q_mobile_bounds_C,
                }
            others, cell = {**known, **others}, cell.cell
        return cls(**{"cell": cell, **others})

    def other_load(self, current_A: float) -> str:
        """Why the constants may not hold for a mean current; empty if they do."""
        if self.cell_currents_A is None or not current_A > 0.0:
            return ""
        low_A, high_A = self.cell_currents_A
        if low_A / _SAME_LOAD <= current_A <= high_A * _SAME_LOAD:
            return ""
        fitted = f"{low_A:.3g}" if low_A == high_A else f"{low_A:.3g} to {high_A:.3g}"
        return Condition.OTHER_LOAD.said({"load_A": current_A, "fitted": fitted})

    def tells_new_capacity(self, current_A: float) -> bool:
        """Whether the constants tell what a new cell yields under a load: where they were fitted to this load alone."""
        low_A, high_A = self.cell_currents_A or (current_A, current_A)
        return self.cell is not None and high_A <= low_A * _SAME_LOAD and not self.other_load(current_A)

    def methods(self, goes_on: bool) -> list[Method]:
        """What to calibrate a record by: the first one that settles it, or the last; ``goes_on``: a constant load does."""
        if self.method is not None:
            return [self.method]
        # under other loads the filter, which takes the error of the model for noise, is surer than it may be
        is_new = self.prior_q_mobile_C is None and self.cell is None and self.future_current_A is None
        return ["least-squares", "kalman"] if goes_on and is_new else ["least-squares"]

    def calibrator(
        self, cell: CellParameters | None = None, start: Start | None = None
    ) -> LeastSquares | ExtendedKalmanFilter | PolicyEstimator:
        """
        The calibrator that is asked for. It refuses options that it cannot use, and a policy that does not suit them.

        :param cell: constants of the model at the temperature of a discharge; ``None``: those of the settings
        :param start: how the discharge starts; ``None``: as the settings say
        :return: the calibrator
        :raises ValueError: for an option out of range, or a policy of another cell or of other parameters
        """
        if self.method == "policy":
            return self._policy()
        calibrator = ExtendedKalmanFilter if self.method == "kalman" else LeastSquares
        stated: InitialSoc = 1.0 if self.initial_soc == "rest" else self.initial_soc
        bounds: dict[str, Any] = {} if self.q_mobile_bounds_C is None else {"q_mobile_bounds_C": self.q_mobile_bounds_C}
        return calibrator(
            self.parameters,
            cell or self.cell or NEW_CELL,
            thermal=self.thermal,
            prior_q_mobile_C=self.prior_q_mobile_C,
            mismatch_V=self.mismatch_V,
            current_gain_sd=self.current_gain_sd,
            initial_soc=stated if start is None else (start.soc, start.sd_soc),
            **bounds,
        )

    def _policy(self) -> PolicyEstimator:
        if self.policy is None:
            env_id = _PRETRAINED[frozenset(check_parameters(self.parameters))]
            policy, options = pretrained_policy(env_id, recorded=True)
        else:
            policy, options = policy_of_file(self.policy)
            env_id = policy.env_id
            if options.get("cell") != self.cell:
                raise ValueError(
                    f"{self.policy} has learned on "
                    + (
                        "the constants of a cell, which are others: give its cell (--cell)"
                        if "cell" in options
                        else "a new 18650, or the file beside it does not say on which constants ('cell' of its 'options')"
                    )
                )
        estimator = PolicyEstimator(policy, env_id, **options)
        if set(estimator.parameters) != set(self.parameters):
            asked, found = " and ".join(self.parameters), " and ".join(estimator.parameters)
            raise ValueError(f"{self.policy} is a policy of {env_id}, which finds {found}, not {asked}")
        return estimator

    @property
    def calibrated_by(self) -> str:
        """The calibrator, for readers."""
        if self.method != "policy":
            return self.method or "least-squares"
        return "the policy that comes with the package" if self.policy is None else f"the policy of {self.policy}"


def quantity(text: str = "", unit: str = "", digits: int = 0, scale: float = 1.0) -> Any:
    """A column of the table of estimates: its name and unit for readers, digits, and the scale to that unit."""
    return field(metadata={"text": text, "unit": f" {unit}" if unit else "", "digits": digits, "scale": scale})


@dataclass(frozen=True, repr=False)
class Calibration:
    """
    What a discharge says. ``print`` shows it, :meth:`row` gives its columns, and a table of many is
    ``pd.DataFrame(each.row() for each in found)``. Names of columns end with units; NaN stands for what is not known.

    :param settings: how it was looked at
    :param record: what was looked at; ``None`` where only the columns are kept
    :param forecast: the voltage of the model at the estimate; likewise
    """

    settings: Settings = field(compare=False)
    cycle: int | None = quantity("discharge")
    method: str = quantity()
    q_mobile_C: float = quantity("q_mobile", "C")
    sd_q_mobile_C: float = quantity("sd", "C")
    r_o_ohm: float = quantity("r_o", "ohm", 4)
    sd_r_o_ohm: float = quantity("sd", "ohm", 4)
    settled: bool = quantity("settled")
    reason: str = quantity("Not settled")
    initial_soc: float = quantity("charge at the start", "%", 1, 100.0)
    sd_initial_soc: float = quantity("sd", "%", 1, 100.0)
    samples: int = quantity("samples")
    averaged_over_s: float = quantity("averaged over", "s")
    load_on_time_s: float = quantity("load-on at", "s", 1)
    drawn_Ah: float = quantity("drawn", "Ah", 3)
    capacity_Ah: float = quantity("capacity", "Ah", 3)
    predicted_capacity_Ah: float = quantity("predicted capacity", "Ah", 3)
    sd_predicted_capacity_Ah: float = quantity("sd", "Ah", 3)
    nominal_Ah: float = quantity("nominal capacity", "Ah", 3)
    state_of_health: float = quantity("state of health", "", 3)
    sd_state_of_health: float = quantity("sd", "", 3)
    voltage_rmse_V: float = quantity("voltage RMSE", "mV", 1, 1e3)
    predicted_eod_time_s: float = quantity("predicted at", "s")
    sd_predicted_eod_time_s: float = quantity("sd", "s")
    measured_eod_time_s: float = quantity("measured at", "s")
    remaining_s: float = quantity("remaining", "s")
    future_current_A: float = quantity("current to come", "A")
    load_varied: bool = quantity("load varied")
    ambient_C: float = quantity("temperature at the start", "degC", 1)
    end_temperature_C: float = quantity("temperature at the end", "degC", 1)
    model_end_temperature_C: float = quantity("temperature of the model at the end", "degC", 1)
    record: Discharge | None = field(default=None, compare=False)
    forecast: VoltageForecast | None = field(default=None, compare=False)

    def __str__(self) -> str:
        return text_of(self._name, self)

    def __repr__(self) -> str:
        return f"<{line_of(self._name, self)}>"

    @property
    def _name(self) -> str:
        return "discharge" if self.cycle is None else f"discharge {self.cycle}"

    def row(self) -> dict[str, Any]:
        """The columns by name."""
        return {each.name: getattr(self, each.name) for each in fields(self) if each.metadata}

    def shown(self, name: str, digits: int | None = None) -> str:
        """A column with its unit, for readers."""
        how = _HOW[name]
        return f"{how['scale'] * getattr(self, name):.{how['digits'] if digits is None else digits}f}{how['unit']}"

    @property
    def in_progress(self) -> bool:
        """Whether the record ends above the cut-off."""
        return bool(np.isnan(self.measured_eod_time_s))

    @property
    def end_quantiles_s(self) -> tuple[float, float, float] | None:
        """Of a record in progress, the 5 %, 50 % and 95 % quantiles of its end, s."""
        if not self.in_progress:
            return None
        reach_s = 1.645 * self.sd_predicted_eod_time_s
        return self.predicted_eod_time_s - reach_s, self.predicted_eod_time_s, self.predicted_eod_time_s + reach_s


_HOW = {each.name: each.metadata for each in fields(Calibration)}


@overload
def calibrate(source: Discharge, settings: Settings | None = None, **options: Any) -> Calibration: ...


@overload
def calibrate(
    source: pd.DataFrame | str | Path,
    settings: Settings | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
    ignore: Collection[str] = (),
    **options: Any,
) -> list[Calibration]: ...


def calibrate(
    source: Discharge | pd.DataFrame | str | Path,
    settings: Settings | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    discharge_is_negative: bool | None = None,
    ignore: Collection[str] = (),
    **options: Any,
) -> Calibration | list[Calibration]:
    """
    Calibrate the model to recorded discharges, as the command line does.

    .. code-block:: python

      for found in battery_env.calibrate("life.csv", method="kalman", nominal_Ah=2.0):
          print(found)

    Where the start of a discharge is not known, or the voltage before the load contradicts it, where a sensor fails, or where
    nothing was drawn though the samples beside say so, its capacity is not known either. Its surroundings, and its temperature
    at the start, are those measured at load-on; a model that departs far from the temperatures measured later is warned of.

    :param source: one discharge, whole or in progress; or a table or a file of them, see
        :func:`battery_env.read_discharges`
    :param settings: how to look at them; ``None``: as ``options`` say
    :param columns: of a table or a file, as ``read_discharges`` takes it
    :param units: likewise
    :param discharge_is_negative: likewise
    :param ignore: likewise
    :param options: of :class:`Settings`, by name; ``cell`` may be what ``fit_cell`` found
    :return: what a discharge says; of a table or a file a list, in which those that cannot be used are left out with a warning
    :raises ValueError: if none can be used
    """
    settings = Settings.for_cell(**options) if settings is None else replace(settings, **options)
    if isinstance(source, Discharge):
        return _calibrated(source, settings)
    file_format = FileFormat(columns, units, discharge_is_negative, ignore)
    return each_usable(lambda each: _calibrated(each, settings), source, file_format)


def _calibrated(discharge: Discharge, settings: Settings) -> Calibration:
    """What one discharge says."""
    loaded, measured_eod_s = discharge.loaded_part(settings.cut_off_V), discharge.eod_time_s(settings.cut_off_V)
    in_progress = bool(np.isnan(measured_eod_s))
    more_C = _charge_after(discharge, loaded, measured_eod_s, settings.cut_off_V)
    record, averaged_over_s = _of_few_samples(loaded)
    cell = _cell_at_the_temperature(record, settings)
    discharge = _with_the_temperature_that_counts(discharge, settings)
    start = _start(discharge, settings, cell)
    load = expected_current(record.time_s, record.current_A)
    estimate, method = _estimate(record, settings, cell, start, in_progress and not load.varied)
    model = RecordModel(cell, settings.thermal and settings.method != "policy", initial_soc=start.soc)
    stated_A = settings.future_current_A
    future = load if stated_A is None else ExpectedCurrent(stated_A, varied=False, sd_A=0.0)
    forecast = model.forecast(record, estimate, settings.cut_off_V, future.mean_A, in_progress)
    is_known = not start.reason and not more_C and _is_all_logged(discharge, record, forecast, cell, start.soc, estimate)
    drawn_Ah = loaded.charge_C / 3600.0
    remaining_s = forecast.eod_time_s - float(record.time_s[-1]) if in_progress else 0.0
    # what a full cell would have given more, as its end comes at the same charge
    missing_Ah = (1.0 - start.soc) * estimate.q_mobile / 3600.0 if is_known else float("nan")
    whole_Ah = missing_Ah + drawn_Ah + remaining_s * future.mean_A / 3600.0
    # what comes after the end of a discharge is no part of it
    nominal_Ah = _nominal_Ah(model, settings, future.mean_A if in_progress else load.mean_A)
    end_C, model_end_C = _end_temperatures(record, forecast)
    sd_eod_s = _sd_eod_s(forecast, estimate, remaining_s, future, settings.mismatch_V)
    sd_seen_Ah = sd_eod_s * future.mean_A / 3600.0 if in_progress else settings.current_gain_sd * drawn_Ah
    sd_whole_Ah = float(np.hypot(sd_seen_Ah, start.sd_soc * estimate.q_mobile / 3600.0)) if is_known else float("nan")
    return Calibration(
        cycle=discharge.meta.get("cycle"),
        method=method,
        q_mobile_C=estimate.q_mobile,
        sd_q_mobile_C=estimate.sd_q_mobile,
        r_o_ohm=estimate.r_o,
        sd_r_o_ohm=estimate.sd_r_o,
        settled=estimate.settled,
        reason=estimate.reason,
        initial_soc=start.soc,
        sd_initial_soc=start.sd_soc,
        samples=len(loaded.time_s),
        averaged_over_s=averaged_over_s,
        load_on_time_s=float(record.time_s[0]),
        drawn_Ah=drawn_Ah,
        capacity_Ah=float("nan") if in_progress or start.soc < 1.0 or not is_known else drawn_Ah,
        predicted_capacity_Ah=whole_Ah,
        sd_predicted_capacity_Ah=sd_whole_Ah,
        nominal_Ah=nominal_Ah,
        state_of_health=whole_Ah / nominal_Ah,
        sd_state_of_health=sd_whole_Ah / nominal_Ah,
        voltage_rmse_V=float(np.sqrt(np.nanmean((forecast.at_samples_V - record.voltage_V) ** 2))),
        predicted_eod_time_s=forecast.eod_time_s,
        sd_predicted_eod_time_s=sd_eod_s,
        measured_eod_time_s=measured_eod_s,
        remaining_s=remaining_s,
        future_current_A=future.mean_A,
        load_varied=future.varied,
        ambient_C=cell.Tb0 - ZERO_CELSIUS_K,
        end_temperature_C=end_C,
        model_end_temperature_C=model_end_C,
        settings=settings,
        record=record,
        forecast=forecast,
    )


def _estimate(
    record: Discharge, settings: Settings, cell: CellParameters, start: Start, goes_on: bool
) -> tuple[Estimate, Method]:
    """The estimate of the first method that settles the discharge, or of the last one; and which it is."""
    for method in settings.methods(goes_on):
        calibrator = replace(settings, method=method).calibrator(cell, start)
        estimate = calibrator.estimate(_with_the_temperature_that_counts(record, settings))
        if estimate.settled:
            break
    if reason := start.reason or settings.other_load(mean_current_A(record)):
        estimate = replace(estimate, settled=False, reason=reason)
    return estimate, method


def _of_few_samples(record: Discharge) -> tuple[Discharge, float]:
    """A record of more than 100,000 samples is averaged over the step of the model or longer; over how long, s."""
    if len(record.time_s) <= _MANY_SAMPLES:
        return record, 0.0
    stretch_s = max(_MODEL_STEP_S, float(record.time_s[-1] - record.time_s[0]) / _MANY_SAMPLES)
    return record.averaged(stretch_s), stretch_s


def _with_the_temperature_that_counts(record: Discharge, settings: Settings) -> Discharge:
    """A temperature that is stated, or held, counts more than one that was measured."""
    if settings.ambient_C is None and settings.thermal:
        return record
    return record.without_temperature()


def _cell_at_the_temperature(record: Discharge, settings: Settings) -> CellParameters:
    """The constants of the model in the surroundings that are stated, measured at load-on, or known of the record."""
    cell, ambient_C = settings.cell or NEW_CELL, settings.ambient_C
    if ambient_C is None and record.temperature_C is not None:
        ambient_C = float(record.temperature_C[0])
    elif ambient_C is None:
        ambient_C = record.meta.get("ambient_temperature_C")
    if ambient_C is None or settings.method == "policy":
        return cell
    return cell.replace(Tb0=float(ambient_C) + ZERO_CELSIUS_K)


def _start(discharge: Discharge, settings: Settings, cell: CellParameters) -> Start:
    """The state of charge that a discharge starts with: stated, or told from its rest."""
    if settings.initial_soc == "rest":
        return soc_from_rest(discharge, cell, settings.mismatch_V)
    return Start(*check_initial_soc(settings.initial_soc))


def _charge_after(discharge: Discharge, loaded: Discharge, eod_time_s: float, cut_off_V: float) -> float:
    """What is drawn after the cut-off, if that is more than a discharge leaves behind: then it was not the end."""
    if np.isnan(eod_time_s):
        if discharge.time_s[-1] - loaded.time_s[-1] > _REST_S:
            warnings.warn(
                f"the load ends at {loaded.voltage_V[-1]:.4g} V, above the cut-off of {cut_off_V:g} V, so that the capacity "
                "is not known: if the cell was discharged no further, state cut_off_V (--cut-off)",
                stacklevel=4,
            )
        return 0.0
    until_C = float(drawn(discharge.time_s, discharge.current_A, eod_time_s))
    more_C = discharge.charge_C - until_C
    if more_C <= _MORE_SHARE * until_C:
        return 0.0
    warnings.warn(
        f"{more_C / 3600.0:.3f} Ah more are drawn after the cut-off at {eod_time_s:.0f} s, and left aside. If that is "
        "another discharge, give each alone, or number them in a column of the cycle; if a pulse fell below it, state a lower "
        "cut_off_V (--cut-off)",
        stacklevel=4,
    )
    return more_C


def _is_all_logged(
    discharge: Discharge,
    record: Discharge,
    forecast: VoltageForecast,
    cell: CellParameters,
    soc: float,
    estimate: Estimate,
) -> bool:
    """
    Whether all that was drawn is in the record: the cell starts, before or under the load, no lower than with this charge, no
    sensor fails, and the voltage says of each gap that its charge was drawn.
    """
    begin = int(np.searchsorted(discharge.time_s, discharge.load_on_time_s, side="right")) - 1
    end = int(np.searchsorted(discharge.time_s, record.time_s[-1], side="right"))
    columns = (discharge.time_s, discharge.voltage_V, discharge.current_A)
    seen = watched(Samples(*(column[begin:end] for column in columns)), cell, soc, estimate.q_mobile, estimate.r_o)
    is_lower = seen["start"]["first_V"] < seen["start_V"]
    if seen["fault"]["condition"] or (is_lower and start_condition(seen, estimate.q_mobile, estimate.r_o)):
        return False
    gaps = find_gaps(record.time_s, record.voltage_V, record.current_A, forecast.at_samples_V, estimate.q_mobile)
    return all(gap.verdict == DRAWN for gap in gaps)


def _nominal_Ah(model: RecordModel, settings: Settings, load_A: float) -> float:
    if settings.nominal_Ah is not None:
        return settings.nominal_Ah
    if not load_A > 0.0 or not settings.tells_new_capacity(load_A):
        return float("nan")
    # the cell is empty by then
    return model.capacity_Ah(load_A, "current", settings.cut_off_V, model.cell.q_mobile / load_A + model.dt_s)


def _end_temperatures(record: Discharge, forecast: VoltageForecast) -> tuple[float, float]:
    """The last temperature measured, and the model's then; NaN if none was."""
    if record.temperature_C is None:
        return float("nan"), float("nan")
    model_K = forecast.simulation.state[:, TB]
    steps_s = forecast.simulation.dt_s * np.arange(len(model_K))
    model_C = np.interp(record.time_s - record.time_s[0], steps_s, model_K) - ZERO_CELSIUS_K
    departure_K = record.temperature_C - model_C
    worst = int(np.abs(departure_K).argmax())
    if abs(departure_K[worst]) > _WARMTH_LIMIT_K:
        warnings.warn(
            f"the cell is at {record.temperature_C[worst]:.0f} degC at {record.time_s[worst]:.0f} s, where the model is at "
            f"{model_C[worst]:.0f} degC: its temperature does not hold for this cell or chamber",
            stacklevel=4,
        )
    return float(record.temperature_C[-1]), float(model_C[-1])


def _sd_eod_s(
    forecast: VoltageForecast, estimate: Estimate, remaining_s: float, future: ExpectedCurrent, mismatch_V: float
) -> float:
    """
    How sure the predicted end is. The charge still to come moves with q_mobile, and is drawn at a current that may not be the
    one assumed. Where the model is at the cut-off the cell may be higher or lower, by the error of the model and of the ohmic
    drop; a resistance that is held has no standard deviation.
    """
    if not future.mean_A > 0.0:
        return float("nan")
    charge_s = float(np.hypot(estimate.sd_q_mobile, remaining_s * future.sd_A)) / future.mean_A
    deviation_V = float(np.hypot(mismatch_V, future.mean_A * np.nan_to_num(estimate.sd_r_o)))
    early_s, late_s = (forecast.reached_s(forecast.cut_off_V + each_V) for each_V in (deviation_V, -deviation_V))
    return float(np.hypot(charge_s, 0.5 * (late_s - early_s)))


def text_of(name: str, found: Calibration) -> str:
    """What a discharge says, for reading."""
    averaged = f", averaged over {found.averaged_over_s:g} s," if found.averaged_over_s else ""
    lines = [
        f"{name}: {found.samples} samples{averaged} from load-on at {found.shown('load_on_time_s')}, "
        f"{3600.0 * found.drawn_Ah:.0f} C drawn"
    ]
    if found.method != "least-squares":
        by = found.settings.calibrated_by if found.method == "policy" else "the Kalman filter"
        lines.append(f"calibrated by {by}")
    lines.append("")

    def add(column: str, remark: str = "", label: str = "", value: str = "") -> None:
        """A line of a table: name, value with its unit, remark."""
        line = f"  {label or _HOW[column]['text']:<22}{value or found.shown(column):>12}"
        lines.append(f"{line}   {remark}" if remark else line)

    if found.initial_soc < 1.0 or found.sd_initial_soc:
        add("initial_soc", f"sd {found.shown('sd_initial_soc')}")
    for column, parameter in (("q_mobile_C", "q_mobile"), ("r_o_ohm", "r_o")):
        sd = "no sd stated" if np.isnan(getattr(found, f"sd_{column}")) else f"sd {found.shown(f'sd_{column}')}"
        add(column, sd if parameter in found.settings.parameters else "held")
    add("settled", value="yes" if found.settled else "no")
    add("drawn_Ah", _of_the_charge(found))
    if not np.isnan(found.nominal_Ah):
        known = not np.isnan(found.state_of_health)
        add("state_of_health", _of_the_health(found), value="" if known else "not known")
    add("voltage_rmse_V")
    if not np.isnan(found.end_temperature_C):
        model = f"{found.shown('ambient_C')} to {found.shown('model_end_temperature_C')}"
        add("end_temperature_C", f"measured; the model goes from {model}")
    for column in ("predicted_eod_time_s", "remaining_s" if found.in_progress else "measured_eod_time_s"):
        is_end = column != "remaining_s"
        label = f"{found.settings.cut_off_V:g} V, {_HOW[column]['text']}" if is_end else ""
        add(column, "" if is_end else _of_the_load(found), label)
    if not found.settled:
        lines += ["", f"Not settled: {found.reason}"]
        if found.in_progress and found.settings.prior_q_mobile_C is None:
            lines += [
                "During a discharge give --prior with the q_mobile of an earlier one, or the earlier ones themselves:",
                "battery-calibrate forecast FILE --life FOLDER",
            ]
    return "\n".join(lines)


def _of_the_charge(found: Calibration) -> str:
    cut_off = f"{found.settings.cut_off_V:g} V"
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
    is_sure = "q_mobile" in found.settings.parameters and not np.isnan(found.sd_predicted_eod_time_s)
    sd = f"sd {found.shown('sd_predicted_eod_time_s')}, " if is_sure else ""
    goes_on = "the mean current so far, an assumption: the load varied" if found.load_varied else "to go on"
    return f"{sd}{found.future_current_A:.3g} A {goes_on}"


def line_of(name: str, found: Calibration) -> str:
    """The same in one line."""
    sd_q_mobile = "" if np.isnan(found.sd_q_mobile_C) else f" sd {found.sd_q_mobile_C:3.0f}"
    sd_r_o = "" if np.isnan(found.sd_r_o_ohm) else f" sd {found.sd_r_o_ohm:.4f}"
    known = not np.isnan(found.state_of_health)
    health = f"  health {found.shown('state_of_health')} sd {found.shown('sd_state_of_health')}" if known else ""
    return (
        f"{name:<18} q_mobile {found.shown('q_mobile_C'):>7}{sd_q_mobile}  r_o {found.shown('r_o_ohm')}{sd_r_o}  "
        f"drawn {found.shown('drawn_Ah')}{health}  RMSE {found.shown('voltage_rmse_V', 0):>6}  "
        f"{'settled' if found.settled else 'not settled: ' + found.reason}"
    )


def title_of(name: str, found: Calibration) -> str:
    """The same above a figure."""
    parts = []
    for symbol, column, unit in (("$q^{max}$", "q_mobile_C", "C"), ("$R_o$", "r_o_ohm", "$\\Omega$")):
        value, sd = (found.shown(each).split()[0] for each in (column, f"sd_{column}"))
        spread = " (held)" if sd == "nan" else f" (sd {sd})"
        # a policy states none
        parts.append(f"{symbol} {value} {unit}" + ("" if found.method == "policy" else spread))
    state = "settled" if found.settled else "not settled"
    rmse = f"RMSE {found.shown('voltage_rmse_V', 0)}"
    return f"{name}: {state}\n" + ", ".join([*parts, f"{found.shown('drawn_Ah')} drawn", rmse])
