"""What a record of one discharge says about its cell: estimate, capacity and end of discharge, as one row of a table."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from battery_env.calibration.policy import PolicyEstimator
from battery_env.calibration.pretrained import policy_of_file, pretrained_policy
from battery_env.cells import Discharge
from battery_env.checks import check_positive
from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.electrochemistry.cell import TB
from battery_env.estimates import Estimate
from battery_env.estimators.cell_fit import UNFITTED_MISMATCH_V, CellFit
from battery_env.estimators.gaps import NOT_DRAWN, find_gaps
from battery_env.estimators.kalman import ExtendedKalmanFilter
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.rest import InitialSoc, Start, check_initial_soc, soc_from_rest
from battery_env.estimators.settling import least_resistance_ohm, rest_voltage_V, start_reason
from battery_env.parameters import PARAMETER_NAMES, check_parameters
from battery_env.record_model import RecordModel, VoltageForecast
from battery_env.records import ExpectedCurrent, drawn, expected_current

Method = Literal["least-squares", "kalman", "policy"]
METHODS: tuple[Method, ...] = get_args(Method)

# A record of more samples than this is averaged over the time step of the model, or longer where it lasts longer than so many
# steps: what lies between says nothing to the model.
_MANY_SAMPLES = 100_000
_MODEL_STEP_S = 1.0
_ZERO_CELSIUS_K = 273.15
# What is drawn after the cut-off is worth a word if it is more than this share of what was drawn before.
_MORE_SHARE = 0.2
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
    How a discharge is looked at.

    :param method: of calibration
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
    :param q_mobile_bounds_C: where to search for ``q_mobile``, C; ``None``: where the calibrator does by default
    :param initial_soc: state of charge when the load is switched on, after a rest: a number, (mean, standard deviation), or
        ``"rest"``: told from the voltage of the rest before the load, of a minute at least
    :param policy: ONNX file of the policy that the method ``"policy"`` follows; ``None``: the one that comes with the package.
        Its model is at constant temperature, the new cell's or, of a policy of the user's own, ``cell``; and it takes no prior
    :raises ValueError: for an argument out of range
    """

    method: Method = "least-squares"
    parameters: tuple[str, ...] = PARAMETER_NAMES
    cut_off_V: float = 2.7
    prior_q_mobile_C: tuple[float, float] | None = None
    mismatch_V: float = UNFITTED_MISMATCH_V
    current_gain_sd: float = 0.005
    future_current_A: float | None = None
    thermal: bool = True
    ambient_C: float | None = None
    nominal_Ah: float | None = None
    cell: CellParameters | None = None
    q_mobile_bounds_C: tuple[float, float] | None = None
    initial_soc: InitialSoc | Literal["rest"] = 1.0
    policy: Path | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"the method is {' or '.join(METHODS)}, got {self.method!r}")
        if self.nominal_Ah is not None:
            check_positive("the nominal capacity in Ah", self.nominal_Ah)
        low, high = _AMBIENT_LIMITS_C
        if self.ambient_C is not None and not low <= self.ambient_C <= high:
            raise ValueError(f"the ambient temperature must lie within {low:g} .. {high:g} degC, got {self.ambient_C!r}")
        if not 0.0 < self.cut_off_V < np.inf:
            raise ValueError(f"the cut-off must be a voltage above 0 V, got {self.cut_off_V!r}")
        if self.future_current_A is not None and not 0.0 <= self.future_current_A < np.inf:
            raise ValueError(f"future_current_A must be finite and at least 0 A, got {self.future_current_A!r}")
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
        self.calibrator(self.cell or NEW_CELL)

    @classmethod
    def for_cell(cls, cell: CellFit | CellParameters, **others: Any) -> Settings:
        """Settings that use all that is known of a cell."""
        if isinstance(cell, CellFit):
            known: dict[str, Any] = {"cut_off_V": cell.cell.VEOD}
            if others.get("method") != "policy":
                known |= {
                    "mismatch_V": cell.mismatch_V,
                    "thermal": cell.thermal,
                    "q_mobile_bounds_C": cell.q_mobile_bounds_C,
                }
            others, cell = {**known, **others}, cell.cell
        return cls(**{"cell": cell, **others})

    def calibrator(
        self, cell: CellParameters, start: Start | None = None
    ) -> LeastSquares | ExtendedKalmanFilter | PolicyEstimator:
        """The calibrator that is asked for."""
        if self.method == "policy":
            return self._policy()
        calibrator = LeastSquares if self.method == "least-squares" else ExtendedKalmanFilter
        bounds: dict[str, Any] = {} if self.q_mobile_bounds_C is None else {"q_mobile_bounds_C": self.q_mobile_bounds_C}
        return calibrator(
            self.parameters,
            cell,
            thermal=self.thermal,
            prior_q_mobile_C=self.prior_q_mobile_C,
            mismatch_V=self.mismatch_V,
            current_gain_sd=self.current_gain_sd,
            initial_soc=self._stated_soc if start is None else (start.soc, start.sd_soc),
            **bounds,
        )

    @property
    def _stated_soc(self) -> InitialSoc:
        return 1.0 if self.initial_soc == "rest" else self.initial_soc

    def start_of(self, discharge: Discharge, cell: CellParameters) -> Start:
        """The state of charge that a discharge starts with: the one that is stated, or what its rest tells."""
        if self.initial_soc == "rest":
            return soc_from_rest(discharge, cell, self.mismatch_V)
        return Start(*check_initial_soc(self._stated_soc))

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
            return self.method
        return "the policy that comes with the package" if self.policy is None else f"the policy of {self.policy}"


