"""The end of discharge under a load to come, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, inf, log10
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from battery_env.arrays import FloatArray
from battery_env.checks import LOAD_UNIT_SYMBOLS, LoadUnit, check_not_negative, check_positive, check_whole_number
from battery_env.electrochemistry import NEW_CELL
from battery_env.electrochemistry.ends import BAND, Cells, EndsOfDischarge, quantile, simulate_current, simulate_to_cut_off
from battery_env.electrochemistry.model_error import UNFITTED_ERROR_RATIO
from battery_env.estimates import Estimate
from battery_env.estimates.findings import is_only_imprecise
from battery_env.estimators.verdict import white_noise_V
from battery_env.loads import BlockBootstrap, Cycle, KnownLoad, Load, LoadToCome, RandomLoad, known_load, steadier_unit
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.records import CUT_OFF_V, Record, Samples, check_record, expected_current
from battery_env.records.model import RECENT_SHARE, RecordModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The last voltage of a record may be the cut-off but for rounding, V.
_ROUNDING_V = 1e-6
# Draws of a random load for the capacity of a new cell: their mean has a standard error of 1 %.
_NOMINAL_DRAWS = 100
# An estimate this many standard deviations below what the record takes out of the cell contradicts the record.
_CONTRADICTION_SD = 5.0
# A figure ends at most at this multiple of the record, or of its median end.
_LONGEST_PLOTTED = 1.5


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    The future of a discharge in progress, from :func:`forecast`: n equally likely samples.

    :param record: the discharge so far
    :param load_name: the load to come, in words
    :param cut_off_V: voltage at the end of the discharge, V
    :param eod_time_s: end of discharge, on the clock of the record, s, shape (n,); infinite if not reached
    :param soc: state of charge at the end of the record: the share of ``q_mobile`` left in the negative electrode, shape (n,)
    :param q_mobile: charge that can move, C, shape (n,)
    :param resistance_10s_ohm: the resistance after ten seconds of the estimate, ohm, shape (n,); NaN if not estimated
    :param r_o: ohmic resistance of the model, ohm, shape (n,)
    :param capacity_Ah: charge from full to the end of discharge, the capacity at this load, Ah, shape (n,). If the record
        starts partly charged (``initial_soc`` of the model), the capacity includes the missing charge; NaN if the end is not
        reached
    :param nominal_Ah: capacity of the cell when new, Ah
    :param time_s: times from the end of the record on, on the clock of the record, s, shape (K,)
    :param voltage_V: quantiles :data:`BAND` of the voltage at these times, V, shape (3, K); an ended discharge counts as at
        the cut-off
    :param notes: cautions about this forecast, sentences
    """

    record: Samples
    load_name: str
    cut_off_V: float
    eod_time_s: FloatArray
    soc: FloatArray
    q_mobile: FloatArray
    resistance_10s_ohm: FloatArray
    r_o: FloatArray
    capacity_Ah: FloatArray
    nominal_Ah: float
    time_s: FloatArray
    voltage_V: FloatArray
    notes: tuple[str, ...] = ()

    @property
    def now_s(self) -> float:
        """The end of the record, s."""
        return float(self.record.time_s[-1])

    @property
    def remaining_s(self) -> FloatArray:
        """Time from the end of the record to the end of discharge, s, shape (n,)."""
        return np.maximum(self.eod_time_s - self.now_s, 0.0)

    @property
    def state_of_health(self) -> FloatArray:
        """Capacity as a share of ``nominal_Ah``, shape (n,)."""
        return self.capacity_Ah / self.nominal_Ah

    def eod_quantile_s(self, probability: ArrayLike = BAND) -> FloatArray:
        """
        Quantiles of the end of discharge.

        :param probability: within 0 .. 1, any shape
        :return: on the clock of the record, s, same shape
        """
        return quantile(self.eod_time_s, probability)

    def summary(self) -> str:
        """The forecast in a readable form."""
        q_max_Ah, is_measurable = self.q_mobile / 3600.0, bool(np.isfinite(self.resistance_10s_ohm).all())
        resistance_mohm = 1e3 * (self.resistance_10s_ohm if is_measurable else self.r_o)
        resistance_name = "10 s resistance (mohm)" if is_measurable else "R_o (mohm)"
        rows = {
            "end of discharge (s)": (self.eod_time_s, 0),
            "remaining time (s)": (self.remaining_s, 0),
            "state of charge now (%)": (100.0 * self.soc, 1),
            "q_max (Ah)": (q_max_Ah, decimals(float(np.median(q_max_Ah)), 3)),
            resistance_name: (resistance_mohm, decimals(float(np.median(resistance_mohm)), 1)),
            "capacity (Ah)": (self.capacity_Ah, decimals(float(np.median(self.capacity_Ah)), 3)),
        }
        if not np.isnan(self.nominal_Ah):
            nominal = f"{self.nominal_Ah:.{decimals(self.nominal_Ah, 3)}f} Ah"
            rows[f"state of health (% of {nominal})"] = 100.0 * self.state_of_health, 1
        head = "".join(f"{'median' if p == 0.5 else f'{100.0 * p:g} %':>10}" for p in BAND)
        lines = [
            f"Discharge to {self.cut_off_V:g} V, {self.now_s:.0f} s seen, then {self.load_name} ({len(self.soc)} samples)",
            f"  {'':<34}{head}",
        ]
        for name, (values, digits) in rows.items():
            lines.append(f"  {name:<34}" + "".join(f"{value:10.{digits}f}" for value in quantile(values, BAND)))
        return "\n".join([*lines, *self.notes])

    def plot(self) -> Figure:
        """The voltage of the record and the one to expect, with the interval of the end of discharge."""
        from battery_env.plotting import COLOURS, new_figure  # here, as matplotlib takes long to import

        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        axes.plot(self.record.time_s, self.record.voltage_V, ".", ms=2.5, color="0.6", label="measured")
        inside = f"{100.0 * (BAND[2] - BAND[0]):.0f} %"
        time_s, voltage_V, end_s = self.time_s, self.voltage_V, self.eod_quantile_s()
        if np.isfinite(end_s).all():
            # a distant end would leave no room for the record
            last_s = min(end_s[2], _LONGEST_PLOTTED * max(self.now_s, end_s[1]))
            axes.axvspan(min(end_s[0], last_s), last_s, color=COLOURS[1], alpha=0.2, lw=0, label=f"end of discharge, {inside}")
            axes.axvline(end_s[1], color=COLOURS[1], lw=1.2)
            time_s, voltage_V = time_s[time_s <= last_s], voltage_V[:, time_s <= last_s]
        axes.fill_between(time_s, voltage_V[0], voltage_V[2], color=COLOURS[0], alpha=0.25, lw=0, label=f"voltage, {inside}")
        axes.plot(time_s, voltage_V[1], color=COLOURS[0], lw=1.4, label="voltage, median")
        axes.axhline(self.cut_off_V, color="0.6", lw=0.8)
        axes.set(xlabel="time (s)", ylabel="voltage (V)")
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=9, loc="lower left")
        return figure


