"""Calibrate the model to discharges: :func:`cut` the record, :func:`estimate` the cell, :func:`predict` the end."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import hypot, nan, sqrt
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
import pandas as pd
from typing_extensions import Unpack

from battery_env.arrays import FloatArray
from battery_env.checks import ZERO_CELSIUS_K, check_options
from battery_env.electrochemistry import CellParameters
from battery_env.electrochemistry.ends import quantile
from battery_env.estimates import Estimate, Finding
from battery_env.estimates.findings import Doubt, Reason
from battery_env.estimators.diagnosis.evidence import Evidence, evidence_of
from battery_env.estimators.diagnosis.rest import Start, check_initial_soc, soc_from_rest
from battery_env.estimators.resistance import measured_resistance_ohm
from battery_env.lab.forecast import Forecast, forecast
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.readers.discharges import map_usable, read_recordings
from battery_env.lab.readers.testers import Tester, find_tester
from battery_env.lab.report import Calibration
from battery_env.lab.settings import Settings, SettingsOptions
from battery_env.lab.sources import find_sources, read_source
from battery_env.loads import Load, LoadToCome, constant
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.records import (
    STEADY_S,
    ExpectedCurrent,
    Samples,
    expected_current,
    history_of,
    integrate_load,
    mean_current_A,
)
from battery_env.records.discharge import Discharge
from battery_env.records.model import ModelError, RecordModel, VoltageForecast

# A record of more samples than this is averaged over the time step of the model, or over longer steps if the record has more
# than this many of them: the model has no use for samples in between.
_MANY_SAMPLES = 100_000
# A charge after the cut-off is a warning above this share of the charge before.
_AFTER_SHARE = 0.2
# A search has ended at a bound if its result is within this share of the bound.
_AT_BOUND = 1e-3
# The smallest cell of the model, with a resistance that lets its voltage fall most.
_SMALLEST = Estimate(min(Q_MOBILE.limits), max(R_O.limits), settled=False)
# Half of the interval that holds 90 % of a normal distribution, in standard deviations.
_BAND_SD = 1.645


class Options(SettingsOptions, total=False):
    """Keywords of :func:`calibrate`: those of :class:`Settings`, and of :func:`battery_env.read_discharges`."""

    columns: Mapping[str, str] | None
    units: Mapping[str, str] | None
    discharge_is_negative: bool | None
    ignore: Collection[str]
    tester: str | Path | Tester | None


@overload
def calibrate(source: Discharge, settings: Settings | None = None, **options: Unpack[SettingsOptions]) -> Calibration: ...


@overload
def calibrate(
    source: pd.DataFrame | str | Path, settings: Settings | None = None, **options: Unpack[Options]
) -> list[Calibration]: ...


def calibrate(
    source: Discharge | pd.DataFrame | str | Path, settings: Settings | None = None, **options: Any
) -> Calibration | list[Calibration]:
    """
    Calibrate the model to recorded discharges, like the command ``battery-calibrate``.

    .. code-block:: python

      for calibration in battery_env.calibrate("life.csv", nominal_Ah=2.0):
          print(calibration)

    The capacity is unknown if the start of a discharge is unknown or contradicted by the voltage before the load, if a sensor
    fails, or if no charge was drawn although the samples around say so. The model's surroundings and first temperature are
    the temperature measured at the start of the load.

    :param source: one discharge, whole or in progress; a table or a file of discharges, see
        :func:`battery_env.read_discharges`; or a folder, ``"life.csv:2"``, or a bundled cell, such as ``"B0005:100"``
    :param settings: how to calibrate; ``None``: only ``options``
    :param options: options of :class:`Settings`, by name: ``cut_off_V``, ``nominal_Ah``, ``initial_soc``, ``cell``, ...; for
        tables and files also the options of ``read_discharges``
    :return: the calibration of a discharge; for other sources a list without unusable discharges, which warnings name
    :raises ValueError: if no discharge can be used
    :raises TypeError: for an unknown option
    """
    names = (SettingsOptions if isinstance(source, Discharge) else Options).__annotations__
    check_options("calibrate", options, names)
    of_file = {name: options.pop(name) for name in options.keys() - SettingsOptions.__annotations__.keys()}
    settings = (Settings() if settings is None else settings).but(**options)
    if isinstance(source, Discharge):
        return calibrated(source, settings)
    file_format = FileFormat(**of_file | {"tester": find_tester(of_file.get("tester"))})
    sources = find_sources([os.fspath(source)]) if isinstance(source, str | os.PathLike) else []
    readers = {each.argument: partial(read_source, each, file_format) for each in sources}
    return map_usable(
        lambda each: calibrated(each, settings), readers or {"DataFrame": partial(read_recordings, source, file_format)}
    )


class LoadedPart(NamedTuple):
    """A discharge, cut to its part under load by :func:`cut`."""

    settings: Settings  # with the model error to expect under this load
    discharge: Discharge  # the whole one
    part: Discharge  # from the start of the load to the cut-off
    record: Discharge  # the same, averaged if it has very many samples
    eod_time_s: float  # NaN: the record ends above the cut-off
    charge_after_C: float  # drawn after the cut-off, 0 unless that is much
    cell: CellParameters  # at the temperature of the record
    start: Start
    load: ExpectedCurrent

    @property
    def in_progress(self) -> bool:
        """Whether the record ends above the cut-off."""
        return bool(np.isnan(self.eod_time_s))

    @property
    def notes(self) -> Iterator[str]:
        """Cautions about the end of the discharge."""
        if self.in_progress and self.discharge.time_s[-1] - self.part.time_s[-1] > STEADY_S:
            yield (
                f"the load ends at {self.part.voltage_V[-1]:.4g} V, above the cut-off of "
                f"{self.settings.resolved.cut_off_V:g} V, so that the capacity is not known: if the cell was discharged no "
                "further, state cut_off_V (--cut-off)"
            )
        if self.charge_after_C:
            yield (
                f"{self.charge_after_C / 3600.0:.3f} Ah more are drawn after the cut-off at {self.eod_time_s:.0f} s, and left "
                "aside. If that is another discharge, give each alone, or number them in a column of the cycle; if a pulse "
                "fell below it, state a lower cut_off_V (--cut-off)"
            )


class Fit(NamedTuple):
    """The model, fitted to a discharge by :func:`estimate`."""

    estimate: Estimate
    reported: Estimate  # the same, without numbers if the search has ended at a bound
    model: RecordModel
    voltage: VoltageForecast
    evidence: Evidence

    @property
    def notes(self) -> Iterator[str]:
        """Cautions about samples that the estimate leaves out."""
        if dropouts := self.evidence.dropouts:
            first_s, count = float(self.voltage.simulation.time_s[0]) + dropouts[0].begin_s, len(dropouts)
            when = f"at {first_s:.0f} s" if count == 1 else f"{count} times, first at {first_s:.0f} s"
            yield (
                f"the current changes for a moment {when}, and the voltage does not follow: the voltages there are left out. "
                "Check the current sensor and its logger"
            )


def calibrated(discharge: Discharge, settings: Settings) -> Calibration:
    """Calibrate one discharge; if it is in progress, predict its end if possible."""
    loaded = cut(discharge, settings)
    fit, end = estimate(loaded), None
    if loaded.in_progress and np.isfinite(fit.reported.q_mobile):  # a cell of unknown size has no end
        with suppress(ValueError):
            end = predict(loaded, fit)
    return calibration_of(loaded, fit, end)


def cut(discharge: Discharge, settings: Settings) -> LoadedPart:
    """Cut a discharge to its part under load, and determine how that starts."""
    resolved = settings.resolved
    eod_time_s, part = discharge.eod_time_s(resolved.cut_off_V), discharge.loaded_part(resolved.cut_off_V)
    record = part
    if len(part.time_s) > _MANY_SAMPLES:
        record = part.averaged(max(RecordModel().dt_s, float(part.time_s[-1] - part.time_s[0]) / _MANY_SAMPLES))
    constants = settings.constants_in_progress if np.isnan(eod_time_s) else settings.constants
    cell = _at_the_temperature(constants, record, settings)
    if settings.initial_soc == "rest":
        measured = discharge if resolved.thermal else discharge.without_temperature()
        start = soc_from_rest(measured, cell, resolved.mismatch_V)
    else:
        soc, sd_soc = check_initial_soc(settings.initial_soc)
        start = Start(soc, sd_soc)
    loaded = LoadedPart(
        settings=settings.expecting(record.current_A),
        discharge=discharge,
        part=part,
        record=record,
        eod_time_s=eod_time_s,
        charge_after_C=_charge_after_C(discharge, eod_time_s),
        cell=cell,
        start=start,
        load=expected_current(record.time_s, record.current_A),
    )
    _warn(loaded.notes)
    return loaded


def estimate(loaded: LoadedPart, fixes_constants: bool = False) -> Fit:
    """
    Fit the model to a discharge by the method of its settings, and collect the evidence against that. Fixed constants carry
    over with the parameters, but age: the resistance after ten seconds is always that of free ones.
    """
    settings, record, start, cell = loaded.settings, loaded.record, loaded.start, loaded.cell
    resolved, thermal = settings.resolved, settings.resolved.thermal
    calibrator = settings.calibrator(cell, start, settings.size if loaded.in_progress else None)
    if isinstance(calibrator, PolicyEstimator):
        cell, thermal = calibrator.cell, False
    model = RecordModel(cell, thermal, initial_soc=start.soc)
    if _is_below_all_sizes(loaded):
        result = _SMALLEST
    else:
        # a temperature that the model holds is that of the settings, whatever was measured
        fitted = record if resolved.thermal else record.without_temperature()
        result = calibrator.estimate(fitted)
        if fixes_constants:
            fixed = replace(settings, cell_rates_sd={}).calibrator(cell, start)
            result = _with_resistance_of(result, fixed.estimate(fitted))
    if doubts := start.findings or settings.other_load(mean_current_A(record)):
        # doubts about the charge leave the resistance settled, which may be off by 30 %
        result = replace(result, settled_q_mobile=False, findings=(*result.findings, *doubts))
    if other_size := settings.other_size(result, float(loaded.part.charge_C)):
        # the scale of the current is in question, and all numbers with it
        result = replace(result, settled=False, settled_q_mobile=False, settled_r_o=False, settled_resistance_10s=False)
        result = replace(result, findings=(*other_size, *result.findings))
    # a discharge in progress has not ended, even if the voltage of the model was below the cut-off in a pulse
    cut_off_V, current_A = (-np.inf, 0.0) if loaded.in_progress else (resolved.cut_off_V, loaded.load.mean_A)
    voltage = model.forecast(record, result, cut_off_V, current_A)
    history, parameters = history_of(record, resolved.usual_start), (result.q_mobile, result.r_o)
    evidence = evidence_of(Samples.of(record), loaded.cell, start.soc, parameters, history, voltage.at_samples_V)
    fit = Fit(result, _of_its_size(result, loaded), model, voltage, evidence)
    _warn(fit.notes)
    return fit


def _warn(notes: Iterable[str]) -> None:
    """Warn the caller of :func:`calibrate` or ``forecast_end``, which call the steps through one more function."""
    for note in notes:
        warnings.warn(note, stacklevel=5)


def predict(
    loaded: LoadedPart,
    fit: Fit,
    load: LoadToCome | None = None,
    samples: int = 1000,
    model_error: ModelError | None = None,
) -> Forecast:
    """
    Predict the end of a discharge from the end of its record on, under a load (``None``: as so far), with what the model
    missed over an earlier discharge, and will miss again.
    """
    if _is_below_all_sizes(loaded):
        raise ValueError(Reason.BELOW_ALL_SIZES.text)
    settings, cut_off_V, result = loaded.settings, loaded.settings.resolved.cut_off_V, fit.estimate
    if settings.prior_q_mobile_C is None and settings.fit is not None:
        result = result.within(*settings.fit.life_q_mobile_C)
    record = Samples.of(loaded.record)
    end = forecast(
        record if model_error is None else model_error.removed_from(record, result.q_mobile),
        _in_units_of_the_sensor(result, settings.current_gain_sd),
        load,
        cut_off_V,
        model=fit.model,
        mismatch_V=settings.resolved.mismatch_V,
        nominal_Ah=settings.nominal_Ah,
        samples=samples,
    )
    if model_error is not None:
        drawn_C = loaded.part.charge_C + loaded.load.mean_A * (end.time_s - end.now_s)
        error_V = np.where(end.voltage_V > cut_off_V, model_error.at(drawn_C, result.q_mobile), 0.0)
        end = replace(end, voltage_V=np.maximum(end.voltage_V + error_V, cut_off_V))
    # independent of the draws of the forecast, whose seed is 0
    gains = 1.0 + settings.current_gain_sd * np.random.default_rng([0, 1]).standard_normal(samples)
    load_A = loaded.load.mean_A if load is None else _largest_A(load, cut_off_V)
    # a cell without a known capacity when new has no health
    has_health = settings.nominal_Ah is not None or settings.tells_new_capacity(load_A)
    return replace(
        end,
        record=record,
        q_mobile=gains * end.q_mobile,
        capacity_Ah=gains * end.capacity_Ah,
        r_o=end.r_o / gains,
        resistance_10s_ohm=end.resistance_10s_ohm / gains,
        nominal_Ah=end.nominal_Ah if has_health else nan,
        notes=(*end.notes, *_notes(loaded, fit, load_A)),
    )


def calibration_of(loaded: LoadedPart, fit: Fit, end: Forecast | None) -> Calibration:
    """Return the results of the three steps as columns."""
    result = fit.reported
    end_s, sd_end_s = (fit.voltage.eod_time_s, nan) if end is None else _middle(end.eod_time_s, fit.estimate)
    return Calibration(
        settings=loaded.settings,
        cycle=loaded.discharge.meta.get("cycle"),
        method=loaded.settings.method or "least-squares",
        q_mobile_C=result.q_mobile,
        sd_q_mobile_C=result.sd_q_mobile,
        measured_resistance_10s_ohm=measured_resistance_ohm(loaded.part, loaded.part.starts_at_rest),
        r_o_ohm=result.r_o,
        sd_r_o_ohm=result.sd_r_o,
        resistance_10s_ohm=result.resistance_10s_ohm,
        sd_resistance_10s_ohm=result.sd_resistance_10s_ohm,
        settled=result.settled,
        settled_q_mobile=result.settled_q_mobile,
        settled_resistance_10s=result.settled_resistance_10s,
        settled_r_o=result.settled_r_o,
        findings=result.findings,
        initial_soc=loaded.start.soc,
        sd_initial_soc=loaded.start.sd_soc,
        samples=len(loaded.part.time_s),
        load_on_time_s=float(loaded.record.time_s[0]),
        **_charge(loaded, fit, end),
        voltage_rmse_V=_rmse_V(loaded, fit),
        predicted_eod_time_s=end_s,
        sd_predicted_eod_time_s=sd_end_s,
        measured_eod_time_s=loaded.eod_time_s,
        remaining_s=end_s - float(loaded.record.time_s[-1]) if loaded.in_progress else 0.0,
        future_current_A=loaded.load.mean_A,
        load_varied=loaded.load.is_varying,
        record=loaded.record,
        forecast=fit.voltage,
        end=end,
    )


def _charge_after_C(discharge: Discharge, eod_time_s: float) -> float:
    """Return the charge drawn after the cut-off, C; 0 for as little as a discharge may leave behind."""
    if np.isnan(eod_time_s):
        return 0.0
    until_C, in_all_C = integrate_load(discharge.time_s, discharge.current_A, [eod_time_s, discharge.time_s[-1]]).tolist()
    after_C = in_all_C - until_C
    return after_C if after_C > _AFTER_SHARE * until_C else 0.0


def _at_the_temperature(cell: CellParameters, record: Discharge, settings: Settings) -> CellParameters:
    """Return constants at the temperature at the start of the load; those of a path and of a policy hold at one alone."""
    ambient_C = record.meta.get("ambient_temperature_C")
    if record.temperature_C is not None:
        ambient_C = record.temperature_C[0]
    if ambient_C is None or settings.method == "policy" or settings.path is not None:
        return cell
    return cell.replace(Tb0=float(ambient_C) + ZERO_CELSIUS_K)


def _is_below_all_sizes(loaded: LoadedPart) -> bool:
    """Return whether even the smallest cell of the model ends above a record, so that a search of minutes is useless."""
    if loaded.part.charge_C > _SMALLEST.q_mobile:
        return False
    model = RecordModel(loaded.cell, initial_soc=loaded.start.soc)
    voltage = model.forecast(loaded.record, _SMALLEST, cut_off_V=-np.inf, future_current_A=0.0)
    return bool(voltage.at_samples_V[-1] > loaded.record.voltage_V[-1])


def _with_resistance_of(free: Estimate, fixed: Estimate) -> Estimate:
    """Return the estimate with fixed constants, but for its resistance after ten seconds."""
    name = "resistance_10s"
    findings = [each for each in fixed.findings if each.number != name] + [
        each for each in free.findings if each.number == name
    ]
    return replace(
        fixed,
        resistance_10s_ohm=free.resistance_10s_ohm,
        sd_resistance_10s_ohm=free.sd_resistance_10s_ohm,
        settled_resistance_10s=free.settled_resistance_10s,
        settled=True,  # if both numbers are: Estimate sees to it
        findings=tuple(findings),
    )


def _in_units_of_the_sensor(result: Estimate, gain_sd: float) -> Estimate:
    """Remove the gain of the current sensor, which cancels from an end: the load to come is what the sensor will read."""
    left_C2, left_ohm2 = (
        max(sd**2 - (gain_sd * value) ** 2, 0.0)
        for value, sd in ((result.q_mobile, result.sd_q_mobile), (result.r_o, result.sd_r_o))
    )
    return replace(result, sd_q_mobile=sqrt(left_C2), sd_r_o=sqrt(left_ohm2))


def _largest_A(load: LoadToCome, cut_off_V: float) -> float:
    """Return the largest current of a load to come, of a power at the cut-off; 0 if it is unknown."""
    if isinstance(load, Load):
        return float(load.value.max()) / (1.0 if load.unit == "current" else cut_off_V)
    return float(load) if isinstance(load, Real) else 0.0


def _notes(loaded: LoadedPart, fit: Fit, load_A: float) -> Iterator[str]:
    """The assumptions of a forecast, beyond those of :func:`forecast`."""
    settings, end_s, rmse_V = loaded.settings, float(loaded.record.time_s[-1]), _rmse_V(loaded, fit)
    # the load so far may be of the same finding
    yield from (str(each) for each in settings.other_load(load_A) if each not in fit.estimate.findings)
    if float(loaded.discharge.time_s[-1]) > end_s:
        yield f"What was recorded after the last sample under load, at {end_s:.0f} s, is left out."
    if settings.size is not None and not settings.size.is_stated and settings.method != "policy":
        yield "A cell of some 2 Ah is expected: of another one give the nominal capacity, the life, q_max or constants."
    if rmse_V > settings.resolved.mismatch_V:
        text = f"The model misses the voltage by {1e3 * rmse_V:.0f} mV (RMSE), more than mismatch_V."
        yield f"{text} Other loads make the interval too narrow."


def _rmse_V(loaded: LoadedPart, fit: Fit) -> float:
    return float(np.sqrt(np.nanmean((fit.voltage.at_samples_V - loaded.record.voltage_V) ** 2)))


def _of_its_size(result: Estimate, loaded: LoadedPart) -> Estimate:
    """Remove the numbers if the search has ended at a bound, as for a cell of far another size: a bound is no result."""
    (low_C, high_C), near = loaded.settings.q_mobile_bounds_C, 1.0 - _AT_BOUND
    if low_C < near * result.q_mobile < near**2 * high_C:
        return result
    numbers = ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "resistance_10s_ohm", "sd_resistance_10s_ohm")
    unknown: dict[str, Any] = dict.fromkeys(numbers, nan)
    is_small = loaded.part.charge_C < _SMALLEST.q_mobile
    return replace(result, **unknown, findings=(Finding.of(Reason.BELOW_ALL_SIZES),) if is_small else result.findings)


def _charge(loaded: LoadedPart, fit: Fit, end: Forecast | None) -> dict[str, Any]:
    """The columns of the charge drawn, and of the capacity from full: a full cell ends at the same charge left."""
    drawn_Ah, start, q_mobile = loaded.part.charge_C / 3600.0, loaded.start, fit.estimate.q_mobile
    capacity_Ah = drawn_Ah if start.soc == 1.0 and not loaded.in_progress else nan
    predicted_Ah, sd_Ah = (1.0 - start.soc) * q_mobile / 3600.0 + drawn_Ah, loaded.settings.current_gain_sd * drawn_Ah
    if loaded.in_progress:
        predicted_Ah, sd_Ah = (nan, nan) if end is None else _middle(end.capacity_Ah, fit.estimate)
    unseen_Ah = hypot(loaded.part.sd_charge_C, fit.evidence.charges_C[Doubt.DROPPED]) / 3600.0
    sd_Ah = hypot(sd_Ah, start.sd_soc * q_mobile / 3600.0, unseen_Ah)
    if start.findings or loaded.charge_after_C or not _is_all_logged(loaded, fit.evidence):
        capacity_Ah = predicted_Ah = sd_Ah = nan
    nominal_Ah = _nominal_Ah(loaded, fit.model)
    return {
        "drawn_Ah": drawn_Ah,
        "capacity_Ah": capacity_Ah,
        "predicted_capacity_Ah": predicted_Ah,
        "sd_predicted_capacity_Ah": sd_Ah,
        "nominal_Ah": nominal_Ah,
        "state_of_health": predicted_Ah / nominal_Ah,
        "sd_state_of_health": sd_Ah / nominal_Ah,
    }


def _is_all_logged(loaded: LoadedPart, evidence: Evidence) -> bool:
    """Return whether the record has all charge drawn: no less at its start, by the voltage, no fault and no doubtful gap."""
    # a charge with a tapered current fills any cell, at any voltage at rest
    charge = loaded.record.history.charge
    is_lower = evidence.first_V < evidence.start_V and not (charge and charge.is_tapered)
    return not (evidence.fault or (is_lower and evidence.start) or evidence.charges_C[Doubt.GAP])


def _nominal_Ah(loaded: LoadedPart, model: RecordModel) -> float:
    """Return the capacity of the cell when new, Ah: as stated, or by its constants at this load; NaN if unknown."""
    settings, load_A = loaded.settings, loaded.load.mean_A
    if settings.nominal_Ah is not None:
        return settings.nominal_Ah
    if not load_A > 0.0 or not settings.tells_new_capacity(load_A):
        return nan
    # the cell is empty by then
    return float(model.capacity_Ah([constant(load_A, "current")], settings.resolved.cut_off_V)[0])


def _middle(values: FloatArray, result: Estimate) -> tuple[float, float]:
    """Return the median of samples, and the standard deviation by their central 90 %, if the estimate states one."""
    low, median, high = np.where(np.isfinite(values := quantile(values)), values, np.nan).tolist()
    return median, (high - low) / (2.0 * _BAND_SD) if np.isfinite(result.sd_q_mobile) else nan