class Summary(NamedTuple):
    """
    What a discharge says.

    :param row: by column of a table
    :param record: what was looked at
    :param forecast: the voltage of the model at the estimate
    """

    row: dict[str, Any]
    record: Discharge
    forecast: VoltageForecast


def summarize(discharge: Discharge, settings: Settings) -> Summary:
    """
    Calibrate the model to one discharge. Where its start is not known, or the voltage before the load contradicts it, or where
    nothing was drawn though the samples beside say so, its capacity is not known either. Its surroundings, and its temperature
    at the start, are those measured at load-on; a model that departs far from the temperatures measured later is warned of.
    """
    record = discharge.loaded_part(settings.cut_off_V)
    measured_eod_s = discharge.eod_time_s(settings.cut_off_V)
    drawn_Ah = record.charge_C / 3600.0
    _warn_of_more(discharge, measured_eod_s)
    samples, averaged_over_s = len(record.time_s), 0.0
    if samples > _MANY_SAMPLES:
        averaged_over_s = max(_MODEL_STEP_S, float(record.time_s[-1] - record.time_s[0]) / _MANY_SAMPLES)
        record = record.averaged(averaged_over_s)

    ambient_C = _ambient_C(record, settings)
    cell = settings.cell or NEW_CELL
    is_policy = settings.method == "policy"
    if ambient_C is not None and not is_policy:
        cell = cell.replace(Tb0=ambient_C + _ZERO_CELSIUS_K)
    seen = record
    if settings.ambient_C is not None or not settings.thermal:
        # a temperature that is stated, or held, counts more than one that was measured
        discharge, seen = discharge.without_temperature(), record.without_temperature()
    start = settings.start_of(discharge, cell)
    estimate = settings.calibrator(cell, start).estimate(seen)
    if start.reason:
        estimate = replace(estimate, settled=False, reason=start.reason)
    model = RecordModel(cell, settings.thermal and not is_policy, initial_soc=start.soc)
    future = load = expected_current(record.time_s, record.current_A)
    if settings.future_current_A is not None:
        future = ExpectedCurrent(settings.future_current_A, varied=False, sd_A=0.0)
    in_progress = bool(np.isnan(measured_eod_s))
    forecast = model.forecast(record, estimate, settings.cut_off_V, future.mean_A, in_progress)
    columns = (record.time_s, record.voltage_V, record.current_A, forecast.at_samples_V)
    is_logged = all(gap.verdict != NOT_DRAWN for gap in find_gaps(*columns, estimate.q_mobile))
    # what a full cell would have given more, as its end comes at the same charge; not known where the start is not, nor where
    # part of what was drawn is not
    is_known = is_logged and not start.reason and not _starts_lower(discharge, cell, start.soc, estimate)
    missing_Ah = (1.0 - start.soc) * estimate.q_mobile / 3600.0 if is_known else float("nan")
    remaining_s = forecast.eod_time_s - float(record.time_s[-1]) if in_progress else 0.0
    # what comes after the end of a discharge is no part of it
    nominal_Ah = _nominal_Ah(model, settings, future.mean_A if in_progress else load.mean_A)
    whole_Ah = missing_Ah + drawn_Ah + remaining_s * future.mean_A / 3600.0
    sd_eod_s = float(
        np.hypot(
            _sd_charge_s(estimate, remaining_s, future),
            _sd_cut_off_s(model, record, estimate, future.mean_A, settings, in_progress),
        )
    )
    residual_V = forecast.at_samples_V - record.voltage_V
    row = {
        "method": settings.method,
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "r_o_ohm": estimate.r_o,
        "sd_r_o_ohm": estimate.sd_r_o,
        "settled": estimate.settled,
        "reason": estimate.reason,
        "initial_soc": start.soc,
        "sd_initial_soc": start.sd_soc,
        "samples": samples,
        "averaged_over_s": averaged_over_s,
        "load_on_time_s": float(record.time_s[0]),
        "drawn_Ah": drawn_Ah,
        "capacity_Ah": float("nan") if in_progress or start.soc < 1.0 or not is_known else drawn_Ah,
        "predicted_capacity_Ah": whole_Ah,
        "nominal_Ah": nominal_Ah,
        "state_of_health": whole_Ah / nominal_Ah,
        "voltage_rmse_V": float(np.sqrt(np.nanmean(residual_V**2))),
        "predicted_eod_time_s": forecast.eod_time_s,
        "sd_predicted_eod_time_s": sd_eod_s,
        "measured_eod_time_s": measured_eod_s,
        "remaining_s": remaining_s,
        "future_current_A": future.mean_A,
        "load_varied": future.varied,
        "ambient_C": cell.Tb0 - _ZERO_CELSIUS_K,
        **_end_temperatures(record, estimate, model),
    }
    return Summary(row, record, forecast)