def decimals(value: float, least: int) -> int:
    """Return the number of decimals that shows three digits of a value, also for a small cell."""
    return max(least, 2 - floor(log10(value))) if 0.0 < value < inf else least


def forecast(
    record: Record,
    estimate: Estimate,
    load: LoadToCome | None = None,
    cut_off_V: float | None = None,
    *,
    load_unit: LoadUnit = "current",
    model: RecordModel | None = None,
    mismatch_V: float = 0.05,
    nominal_Ah: float | None = None,
    samples: int = 1000,
    seed: int = 0,
) -> Forecast:
    """
    Forecast the end of a discharge in progress, under a load to come, with its uncertainty.

    Each sample is a cell with parameters, a model error and (if the load is random) a load of its own. All samples follow the
    record and then the load, down to the cut-off, for a week at most.

    *Parameters* are drawn from the estimate and its standard deviations. ``q_mobile`` is log-normal, half of it below the
    estimate, and above the charge already drawn. ``r_o`` is normal, with the correlation with ``q_mobile`` that the voltage
    of this record implies. Standard deviations of NaN count as zero, and ``notes`` say so.

    *The error of the model* has the standard deviation ``mismatch_V``. Shortly before the end of the record the error is the
    mean difference between measured and modelled voltage, so that samples of any resistance agree with the measurement.
    Then the error drifts with the charge drawn. Samples that would have reached the cut-off within the record are replaced.

    *The load.* Without ``load`` the discharge continues: at its last current if the current was constant (at rest if the load
    was switched off), and otherwise in blocks of the record (:class:`battery_env.loads.BlockBootstrap`), of current or of
    power, whichever is steadier between the switches of the load.

    :param record: one discharge from its first sample to now, of a cell that was full unless ``model`` says otherwise
    :param estimate: the estimate of any calibrator, best with standard deviations
    :param load: the load from the end of the record on: a number; a profile, ``Load(time_s, value, unit)``; a ``Cycle``; a
        function of time in s that takes an array; or a ``RandomLoad``, drawn anew for each sample. ``None``: as above. In
        each time step of the model the mean of the load flows; a function counts with its value at the start of the step
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the ``VEOD`` of the model's cell, 2.7 V if no
        ``model`` is given
    :param load_unit: unit of a number or a function: ``"power"`` in W or ``"current"`` in A. Other loads have a unit
    :param model: the model of the estimate, ``LeastSquares(...).model``; ``None``: ``RecordModel()``
    :param mismatch_V: expected error of the model, V; 0.05 V suits the bundled real cells, 0 simulated cells without mismatch
    :param nominal_Ah: capacity at a state of health of 1, Ah; ``None``: the charge that the model's cell, with its own
        ``q_mobile`` and ``r_o``, gives from full under the load to come, on average if the load is random
    :param samples: number of samples
    :param seed: seed of all random draws
    :return: the samples, with quantiles, a summary and a plot
    :raises TypeError: for a load of another type
    :raises ValueError: for an argument out of range, an estimate that the record contradicts, or a load that charges the cell
        beyond full
    """
    model = RecordModel(NEW_CELL.replace(VEOD=CUT_OFF_V)) if model is None else model
    cut_off = model.cell.VEOD if cut_off_V is None else cut_off_V
    _check_arguments(mismatch_V, cut_off, nominal_Ah, samples, seed)
    measured = check_record(record, least_samples=2)
    rng, new_model = np.random.default_rng(seed), model
    future_load, load_name = _future_load(load, load_unit, measured, model)
    notes = _notes(estimate, measured, load is None and isinstance(future_load, RandomLoad))

    model = model.at(estimate)
    _, current_A = model.grid(measured)
    q_C, r_ohm, acting_ohm = _draw_parameters(model, current_A[:-1], estimate, mismatch_V, samples, rng)
    cells, voltage_V = _cells_at_the_end(measured, model, current_A, (q_C, acting_ohm), mismatch_V, rng)
    reached_V = cut_off + _ROUNDING_V
    has_ended = measured.voltage_V[-1] <= reached_V and measured.current_A[-1] > 0.0
    if not has_ended:
        alive = np.flatnonzero(voltage_V + cells.error_V > cut_off)
        if len(alive) == 0:
            raise ValueError(
                f"the estimate contradicts the record: no cell with q_mobile = {estimate.q_mobile:g} +- "
                f"{estimate.sd_q_mobile:.3g} C is still above {cut_off:g} V at its end. Estimate anew from this record."
            )
        if 2 * len(alive) < samples:
            notes.append(f"The record contradicts {1.0 - len(alive) / samples:.0%} of what the estimate takes to be possible.")
        chosen = np.where(np.isin(np.arange(samples), alive), np.arange(samples), rng.choice(alive, size=samples))
        cells, r_ohm = cells.select(chosen), r_ohm[chosen]
    # the first draw is for the capacity of the new cell alone
    draws = _drawn_loads(future_load, samples + 1, rng) if isinstance(future_load, RandomLoad) else [future_load]
    if has_ended:
        capacity_Ah = (1.0 - cells.soc) * cells.q_mobile / 3600.0
        ends = EndsOfDischarge(np.zeros(samples), capacity_Ah, np.zeros(1), np.full((len(BAND), 1), cut_off))
        above = np.flatnonzero(measured.voltage_V > reached_V)
        around = [above[-1] + 1, above[-1]] if len(above) else [0]
        now_s = float(np.interp(cut_off, measured.voltage_V[around], measured.time_s[around]))
    else:
        now_s = float(measured.time_s[-1])
        ends = simulate_to_cut_off(cells, model, draws[-samples:], cut_off, every_s=10.0)
    if nominal_Ah is None:
        # the mean over draws, as the state of health must not depend on a single draw; a draw that only charges has no end
        new_Ah = new_model.capacity_Ah(draws[:_NOMINAL_DRAWS], cut_off)
        nominal_Ah = float(new_Ah[new_Ah > 0.0].mean()) if (new_Ah > 0.0).any() else float("nan")
    return Forecast(
        record=measured,
        load_name=load_name,
        cut_off_V=float(cut_off),
        eod_time_s=now_s + ends.time_s,
        soc=cells.soc,
        q_mobile=cells.q_mobile,
        resistance_10s_ohm=_resistance_10s_ohm(estimate, r_ohm),
        r_o=r_ohm,
        capacity_Ah=ends.capacity_Ah,
        nominal_Ah=float(nominal_Ah),
        time_s=now_s + ends.course_s,
        voltage_V=ends.course_V,
        notes=tuple(notes),
    )


