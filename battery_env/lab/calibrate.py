"""Calibrate the model to discharges: from a record to its estimate, its charge and its end."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from math import hypot, sqrt
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
from battery_env.lab.settings import Method, Settings, SettingsOptions
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
from battery_env.records.model import RecordModel, VoltageForecast

# A record of more samples than this is averaged over the time step of the model, or longer where it lasts longer than so many
# steps: what lies between says nothing to the model.
_MANY_SAMPLES = 100_000
_MODEL_STEP_S = 1.0
# What is drawn after the cut-off is worth a word if it is more than this share of what was drawn before.
_MORE_SHARE = 0.2
# So near to a bound, as a share of it, a search ended at it.
_AT_BOUND = 1e-3
# The smallest cell of the model, with a resistance that lets its voltage fall most.
_SMALLEST = Estimate(min(Q_MOBILE.limits), max(R_O.limits), settled=False)
# Nine of ten values of a normal distribution lie within so many standard deviations.
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

      for found in battery_env.calibrate("life.csv", nominal_Ah=2.0):
          print(found)

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
    known = (SettingsOptions if isinstance(source, Discharge) else Options).__annotations__
    check_options("calibrate", options, known)
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


class _LoadedPart(NamedTuple):
    """The part of a discharge under load, before the model is fitted to it."""

    discharge: Discharge  # all of it
    loaded: Discharge
    record: Discharge  # the same, of few samples
    fitted: Discharge  # the same, with the temperature that counts
    eod_time_s: float  # NaN: the record ends above the cut-off
    in_progress: bool
    more_C: float  # drawn after the end
    cell: CellParameters
    start: Start
    load: ExpectedCurrent


def calibrated(
    discharge: Discharge, settings: Settings, load: LoadToCome | None = None, samples: int = 1000, end_is_asked: bool = False
) -> Calibration:
    """
    What one discharge says, and of one in progress what comes after it.

    :param load: to come; ``None``: as so far
    :param samples: of what may come
    :param end_is_asked: whether an end that cannot be told is an error, and not only unknown
    """
    is_whole = not np.isnan(discharge.eod_time_s(settings.resolved.cut_off_V))
    known, usual_C = (settings, None) if is_whole else (settings.with_nominal_cell(), settings.usual_q_mobile_C)
    part = _look_at(discharge, known)
    known = known.expecting(mean_current_A(part.record))
    if end_is_asked and _is_below_all_sizes(part):
        raise ValueError(Reason.BELOW_ALL_SIZES.text)
    estimate, method, model = _estimate(part, known, usual_C)
    # a cell in progress has not ended, however low its model comes in the pulses before
    cut_off_V, current_A = (-np.inf, 0.0) if part.in_progress else (settings.resolved.cut_off_V, part.load.mean_A)
    shown = model.forecast(part.record, estimate, cut_off_V, current_A)
    sized = _of_its_size(estimate, settings, float(part.loaded.charge_C))
    end = None
    if end_is_asked or np.isfinite(sized.q_mobile):  # what has no size has no end
        end = _end(part, estimate, replace(known, method=method), model, shown, load, samples, end_is_asked)
    evidence = _evidence(part, known, shown, estimate)
    charge = _charge(part, settings, estimate, end, evidence.charges_C[Doubt.DROPPED])
    if part.start.findings or part.more_C or not _is_all_logged(part, evidence):
        charge = dict.fromkeys(charge, float("nan"))
    nominal_Ah = _nominal_Ah(model, settings, part.load.mean_A)
    eod_s, sd_eod_s = (shown.eod_time_s, float("nan")) if end is None else _middle(end.eod_time_s, estimate)
    return Calibration(
        cycle=discharge.meta.get("cycle"),
        method=method,
        q_mobile_C=sized.q_mobile,
        sd_q_mobile_C=sized.sd_q_mobile,
        resistance_10s_ohm=sized.resistance_10s_ohm,
        sd_resistance_10s_ohm=sized.sd_resistance_10s_ohm,
        measured_resistance_10s_ohm=measured_resistance_ohm(part.loaded, part.loaded.starts_at_rest),
        r_o_ohm=sized.r_o,
        sd_r_o_ohm=sized.sd_r_o,
        settled=sized.settled,
        settled_q_mobile=sized.settled_q_mobile,
        settled_resistance_10s=sized.settled_resistance_10s,
        settled_r_o=sized.settled_r_o,
        findings=sized.findings,
        initial_soc=part.start.soc,
        sd_initial_soc=part.start.sd_soc,
        samples=len(part.loaded.time_s),
        load_on_time_s=float(part.record.time_s[0]),
        drawn_Ah=part.loaded.charge_C / 3600.0,
        **charge,
        nominal_Ah=nominal_Ah,
        state_of_health=charge["predicted_capacity_Ah"] / nominal_Ah,
        sd_state_of_health=charge["sd_predicted_capacity_Ah"] / nominal_Ah,
        voltage_rmse_V=_rmse_V(shown, part.record),
        predicted_eod_time_s=eod_s,
        sd_predicted_eod_time_s=sd_eod_s,
        measured_eod_time_s=part.eod_time_s,
        remaining_s=eod_s - float(part.record.time_s[-1]) if part.in_progress else 0.0,
        future_current_A=part.load.mean_A,
        load_varied=part.load.is_varying,
        settings=settings,
        record=part.record,
        forecast=shown,
        end=end,
    )


def _look_at(discharge: Discharge, settings: Settings) -> _LoadedPart:
    """The part under load, how it starts, and what comes after it."""
    loaded, eod_time_s = discharge.loaded_part(settings.resolved.cut_off_V), discharge.eod_time_s(settings.resolved.cut_off_V)
    more_C = _charge_after(discharge, loaded, eod_time_s, settings.resolved.cut_off_V)
    record = loaded
    if len(loaded.time_s) > _MANY_SAMPLES:
        record = loaded.averaged(max(_MODEL_STEP_S, float(loaded.time_s[-1] - loaded.time_s[0]) / _MANY_SAMPLES))
    cell, fitted = _cell_at_the_temperature(record, settings), record
    if not settings.resolved.thermal:
        # one that is held counts more than one that was measured
        discharge, fitted = discharge.without_temperature(), record.without_temperature()
    if settings.initial_soc == "rest":
        start = soc_from_rest(discharge, cell, settings.resolved.mismatch_V)
    else:
        soc, sd_soc = check_initial_soc(settings.initial_soc)
        start = Start(soc, sd_soc)
    return _LoadedPart(
        discharge=discharge,
        loaded=loaded,
        record=record,
        fitted=fitted,
        eod_time_s=eod_time_s,
        in_progress=bool(np.isnan(eod_time_s)),
        more_C=more_C,
        cell=cell,
        start=start,
        load=expected_current(record.time_s, record.current_A),
    )


def _estimate(part: _LoadedPart, settings: Settings, usual_q_mobile_C: float | None) -> tuple[Estimate, Method, RecordModel]:
    """The estimate, the method, and the model that it is of."""
    calibrator = settings.calibrator(part.cell, part.start, usual_q_mobile_C)
    cell, thermal = part.cell, settings.resolved.thermal
    if _is_below_all_sizes(part):
        estimate = _SMALLEST
    else:
        estimate = calibrator.estimate(part.fitted)
    if isinstance(calibrator, PolicyEstimator):
        cell, thermal = calibrator.cell, False
    if doubts := part.start.findings or settings.other_load(mean_current_A(part.record)):
        # of the charge: the resistance, which is settled within 30 %, is not in question
        estimate = replace(estimate, settled_q_mobile=False, findings=(*estimate.findings, *doubts))
    model = RecordModel(cell, thermal, initial_soc=part.start.soc)
    return estimate, settings.method or "least-squares", model


def _is_below_all_sizes(part: _LoadedPart) -> bool:
    """Whether the smallest cell of the model ends above a record, so that a search, which may take minutes, is in vain."""
    if part.loaded.charge_C > _SMALLEST.q_mobile:
        return False
    model = RecordModel(part.cell, initial_soc=part.start.soc)
    shown = model.forecast(part.fitted, _SMALLEST, cut_off_V=-np.inf, future_current_A=0.0)
    return bool(shown.at_samples_V[-1] > part.fitted.voltage_V[-1])


def _of_its_size(estimate: Estimate, settings: Settings, drawn_C: float) -> Estimate:
    """Without numbers where the search ended at its bound, as for a cell of far another size: a bound is no result."""
    low_C, high_C = settings.q_mobile_bounds_C
    near = 1.0 - _AT_BOUND
    if low_C < near * estimate.q_mobile < near**2 * high_C:
        return estimate
    numbers = ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "resistance_10s_ohm", "sd_resistance_10s_ohm")
    nothing: dict[str, Any] = dict.fromkeys(numbers, float("nan"))
    findings = (Finding.of(Reason.BELOW_ALL_SIZES),) if drawn_C < _SMALLEST.q_mobile else estimate.findings
    return replace(estimate, **nothing, findings=findings)


def _end(
    part: _LoadedPart,
    estimate: Estimate,
    settings: Settings,
    model: RecordModel,
    shown: VoltageForecast,
    load: LoadToCome | None,
    samples: int,
    is_asked: bool,
) -> Forecast | None:
    """What may come after a record; ``None`` if nothing can be told, or is asked of a record that has ended."""
    if not (part.in_progress or is_asked):
        return None
    if settings.prior_q_mobile_C is None and settings.fit is not None:
        estimate = estimate.within(*settings.fit.life_q_mobile_C)
    gain_sd = settings.current_gain_sd
    try:
        end = forecast(
            part.record,
            _as_read(estimate, gain_sd),
            load,
            settings.resolved.cut_off_V,
            model=model,
            mismatch_V=settings.resolved.mismatch_V,
            nominal_Ah=settings.nominal_Ah,
            samples=samples,
        )
    except ValueError:
        if is_asked:
            raise
        return None
    # a stream of its own: the draws of the forecast have the seed 0
    gains = 1.0 + gain_sd * np.random.default_rng([0, 1]).standard_normal(samples)
    end = replace(end, q_mobile=gains * end.q_mobile, capacity_Ah=gains * end.capacity_Ah)
    end = replace(end, r_o=end.r_o / gains, resistance_10s_ohm=end.resistance_10s_ohm / gains)
    load_A = part.load.mean_A if load is None else _largest_A(load, settings.resolved.cut_off_V)
    # a cell of which nothing is known has no health
    is_known = settings.nominal_Ah is not None or settings.tells_new_capacity(load_A)
    notes = (*end.notes, *_notes(part, estimate, settings, shown, load_A))
    return replace(end, nominal_Ah=end.nominal_Ah if is_known else float("nan"), notes=notes)


def _as_read(estimate: Estimate, gain_sd: float) -> Estimate:
    """In units of the current sensor, whose gain cancels from an end: the load to come is what it will read."""
    left_C2, left_ohm2 = (
        max(sd**2 - (gain_sd * value) ** 2, 0.0)
        for value, sd in ((estimate.q_mobile, estimate.sd_q_mobile), (estimate.r_o, estimate.sd_r_o))
    )
    return replace(estimate, sd_q_mobile=sqrt(left_C2), sd_r_o=sqrt(left_ohm2))


def _notes(part: _LoadedPart, estimate: Estimate, settings: Settings, shown: VoltageForecast, load_A: float) -> Iterator[str]:
    """What a forecast rests on, beyond the last sample under load."""
    other_load, seen_s, rmse_V = settings.other_load(load_A), float(part.record.time_s[-1]), _rmse_V(shown, part.record)
    # which is found where the load so far is another one, too
    yield from (str(each) for each in other_load if each not in estimate.findings)
    if float(part.discharge.time_s[-1]) > seen_s:
        yield f"What was recorded after the last sample under load, at {seen_s:.0f} s, is left out."
    if settings.usual_q_mobile_C is not None and settings.nominal_Ah is None and settings.method != "policy":
        yield "A cell of some 2 Ah is expected: of another one give the nominal capacity, the life, q_max or constants."
    if rmse_V > settings.resolved.mismatch_V:
        text = f"The model misses the voltage by {1e3 * rmse_V:.0f} mV (RMSE), more than mismatch_V."
        yield f"{text} Other loads make the interval too narrow."


def _rmse_V(shown: VoltageForecast, record: Discharge) -> float:
    return float(np.sqrt(np.nanmean((shown.at_samples_V - record.voltage_V) ** 2)))


def _largest_A(load: LoadToCome, cut_off_V: float) -> float:
    """The largest current of a load to come, of a power that at the cut-off; 0 of one that is not known."""
    if isinstance(load, Load):
        return float(load.value.max()) / (1.0 if load.unit == "current" else cut_off_V)
    return float(load) if isinstance(load, Real) else 0.0


def _middle(values: FloatArray, estimate: Estimate) -> tuple[float, float]:
    """
    The median of samples, and the standard deviation that nine of ten of them show, if the estimate states one.
    """
    low, median, high = np.where(np.isfinite(values := quantile(values)), values, np.nan).tolist()
    return median, (high - low) / (2.0 * _BAND_SD) if np.isfinite(estimate.sd_q_mobile) else float("nan")


def _charge(
    part: _LoadedPart, settings: Settings, estimate: Estimate, end: Forecast | None, dropped_C: float
) -> dict[str, float]:
    """The columns of what was drawn, and of what a full cell would have given: its end comes at the same charge."""
    drawn_Ah, start, q_mobile = part.loaded.charge_C / 3600.0, part.start, estimate.q_mobile
    predicted_Ah, sd_Ah = (1.0 - start.soc) * q_mobile / 3600.0 + drawn_Ah, settings.current_gain_sd * drawn_Ah
    if part.in_progress:
        predicted_Ah, sd_Ah = (float("nan"),) * 2 if end is None else _middle(end.capacity_Ah, estimate)
    unseen_Ah = hypot(part.loaded.sd_charge_C, dropped_C) / 3600.0
    return {
        "capacity_Ah": float("nan") if part.in_progress or start.soc < 1.0 else drawn_Ah,
        "predicted_capacity_Ah": predicted_Ah,
        "sd_predicted_capacity_Ah": hypot(sd_Ah, start.sd_soc * q_mobile / 3600.0, unseen_Ah),
    }


def _cell_at_the_temperature(record: Discharge, settings: Settings) -> CellParameters:
    """
    The constants of the model in the surroundings that were measured at load-on, or are known of the record. Those of a path,
    or that a policy has learned of, hold at one temperature.
    """
    cell, ambient_C = settings.constants, record.meta.get("ambient_temperature_C")
    if record.temperature_C is not None:
        ambient_C = record.temperature_C[0]
    if ambient_C is None or settings.method == "policy" or settings.path is not None:
        return cell
    return cell.replace(Tb0=float(ambient_C) + ZERO_CELSIUS_K)


def _charge_after(discharge: Discharge, loaded: Discharge, eod_time_s: float, cut_off_V: float) -> float:
    """What is drawn after the cut-off, if that is more than a discharge leaves behind: then it was not the end."""
    if np.isnan(eod_time_s):
        if discharge.time_s[-1] - loaded.time_s[-1] > STEADY_S:
            warnings.warn(
                f"the load ends at {loaded.voltage_V[-1]:.4g} V, above the cut-off of {cut_off_V:g} V, so that the capacity "
                "is not known: if the cell was discharged no further, state cut_off_V (--cut-off)",
                stacklevel=5,
            )
        return 0.0
    until_C, in_all_C = integrate_load(discharge.time_s, discharge.current_A, [eod_time_s, discharge.time_s[-1]]).tolist()
    more_C = in_all_C - until_C
    if more_C <= _MORE_SHARE * until_C:
        return 0.0
    warnings.warn(
        f"{more_C / 3600.0:.3f} Ah more are drawn after the cut-off at {eod_time_s:.0f} s, and left aside. If that is "
        "another discharge, give each alone, or number them in a column of the cycle; if a pulse fell below it, state a lower "
        "cut_off_V (--cut-off)",
        stacklevel=5,
    )
    return more_C


def _evidence(part: _LoadedPart, settings: Settings, forecast: VoltageForecast, estimate: Estimate) -> Evidence:
    """What the samples show beside an estimate; voltages that it does without are named."""
    history = history_of(part.record, settings.resolved.usual_start)
    parameters = estimate.q_mobile, estimate.r_o
    evidence = evidence_of(Samples.of(part.record), part.cell, part.start.soc, parameters, history, forecast.at_samples_V)
    if evidence.dropouts:
        first_s, count = float(part.record.time_s[0]) + evidence.dropouts[0].begin_s, len(evidence.dropouts)
        when = f"at {first_s:.0f} s" if count == 1 else f"{count} times, first at {first_s:.0f} s"
        warnings.warn(
            f"the current changes for a moment {when}, and the voltage does not follow: the voltages there are left out. "
            "Check the current sensor and its logger",
            stacklevel=5,
        )
    return evidence


def _is_all_logged(part: _LoadedPart, evidence: Evidence) -> bool:
    """
    Whether all that was drawn is in the record: the cell starts, before or under the load, no lower than with this charge, no
    sensor fails, and the voltage says of each gap that its charge was drawn.
    """
    # a charge that tapered off fills any cell, whatever its voltage at rest
    charge = part.record.history.charge
    is_lower = evidence.first_V < evidence.start_V and not (charge and charge.is_tapered)
    return not (evidence.fault or (is_lower and evidence.start) or evidence.charges_C[Doubt.GAP])


def _nominal_Ah(model: RecordModel, settings: Settings, load_A: float) -> float:
    if settings.nominal_Ah is not None:
        return settings.nominal_Ah
    if not load_A > 0.0 or not settings.tells_new_capacity(load_A):
        return float("nan")
    # the cell is empty by then
    return float(model.capacity_Ah([constant(load_A, "current")], settings.resolved.cut_off_V)[0])