def _warn_of_more(discharge: Discharge, eod_time_s: float) -> None:
    if np.isnan(eod_time_s):
        return
    until_C = float(drawn(discharge.time_s, discharge.current_A, eod_time_s))
    more_C = discharge.charge_C - until_C
    if more_C > _MORE_SHARE * until_C:
        warnings.warn(
            f"{more_C / 3600.0:.3f} Ah more are drawn after the cut-off at {eod_time_s:.0f} s, and left aside. If that is "
            "another discharge, give each alone, or number them in a column of the cycle",
            stacklevel=3,
        )


def _starts_lower(discharge: Discharge, cell: CellParameters, soc: float, estimate: Estimate) -> bool:
    """Whether the voltage before the load, or the first one under it, is below that of a cell with this charge."""
    begin = int(np.searchsorted(discharge.time_s, discharge.load_on_time_s, side="right")) - 1
    time_s, voltage_V, current_A = (column[begin:] for column in (discharge.time_s, discharge.voltage_V, discharge.current_A))
    rest_V = rest_voltage_V(cell, soc)
    resistance_ohm = least_resistance_ohm(estimate.q_mobile, estimate.r_o)
    return bool(voltage_V[0] < rest_V and start_reason(time_s, voltage_V, current_A, cell, soc, resistance_ohm))


def _nominal_Ah(model: RecordModel, settings: Settings, load_A: float) -> float:
    if settings.nominal_Ah is not None:
        return settings.nominal_Ah
    if settings.cell is None or not load_A > 0.0:
        return float("nan")
    # the cell is empty by then
    return model.capacity_Ah(load_A, "current", settings.cut_off_V, model.cell.q_mobile / load_A + model.dt_s)


def _ambient_C(record: Discharge, settings: Settings) -> float | None:
    if settings.ambient_C is not None:
        return settings.ambient_C
    if record.temperature_C is not None:
        return float(record.temperature_C[0])
    known = record.meta.get("ambient_temperature_C")
    return None if known is None else float(known)


def _end_temperatures(record: Discharge, estimate: Estimate, model: RecordModel) -> dict[str, float]:
    """The last temperature measured, and the model's then."""
    if record.temperature_C is None:
        return {"end_temperature_C": float("nan"), "model_end_temperature_C": float("nan")}
    since_s, current_A = model.grid(record)
    simulation = model.simulate(current_A, estimate.q_mobile, estimate.r_o)
    model_C = np.interp(since_s, simulation.time_s, simulation.state[:, TB]) - _ZERO_CELSIUS_K
    departure_K = record.temperature_C - model_C
    worst = int(np.abs(departure_K).argmax())
    if abs(departure_K[worst]) > _WARMTH_LIMIT_K:
        warnings.warn(
            f"the cell is at {record.temperature_C[worst]:.0f} degC at {record.time_s[worst]:.0f} s, where the model is at "
            f"{model_C[worst]:.0f} degC: its temperature does not hold for this cell or chamber",
            stacklevel=3,
        )
    return {"end_temperature_C": float(record.temperature_C[-1]), "model_end_temperature_C": float(model_C[-1])}


def _sd_charge_s(estimate: Estimate, remaining_s: float, future: ExpectedCurrent) -> float:
    """The charge still to come moves with q_mobile, and is drawn at a current that may not be the one assumed."""
    if not future.mean_A > 0.0:
        return float("nan")
    return float(np.hypot(estimate.sd_q_mobile, remaining_s * future.sd_A)) / future.mean_A