def _check_arguments(mismatch_V: float, cut_off_V: float, nominal_Ah: float | None, samples: int, seed: int) -> None:
    check_not_negative(mismatch_V=mismatch_V)
    check_positive("cut_off_V", cut_off_V)
    if nominal_Ah is not None:
        check_positive("nominal_Ah", nominal_Ah)
    check_whole_number("samples", samples, 1)
    check_whole_number("seed", seed, 0)


def _notes(estimate: Estimate, record: Samples, goes_on_varied: bool) -> list[str]:
    notes = []
    if not np.isfinite([estimate.sd_q_mobile, estimate.sd_r_o]).all():
        notes.append("The estimate states no standard deviation of all its parameters: the interval leaves theirs out.")
    if goes_on_varied:
        sd_A = expected_current(record.time_s, record.current_A).sd_A
        notes.append(
            f"The load varied: its means over quarters of the record lie {sd_A:.2g} A apart (root mean square). "
            "The interval is that of a load that goes on so, not of one that drifts elsewhere. Give the load if it is known."
        )
    if not estimate.settled and is_only_imprecise(estimate.findings):
        notes.append(
            f"The record alone does not tell both numbers yet, as before a knee: the interval counts that. {estimate.reason}"
        )
    elif not estimate.settled:
        notes.append(f"The estimate is not settled. {estimate.reason}".strip())
    return notes


