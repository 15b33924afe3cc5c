"""The life of a cell over its discharges: the prior of the next discharge, and the remaining useful life."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from math import exp, hypot, isnan, log, nan, sqrt
from numbers import Real
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from battery_env.arrays import BoolArray, FloatArray
from battery_env.checks import check_positive, check_whole_number
from battery_env.compiled import compiled
from battery_env.electrochemistry.ends import BAND, quantile
from battery_env.electrochemistry.model_error import UNFITTED_ERROR_RATIO
from battery_env.estimates import Estimate
from battery_env.estimates.findings import Finding, Reason, is_only_imprecise, reason_of
from battery_env.estimators.diagnosis.rest import starting_alike, usual_start
from battery_env.estimators.least_squares import Alternative, LeastSquares, RecordFit
from battery_env.estimators.resistance import measured_resistance_ohm
from battery_env.lab.settings import Settings
from battery_env.loads import Load, LoadToCome, constant
from battery_env.records import VARIED_SHARE, DischargeStart, drawn_charge_C, integrate_load, load_range_A, mean_current_A
from battery_env.records.discharge import Discharge
from battery_env.records.model import ModelError, RecordModel

#: Priors of a life, as shares of q_mobile: the step from one discharge to the next and the independent error of an estimate
#: (both to a factor of e, one standard deviation), and the standard deviation of the drift.
PRIOR_STEP_SHARE, PRIOR_NOISE_SHARE, PRIOR_DRIFT_SD_SHARE = 0.01, 0.003, 0.003
_COLUMNS = """
    cycle q_mobile_C sd_q_mobile_C resistance_10s_ohm sd_resistance_10s_ohm settled_resistance_10s measured_resistance_10s_ohm
    r_o_ohm settled findings reason valid capacity_Ah mean_current_A least_current_A most_current_A lasted_share