def _sd_cut_off_s(
    model: RecordModel, record: Discharge, estimate: Estimate, load_A: float, settings: Settings, in_progress: bool
) -> float:
    """Where the model is at the cut-off the cell may be higher or lower, by the error of the model and of the ohmic drop."""
    # a resistance that is held has no standard deviation
    deviation_V = float(np.hypot(settings.mismatch_V, load_A * np.nan_to_num(estimate.sd_r_o)))
    early_s, late_s = (
        model.forecast(record, estimate, settings.cut_off_V + each_V, load_A, in_progress).eod_time_s
        for each_V in (deviation_V, -deviation_V)
    )
    return 0.5 * (late_s - early_s)


def text_of(name: str, row: dict[str, Any], settings: Settings) -> str:
    """A row for reading."""
    in_progress = np.isnan(row["measured_eod_time_s"])
    fitted: Sequence[str] = settings.parameters
    cut_off = f"{settings.cut_off_V:g} V"
    averaged = f", averaged over {row['averaged_over_s']:g} s," if row["averaged_over_s"] else ""
    values = {
        "q_mobile": (f"{row['q_mobile_C']:.0f} C", row["sd_q_mobile_C"], f"sd {row['sd_q_mobile_C']:.0f} C"),
        "r_o": (f"{row['r_o_ohm']:.4f} ohm", row["sd_r_o_ohm"], f"sd {row['sd_r_o_ohm']:.4f} ohm"),
    }
    what = "so far" if in_progress else f"the capacity to {cut_off}"
    if not in_progress and np.isnan(row["predicted_capacity_Ah"]):
        what = f"to {cut_off}; not the capacity, as not all of the charge is known"
    elif row["initial_soc"] < 1.0 and not in_progress:
        what = f"to {cut_off}; from full it would have been {row['predicted_capacity_Ah']:.3f} Ah"
    lines = [
        f"{name}: {row['samples']} samples{averaged} from load-on at {row['load_on_time_s']:.1f} s, "
        f"{3600.0 * row['drawn_Ah']:.0f} C drawn",
        *([f"calibrated by {settings.calibrated_by}"] if settings.method == "policy" else []),
        "",
        *(
            f"  {key:<22}{value:>12}   {('no sd stated' if np.isnan(sd) else text) if key in fitted else 'held'}"
            for key, (value, sd, text) in values.items()
        ),
        f"  {'settled':<22}{'yes' if row['settled'] else 'no':>12}",
        f"  {'drawn':<22}{row['drawn_Ah']:>9.3f} Ah   {what}",
    ]
    if row["initial_soc"] < 1.0 or row["sd_initial_soc"]:
        charge = f"{100.0 * row['initial_soc']:>10.1f} %   sd {100.0 * row['sd_initial_soc']:.1f} %"
        lines.insert(2, f"  {'charge at the start':<22}{charge}")
    if not np.isnan(row["state_of_health"]):
        how = "predicted" if in_progress or row["initial_soc"] < 1.0 else "drawn"
        of = f"{row['predicted_capacity_Ah']:.3f} Ah, {how}, of {row['nominal_Ah']:.4g} Ah"
        if settings.nominal_Ah is None:
            of += ", what the given cell yields at this load"
        lines.append(f"  {'state of health':<22}{row['state_of_health']:>12.3f}   {of}")
    elif not np.isnan(row["nominal_Ah"]):
        lines.append(f"  {'state of health':<22}{'not known':>12}   as the capacity is not")
    lines.append(f"  {'voltage RMSE':<22}{1e3 * row['voltage_rmse_V']:>9.1f} mV")
    if not np.isnan(row["end_temperature_C"]):
        ends = f"from {row['ambient_C']:.1f} degC; the model ends at {row['model_end_temperature_C']:.1f} degC"
        lines.append(f"  {'temperature at the end':<22}{row['end_temperature_C']:>7.1f} degC   {ends}")
    lines.append(f"  {f'{cut_off}, predicted at':<22}{row['predicted_eod_time_s']:>10.0f} s")
    if in_progress:
        sd_s = row["sd_predicted_eod_time_s"]
        sure = "" if "q_mobile" not in fitted or np.isnan(sd_s) else f"sd {sd_s:.0f} s, "
        load = "the mean current so far, an assumption: the load varied" if row["load_varied"] else "to go on"
        lines.append(f"  {'remaining':<22}{row['remaining_s']:>10.0f} s   {sure}{row['future_current_A']:.3g} A {load}")
    else:
        lines.append(f"  {f'{cut_off}, measured at':<22}{row['measured_eod_time_s']:>10.0f} s")
    if not row["settled"]:
        lines += ["", f"Not settled: {row['reason']}"]
        if in_progress and settings.method == "least-squares" and settings.prior_q_mobile_C is None:
            lines += [
                "During a discharge give --prior with the q_mobile of an earlier one of this cell. Without it",
                "--method kalman (in Python ExtendedKalmanFilter) predicts the end better than this fit.",
            ]
    return "\n".join(lines)