def _future_load(
    load: LoadToCome | None, unit: LoadUnit, record: Samples, model: RecordModel
) -> tuple[KnownLoad | RandomLoad, str]:
    """Return the load to come, and its name."""
    if load is None:
        expected = expected_current(record.time_s, record.current_A)
        if expected.is_varying:
            return BlockBootstrap(record, steadier_unit(record), dt_s=model.dt_s), "a load as so far"
        load, unit = expected.mean_A, "current"
    if isinstance(load, RandomLoad):
        return load, "a random load"
    future_load = known_load(load, unit)
    if isinstance(load, (Load, Cycle)):
        return future_load, "a cycle" if isinstance(load, Cycle) else "a given load"
    return future_load, "a given load" if callable(load) else f"{load:g} {LOAD_UNIT_SYMBOLS[unit]}"


def _drawn_loads(load: RandomLoad, count: int, rng: np.random.Generator) -> list[KnownLoad]:
    name, draws = type(load).__name__, [load(rng) for _ in range(count)]
    unsuitable = [drawn for drawn in draws if not isinstance(drawn, KnownLoad)]
    if unsuitable:
        raise TypeError(
            f"a draw of {name} must be a load of battery_env.loads, such as a Load or a Cycle, got {unsuitable[0]!r}. Lay a "
            "function of time out: Load(time_s, function(time_s), unit)."
        )
    units = sorted({drawn.unit for drawn in draws})
    if len(units) > 1:
        raise ValueError(f"the draws of {name} must all have the same unit, got {' and '.join(units)}")
    return list(draws)