""".split()
# The number of simulated lives, and of discharges ahead.
_LIVES, _MOST = 2000, 2000


@dataclass(frozen=True, eq=False)
class Life:
    """
    The life of a cell, from :func:`track_life`.

    The logarithm of ``q_mobile`` is a random walk with drift over the discharges, and each estimate is a noisy observation.
    If the numbers leave discharges out, the walk continues through these discharges.

    :param table: one row per discharge: ``cycle`` (its number, or its position), ``q_mobile_C``, ``sd_q_mobile_C``,
        ``resistance_10s_ohm`` and ``sd_resistance_10s_ohm`` (after ten seconds, of a fit that also estimates constants),
        ``settled_resistance_10s``, ``measured_resistance_10s_ohm``, ``r_o_ohm``, ``settled``, ``findings``, ``reason``,
        ``valid`` (whether it counts), ``capacity_Ah`` (charge to the cut-off), ``mean_current_A``, ``least_current_A`` and
        ``most_current_A`` (without a few extremes), ``lasted_share`` (its duration, as a share of the model's at this
        ``q_mobile``; NaN if it was cut short), and the prediction from the earlier discharges, ``expected_q_mobile_C`` and
        ``expected_sd_C`` (NaN for the first)
    :param step_share: standard deviation of the step from one discharge to the next, as a share of ``q_mobile``
    :param noise_share: standard deviation of the error that an estimate does not share with the others, as such a share
    :param drift_share: mean step, as such a share
    :param state: mean of (ln ``q_mobile`` after the last discharge, drift), shape (2,)
    :param covariance: covariance of ``state``, shape (2, 2)
    :param sd_share: relative standard deviation of the last valid ``q_mobile`` with uncertain constants; or NaN
    :param usual_start: how the discharges start; ``None`` if they do not start and last alike
    :param cut_off_V: cut-off voltage of the discharges, V
    :param model_errors: what the model missed over each discharge; ``None`` of one that was cut short. Empty: unknown
    :param alternatives: the model of the last valid discharge, and others that its constants leave open
        (:class:`~battery_env.estimators.least_squares.Alternative`)
    """

    table: pd.DataFrame
    step_share: float
    noise_share: float
    drift_share: float
    state: FloatArray
    covariance: FloatArray
    sd_share: float = nan
    usual_start: DischargeStart | None = None
    cut_off_V: float = nan
    model_errors: Sequence[ModelError | None] = ()
    alternatives: Sequence[Alternative] = ()

    @property
    def prior_q_mobile_C(self) -> tuple[float, float]:
        """
        Mean and standard deviation of ``q_mobile`` in the next discharge, C: a prior for its calibration. The prior is for
        the load of the last discharge, because there the shared error of all estimates cancels from the end. At the
        ``q_mobile`` of a whole discharge the model ends a little early or late, as in the discharge before: the mean corrects
        for this error.
        """
        valid, table = self.table["valid"], self.table[["least_current_A", "most_current_A"]]
        last = table[valid].iloc[-1]
        is_like_last = ((table - last).abs() <= VARIED_SHARE * last["most_current_A"]).all(axis=1)
        return self._prior_C(1, np.asarray(valid & is_like_last, dtype=np.bool_))

    def _prior_C(self, count: int, alike: BoolArray) -> tuple[float, float]:
        """Return the prior so many discharges later at the load of these discharges."""
        life, other = self, self.table["valid"].to_numpy(dtype=np.bool_) & ~alike
        if other.any():
            # the walk at this load, of which the estimates at others tell less
            mean_A = self.table["mean_current_A"]
            doubt_share = self._doubt_share(mean_A[other].to_numpy(), float(mean_A[alike].iloc[-1]))
            life = life_of(self.table, np.where(other, doubt_share, 0.0))
        mean_C, sd_C = life.later_q_mobile_C(count)
        lasted_share = self.table["lasted_share"][alike].dropna()
        lasted = float(lasted_share.iloc[-1]) if len(lasted_share) else 1.0
        return lasted * mean_C, lasted * sd_C

    def _prior_at_other_load_C(self, count: int, currents_A: FloatArray) -> tuple[float, float]:
        """Return the prior so many discharges later at currents that no discharge of the life had, A; NaN: at any."""
        mean_C, sd_C = self.later_q_mobile_C(count)
        usual_A = float(self.table["mean_current_A"][self.table["valid"]].iloc[-1])
        return mean_C, hypot(sd_C, mean_C * self._doubt_share(currents_A, usual_A))

    def _alike(self, currents_A: FloatArray) -> BoolArray:
        """Return which valid discharges have all of their currents within 5 % of all of these, A; none of NaN."""
        least_A = np.minimum(self.table["least_current_A"], currents_A.min())
        most_A = np.maximum(self.table["most_current_A"], currents_A.max())
        return np.asarray(self.table["valid"] & (most_A - least_A <= VARIED_SHARE * most_A), dtype=np.bool_)

    def _doubt_share(self, currents_A: FloatArray, usual_A: float) -> float:
        """Return how far the charges at these currents and at a usual one may be from one another, by the constants."""
        ratios = np.maximum(currents_A, 0.0) / usual_A
        other_A = float(currents_A[np.argmax(np.maximum(ratios, 1.0 / np.maximum(ratios, VARIED_SHARE)))])
        return UNFITTED_ERROR_RATIO * hypot(self.sd_share, self._open_share(other_A, usual_A))

    def _open_share(self, load_A: float, usual_A: float) -> float:
        """Return the relative uncertainty, by the constants, of the ratio of charges at two loads, A."""
        if not load_A > 0.0 or not self.alternatives:
            return 0.0
        loads = [constant(each_A, "current") for each_A in (load_A, usual_A)]
        capacity_Ah = np.array(
            [
                [float(each.model.capacity_Ah([load], self.cut_off_V, each.q_mobile, each.r_o)[0]) for load in loads]
                for each in self.alternatives
            ]
        )
        share = capacity_Ah[:, 0] / capacity_Ah[:, 1]
        # each direction on both sides; at most the whole charge
        difference = (share[1:] - share[0]) / np.maximum(share[1:], share[0])
        return sqrt(0.5 * float(np.nansum(difference**2)))

    @property
    def next_q_mobile_C(self) -> tuple[float, float]:
        """Mean and standard deviation of ``q_mobile`` in the next discharge, C."""
        return self.later_q_mobile_C(1)

    def later_q_mobile_C(self, count: int) -> tuple[float, float]:
        """Mean and standard deviation of ``q_mobile`` so many discharges after the last one, C."""
        weights = np.array([1.0, count])
        mean_C = exp(weights @ self.state)
        return mean_C, mean_C * sqrt(weights @ self.covariance @ weights + count * self.step_share**2)

    @property
    def prior_at_other_loads_C(self) -> tuple[float, float]:
        """The same for a load that is not that of the life: the error that all estimates share counts too, in full."""
        return self._prior_at_other_load_C(1, np.array([nan]))

    def discharges_until(self, cycle: int | None) -> int:
        """Return how many discharges after the last one of the life a discharge is, by its number; 1 without numbers."""
        return int(_steps_between(pd.Series([self.table["cycle"].iloc[-1], cycle]))[-1])

    def prior_for(self, running: Discharge, load: LoadToCome | None = None) -> tuple[float, float]:
        """
        The prior that suits a discharge in progress: :attr:`prior_q_mobile_C` where all currents, so far and to come, lie
        within 5 % of those of a discharge of the life, and :attr:`prior_at_other_loads_C` anywhere else. Where its number says
        that it is not the next one after the life, it is as unsure as the fade in between.

        :param running: the discharge in progress
        :param load: to come, as :func:`battery_env.forecast` takes it; ``None``: as so far
        :return: mean and standard deviation of ``q_mobile``, C
        """
        count, currents_A = self.discharges_until(running.meta.get("cycle")), _currents_A(running, load)
        alike = self._alike(currents_A)
        return self._prior_C(count, alike) if alike.any() else self._prior_at_other_load_C(count, currents_A)

    def model_error_for(self, running: Discharge, load: LoadToCome | None = None) -> ModelError | None:
        """
        What the model missed over the last discharge at the load of one in progress, and will miss again; ``None``: there is
        no such discharge.
        """
        alike = zip(self.model_errors, self._alike(_currents_A(running, load)), strict=False)
        return next((error for error, is_alike in reversed(list(alike)) if is_alike and error is not None), None)

    def after(self, count: int) -> Life:
        """
        The life as it was known after its first discharges.

        :param count: how many
        :return: that part of the life, with the sizes of step and noise that it shows
        :raises ValueError: for fewer discharges than one or more than there are, or if none of them is valid
        """
        if check_whole_number("count", count, 1) > len(self.table):
            raise ValueError(f"count must lie within 1 .. {len(self.table)}, got {count}")
        unchanged = {name: getattr(self, name) for name in ("sd_share", "usual_start", "cut_off_V", "alternatives")}
        return replace(life_of(self.table.iloc[:count]), model_errors=self.model_errors[:count], **unchanged)

    def remaining_discharges(self, threshold_Ah: float, probability: ArrayLike = BAND) -> FloatArray:
        """
        The remaining useful life: how many discharges are still to come, the one included that first has less capacity than
        the threshold. The cell is used as before; its capacity is in proportion to ``q_mobile``, as in the last discharge, and
        does not grow in the long run. Discharges are counted by their numbers; without these a row counts as one, so that
        check-ups make the answer too long.

        :param threshold_Ah: capacity at which the life ends, Ah
        :param probability: of the quantiles, within 0 .. 1, any shape
        :return: quantiles over 2000 lives that are simulated, same shape as ``probability``; infinite beyond 2000 discharges
        :raises ValueError: for an argument out of range
        """
        check_positive("threshold_Ah", threshold_Ah)
        last = self.table[self.table["valid"]].iloc[-1]
        end = log(threshold_Ah * last["q_mobile_C"] / last["capacity_Ah"])
        from scipy.stats import truncnorm  # slow to import, and nothing else here needs it

        rng = np.random.default_rng(0)
        (level_mean, drift_mean), ((p_level, p_both), (_, p_drift)) = self.state, self.covariance
        drift_sd = sqrt(p_drift)
        drift = drift_mean + drift_sd * truncnorm.rvs(-np.inf, -drift_mean / drift_sd, size=_LIVES, random_state=rng)
        level = level_mean + p_both / p_drift * (drift - drift_mean)
        level += sqrt(max(p_level - p_both**2 / p_drift, 0.0)) * rng.standard_normal(_LIVES)
        remaining = np.full(_LIVES, np.inf)
        for n in range(1, _MOST + 1):
            level = level + drift + self.step_share * rng.standard_normal(_LIVES)
            remaining[np.isinf(remaining) & (level < end)] = n
        return quantile(remaining, probability)


def track_life(discharges: Sequence[Discharge], cut_off_V: float, calibrator: LeastSquares | None = None) -> Life:
    """
    Follow ``q_mobile`` of one cell from discharge to discharge.

    Each discharge is calibrated alone. Over the discharges the logarithm of ``q_mobile`` is a random walk with drift (the
    local level model of Durbin and Koopman, *Time Series Analysis by State Space Methods*, 2012, with a constant slope),
    filtered by Kalman's recursions. The sizes of step and noise are those that make the series most probable, under weak
    priors (:data:`PRIOR_STEP_SHARE`).

    A discharge is *valid* if its estimate is settled, or reaches the cut-off and is only imprecise: discharges of one cell
    share this error, so that the error hides no step. Unusable discharges, discharges that their record contradicts, and
    discharges that were cut short are left out.

    .. code-block:: python

      life = track_life(load_nasa_discharges("B0005")[:60], cut_off_V=2.7)
      next_fit = Settings(prior_q_mobile_C=life.prior_q_mobile_C).calibrator()
      print(life.remaining_discharges(threshold_Ah=1.4))

    :param discharges: discharges of one cell, in their order
    :param cut_off_V: voltage at which the discharges end, V
    :param calibrator: least squares without a prior, such as ``Settings(cell=fit).calibrator()``. All discharges have the same
        constants, whose uncertainty counts at other loads. ``None``: least squares with the constants of a new 18650
    :raises ValueError: if no discharge is valid, or the calibrator has a prior or no full cell at the start
    """
    if calibrator is None:
        return life_before(discharges, Settings(cut_off_V=cut_off_V))
    fixed = copy(calibrator)
    fixed.prior = fixed.prior.with_fixed_rates()
    return _track(discharges, cut_off_V, fixed, calibrator)


def life_before(discharges: Sequence[Discharge], settings: Settings) -> Life:
    """Track the life of a cell with the settings of its next discharge."""
    settings = replace(settings, method="least-squares", initial_soc=1.0)
    # all discharges have the same constants
    fixed = replace(settings, cell_rates_sd={}).calibrator()
    free = settings.calibrator()
    assert isinstance(fixed, LeastSquares)
    assert isinstance(free, LeastSquares)
    return _track(discharges, settings.resolved.cut_off_V, fixed, free)


def _track(discharges: Sequence[Discharge], cut_off_V: float, fixed: LeastSquares, free: LeastSquares) -> Life:
    """Track a cell with fixed constants, and determine the uncertainty of its last discharge with free constants."""
    if fixed.prior_q_mobile_C is not None:
        raise ValueError("the calibrator must have no prior of q_mobile: each discharge has to speak for itself")
    if fixed.initial_soc != (1.0, 0.0):
        raise ValueError("the calibrator must take discharges to start full: the charge to the cut-off is no capacity else")
    if not len(discharges):
        raise ValueError("discharges must hold at least one discharge")
    usual_start = _usual_start(discharges, cut_off_V)
    fixed, free = copy(fixed), copy(free)
    fixed.usual_start = free.usual_start = usual_start or fixed.usual_start
    rows = []
    last_fit: RecordFit | None = None
    for position, discharge in enumerate(discharges):
        row: dict[str, Any] = {"cycle": discharge.meta.get("cycle", position + 1)}
        try:
            fit = free.fit(discharge.loaded_part(cut_off_V))
            rows.append(row | _row_of(discharge, cut_off_V, fixed, free, fit))
            last_fit = fit if rows[-1]["valid"] else last_fit
        except ValueError as error:  # of one that cannot be used
            rows.append(
                row
                | {
                    "settled": False,
                    "settled_resistance_10s": False,
                    "valid": False,
                    "findings": (Finding.of(Reason.OTHER, message=str(error)),),
                }
            )
    table = pd.DataFrame(rows, columns=_COLUMNS)
    life = life_of(table.assign(reason=[reason_of(each) for each in table["findings"]]))
    assert last_fit is not None  # a life without a valid discharge is refused
    estimate, alternatives = free.estimate_of(last_fit), last_fit.alternatives()
    sd_share = estimate.sd_q_mobile / estimate.q_mobile
    return replace(
        life,
        sd_share=sd_share,
        usual_start=usual_start,
        cut_off_V=cut_off_V,
        model_errors=tuple(row.get("model_error") for row in rows),
        alternatives=alternatives,
    )


def _currents_A(running: Discharge, load: LoadToCome | None) -> FloatArray:
    """Return the range of the currents so far, and all currents to come, A; NaN if these are unknown."""
    so_far_A = load_range_A(running.current_A[running.time_s > running.load_on_time_s])
    if load is None:
        return np.array(so_far_A)
    if isinstance(load, Load) and load.unit == "current":
        return np.array([*so_far_A, *load.value])
    return np.array([*so_far_A, float(load) if isinstance(load, Real) else nan])


def _usual_start(discharges: Sequence[Discharge], cut_off_V: float) -> DischargeStart | None:
    """Return the usual start of the discharges of a life, if they start and last alike; others may not start full."""
    loaded = []
    for discharge in discharges:
        with suppress(ValueError):  # of one that cannot be used
            if not isnan(discharge.eod_time_s(cut_off_V)):
                loaded.append(discharge.loaded_part(cut_off_V))
    alike = starting_alike(loaded)
    steps = np.abs(np.diff(np.log([drawn_charge_C(part) for part in alike])))
    return usual_start(alike) if len(steps) and np.median(steps) <= VARIED_SHARE else None


def _row_of(discharge: Discharge, cut_off_V: float, fixed: LeastSquares, free: LeastSquares, fit: RecordFit) -> dict[str, Any]:
    """Return the row of one discharge in the table; its resistance is of a fit with free constants, because they age, too."""
    record = discharge.loaded_part(cut_off_V)
    with_free_constants = free.estimate_of(fit)
    estimate = with_free_constants if fixed.prior.nuisance == free.prior.nuisance else fixed.estimate(record)
    end_s, measured_s = fixed.model.forecast(record, estimate, cut_off_V).eod_time_s, discharge.eod_time_s(cut_off_V)
    lasted_share = (measured_s - record.time_s[0]) / (end_s - record.time_s[0])
    least_A, most_A = load_range_A(record.current_A[1:])
    # a finding about the resistance is none about q_mobile
    of_charge = [each for each in estimate.findings if each.number in ("", "q_mobile")]
    return {
        "q_mobile_C": estimate.q_mobile,
        "sd_q_mobile_C": estimate.sd_q_mobile,
        "resistance_10s_ohm": with_free_constants.resistance_10s_ohm,
        "sd_resistance_10s_ohm": with_free_constants.sd_resistance_10s_ohm,
        "measured_resistance_10s_ohm": measured_resistance_ohm(record, record.starts_at_rest),
        "settled_resistance_10s": with_free_constants.settled_resistance_10s,
        "r_o_ohm": estimate.r_o,
        "settled": estimate.settled,
        "findings": estimate.findings,
        "valid": estimate.settled_q_mobile or (not isnan(measured_s) and is_only_imprecise(of_charge)),
        "capacity_Ah": float(integrate_load(record.time_s, record.current_A, end_s)) / 3600.0,
        "mean_current_A": mean_current_A(record),
        "least_current_A": least_A,
        "most_current_A": most_A,
        "lasted_share": lasted_share,
        "model_error": (
            None
            if isnan(lasted_share)
            else _model_error(fit, fixed.model, replace(estimate, q_mobile=lasted_share * estimate.q_mobile), measured_s)
        ),
    }


def _model_error(fit: RecordFit, model: RecordModel, estimate: Estimate, end_s: float) -> ModelError:
    """Return what the model misses over a discharge, at an estimate that ends when the discharge did: then nothing."""
    record = fit.record
    error_V = record.voltage_V - model.forecast(record, estimate, -np.inf).at_samples_V
    # in a dropout the voltage does not belong to the current
    is_compared = np.isfinite(error_V) & np.isfinite(fit.search.error_at_samples.noise_V) & (record.time_s < end_s)
    times_s = np.append(record.time_s[is_compared], end_s)
    drawn_C = integrate_load(record.time_s, record.current_A, times_s)
    return ModelError(drawn_C / estimate.q_mobile, np.append(error_V[is_compared], 0.0))


def life_of(table: pd.DataFrame, doubt_share: ArrayLike = 0.0) -> Life:
    """Follow ``q_mobile`` over the rows of a table; ``doubt_share``: further relative standard deviations of the estimates."""
    valid = table["valid"].to_numpy(dtype=np.bool_)
    if not valid.any():
        raise ValueError(f"no discharge determines q_mobile. {_most_common(table['findings'])}")
    readings, steps = np.log(table["q_mobile_C"].to_numpy()), _steps_between(table["cycle"])
    centre = np.log([PRIOR_STEP_SHARE, PRIOR_NOISE_SHARE])
    doubts = np.broadcast_to(np.asarray(doubt_share, dtype=np.float64), len(readings)).copy()

    def filtered(logarithms: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        step, noise = np.exp(np.clip(logarithms, -15.0, 0.0))
        return _filtered(readings, steps, valid, step, np.hypot(noise, doubts))

    def surprise(logarithms: FloatArray) -> float:
        return float(filtered(logarithms)[0] + 0.5 * ((logarithms - centre) ** 2).sum())

    best = minimize(surprise, centre, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4}).x
    _, expected, state, covariance = filtered(best)
    step, noise = np.exp(best)
    mean_C = np.exp(expected[:, 0])
    table = table.assign(expected_q_mobile_C=mean_C, expected_sd_C=mean_C * np.sqrt(expected[:, 1]))
    return Life(table, float(step), float(noise), float(state[1]), state, covariance)


def _steps_between(numbers: pd.Series) -> FloatArray:
    """Return how many discharges each one is after the previous one, by their numbers; 1 where numbers do not increase."""
    steps = pd.to_numeric(numbers, errors="coerce").diff().to_numpy(dtype=np.float64)
    return np.where(steps > 1.0, steps, 1.0)


def _most_common(findings: pd.Series) -> str:
    """Return the most frequent findings as text, with the values of their first discharge."""
    kinds = [tuple(each.code for each in of_one) for of_one in findings]
    kind, count = Counter(kinds).most_common(1)[0]
    return f"Of {count} of {len(kinds)}: {reason_of(findings.iloc[kinds.index(kind)])}"


@compiled
def _filtered(
    readings: FloatArray, steps: FloatArray, valid: BoolArray, step: float, noise: FloatArray
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    # Kalman's recursions. Returns minus the log likelihood, the prediction of each reading (mean and variance of the level),
    # and the state after the last reading with its covariance
    first = np.flatnonzero(valid)[0]
    level, drift = readings[first], 0.0
    p_level, p_both, p_drift = noise[first] ** 2, 0.0, PRIOR_DRIFT_SD_SHARE**2
    surprise, expected = 0.0, np.full((len(readings), 2), np.nan)
    for n in range(first + 1, len(readings)):
        level += steps[n] * drift
        p_level += 2.0 * steps[n] * p_both + steps[n] ** 2 * p_drift + steps[n] * step**2
        p_both += steps[n] * p_drift
        expected[n, 0], expected[n, 1] = level, p_level
        if valid[n]:
            variance, innovation = p_level + noise[n] ** 2, readings[n] - level
            surprise += 0.5 * (np.log(variance) + innovation**2 / variance)
            gain_level, gain_drift = p_level / variance, p_both / variance
            level += gain_level * innovation
            drift += gain_drift * innovation
            p_drift -= gain_drift * p_both
            p_both -= gain_level * p_both
            p_level -= gain_level * p_level
    return surprise, expected, np.array([level, drift]), np.array([[p_level, p_both], [p_both, p_drift]])