def _draw_parameters(
    model: RecordModel,
    current_A: FloatArray,
    estimate: Estimate,
    mismatch_V: float,
    samples: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Draw both parameters, and the resistance under other loads, which includes the whole error of the model."""
    q_C, r_ohm = float(Q_MOBILE.check(estimate.q_mobile)), float(R_O.check(estimate.r_o))
    if np.inf in (estimate.sd_q_mobile, estimate.sd_r_o):
        raise ValueError(
            "this estimate determines nothing (its standard deviation is infinite): record on, or give its calibrator a prior"
        )
    share, sd_ohm = np.nan_to_num([estimate.sd_q_mobile / q_C, estimate.sd_r_o])
    if share < 0.0 or sd_ohm < 0.0:
        raise ValueError(f"standard deviations must be at least 0, got {estimate!r}")
    least_C = max(model.least_q_mobile_C(current_A), Q_MOBILE.limits[0])
    low, high = np.log([least_C / q_C, Q_MOBILE.limits[1] / q_C])
    if low > _CONTRADICTION_SD * share:
        raise ValueError(
            f"the estimate contradicts the record, which takes a q_mobile of at least {least_C:.6g} C: got {q_C:.6g} +- "
            f"{share * q_C:.3g} C. Estimate anew from this record."
        )
    deviation = np.zeros(samples)
    if share > 0.0:
        # the lower bound takes no probability to the upper half
        least, most = ndtr([low / share, high / share])
        middle = 0.5 if least < 0.5 else 0.5 * (least + most)
        chance = rng.uniform(-1.0, 1.0, samples)
        deviation = ndtri(middle + chance * np.where(chance < 0.0, middle - least, most - middle))
    # at the measured voltage a larger q_mobile comes with a larger r_o
    _, by_q, by_r = model.sensitivities(current_A, max(q_C, 1.01 * least_C), r_ohm)
    is_finite = np.isfinite(by_q) & np.isfinite(by_r)
    squares = float(by_r[is_finite] @ by_r[is_finite])
    slope_ohm = -share * q_C * float(by_r[is_finite] @ by_q[is_finite]) / squares if squares > 0.0 else 0.0
    slope_ohm = float(np.clip(slope_ohm, -sd_ohm, sd_ohm))
    conditional_ohm = float(np.sqrt(sd_ohm**2 - slope_ohm**2))
    # the part of the model error that r_o has absorbed appears under another current
    of_model_ohm = mismatch_V / float(np.sqrt(np.mean(current_A**2))) if current_A.any() else 0.0
    total_ohm = float(np.hypot(conditional_ohm, np.sqrt(UNFITTED_ERROR_RATIO**2 - 1.0) * of_model_ohm))
    draws, middle_ohm = rng.standard_normal(samples), r_ohm + slope_ohm * deviation
    r_o, acting_ohm = (np.clip(middle_ohm + each_ohm * draws, *R_O.limits) for each_ohm in (conditional_ohm, total_ohm))
    return q_C * np.exp(share * deviation), r_o, acting_ohm


def _resistance_10s_ohm(estimate: Estimate, r_ohm: FloatArray) -> FloatArray:
    """Return resistances after ten seconds that deviate from the estimate as ``r_o`` does, in standard deviations."""
    is_stated = estimate.sd_r_o > 0.0
    deviation_sd = (r_ohm - estimate.r_o) / estimate.sd_r_o if is_stated else np.zeros_like(r_ohm)
    return np.asarray(estimate.resistance_10s_ohm + np.nan_to_num(estimate.sd_resistance_10s_ohm) * deviation_sd)


def _cells_at_the_end(
    record: Samples,
    model: RecordModel,
    current_A: FloatArray,
    parameters: tuple[FloatArray, FloatArray],
    mismatch_V: float,
    rng: np.random.Generator,
) -> tuple[Cells, FloatArray]:
    """Return cells with drawn parameters and errors at the end of a record, and their last voltage (NaN: empty)."""
    steps, count = len(current_A) - 1, len(parameters[0])
    measured_V = np.interp(record.time_s[0] + model.dt_s * np.arange(steps + 1), record.time_s, record.voltage_V)
    last = slice(min(int((1.0 - RECENT_SHARE) * steps), steps - 1) + 1, None)
    at_first = Cells(*parameters, model.start(parameters[0]), np.zeros(count), np.zeros(count))
    cells, run_V = simulate_current(at_first, model, current_A[:-1], steps - last.start)
    recent_V = np.mean(measured_V[last] - run_V, axis=1)
    # the voltage measured is noisy
    samples = max(int((record.time_s >= record.time_s[-1] - RECENT_SHARE * np.ptp(record.time_s)).sum()), 1)
    variance_V2, of_noise_V2 = mismatch_V**2, white_noise_V(record.voltage_V) ** 2 / samples
    share = variance_V2 / (variance_V2 + of_noise_V2) if variance_V2 > 0.0 else 0.0
    draws = rng.standard_normal((2, count))
    error_V = share * recent_V + mismatch_V * np.sqrt(1.0 - share) * draws[0]
    return cells._replace(error_V=error_V, drift_V=mismatch_V * draws[1]), run_V[:, -1]
