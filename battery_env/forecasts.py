"""When a cell will be discharged under the load to come, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.stats import truncnorm

from battery_env.arrays import BoolArray, FloatArray, IntArray
from battery_env.checks import LOAD_UNIT_SYMBOLS, LoadUnit, check_load, check_numbers, check_positive, check_whole_number
from battery_env.electrochemistry import state_of_charge, step_into, voltage_into
from battery_env.estimates import Estimate
from battery_env.estimators.base import is_overfull, overfull_error
from battery_env.estimators.settling import white_noise_V
from battery_env.loads import BlockBootstrap, Cycle, KnownLoad, Load, RandomLoad, constant, in_steps, steadier_unit
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.plotting import COLOURS, new_figure
from battery_env.record_model import RecordModel
from battery_env.records import Record, Samples, check_record, expected_current

#: What a load to come can be given as.
FutureLoad = float | KnownLoad | RandomLoad | Callable[[FloatArray], ArrayLike]

#: The ends and the middle of the intervals that are shown: nine of ten outcomes lie between the outer two.
BAND = (0.05, 0.5, 0.95)

#: The error of the model shortly before the end of a record is the mean over this share of the record.
_RECENT_SHARE = 0.1
#: It drifts with this constant, as a share of ``q_mobile``: the model is wrong in another way at another charge. That is how
#: fast the residuals of whole discharges of B0005 lose their correlation.
_MEMORY_SHARE = 0.15
# Loads are laid out, and cells that have ended are left out, after so many steps.
_CHUNK_STEPS = 256
# The course of the voltage is kept about this often, s.
_COURSE_S = 10.0
# The last voltage of a record may be the cut-off but for rounding, V.
_ROUNDING_V = 1e-6
# The capacity of a new cell under a random load is the mean of so many draws, which makes it sure to 1 %.
_NOMINAL_DRAWS = 100
# An estimate this many standard deviations below what the record takes out of the cell contradicts the record.
_CONTRADICTION_SD = 5.0


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    What :func:`forecast` expects of a discharge in progress: n samples of what may come, all equally likely.

    :param record: the discharge so far
    :param load_name: the load to come, in words
    :param cut_off_V: where the discharge ends, V
    :param eod_time_s: end of discharge, on the clock of the record, s, shape (n,); infinite where it is not reached
    :param soc: state of charge at the end of the record: the share of ``q_mobile`` left in the negative electrode, shape (n,)
    :param q_mobile: charge that can move, C, shape (n,)
    :param r_o: ohmic resistance, ohm, shape (n,)
    :param capacity_Ah: charge given from full to the end of discharge, which is the capacity at this load, Ah, shape (n,).
        Where the record starts partly charged (``initial_soc`` of the model), what was missing then is added; NaN where the
        end is not reached
    :param nominal_Ah: capacity of the cell when new, Ah
    :param time_s: from the end of the record on, on its clock, s, shape (K,)
    :param voltage_V: quantiles :data:`BAND` of the voltage then, V, shape (3, K); a discharge that has ended counts as at
        the cut-off
    :param notes: what a reader should know of this forecast, sentences
    """

    record: Samples
    load_name: str
    cut_off_V: float
    eod_time_s: FloatArray
    soc: FloatArray
    q_mobile: FloatArray
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
        return _quantile(self.eod_time_s, probability)

    def summary(self) -> str:
        """
        The forecast in a readable form.

        :return: a text of several lines
        """
        rows = {
            "end of discharge (s)": (self.eod_time_s, "10.0f"),
            "remaining time (s)": (self.remaining_s, "10.0f"),
            "state of charge now (%)": (100.0 * self.soc, "10.1f"),
            "q_mobile (C)": (self.q_mobile, "10.0f"),
            "r_o (ohm)": (self.r_o, "10.4f"),
            "capacity (Ah)": (self.capacity_Ah, "10.3f"),
            f"state of health (% of {self.nominal_Ah:.3f} Ah)": (100.0 * self.state_of_health, "10.1f"),
        }
        head = "".join(f"{'median' if p == 0.5 else f'{100.0 * p:g} %':>10}" for p in BAND)
        lines = [
            f"Discharge to {self.cut_off_V:g} V, {self.now_s:.0f} s seen, then {self.load_name} ({len(self.soc)} samples)",
            f"  {'':<34}{head}",
        ]
        for name, (values, form) in rows.items():
            lines.append(f"  {name:<34}" + "".join(f"{value:{form}}" for value in _quantile(values, BAND)))
        return "\n".join([*lines, *self.notes])

    def plot(self) -> Figure:
        """
        The voltage of the record and the one to expect, with the interval of the end of discharge.

        :return: the figure
        """
        figure = new_figure(6.4, 3.6)
        axes = figure.subplots()
        low_s, median_s, high_s = self.eod_quantile_s()
        inside = f"{100.0 * (BAND[2] - BAND[0]):.0f} %"
        axes.plot(self.record.time_s, self.record.voltage_V, ".", ms=2.5, color="0.6", label="measured")
        axes.fill_between(self.time_s, *self.voltage_V[[0, 2]], color=COLOURS[0], alpha=0.25, lw=0, label=f"voltage, {inside}")
        axes.plot(self.time_s, self.voltage_V[1], color=COLOURS[0], lw=1.4, label="voltage, median")
        axes.axhline(self.cut_off_V, color="0.6", lw=0.8)
        if np.isfinite(high_s):
            axes.axvspan(low_s, high_s, color=COLOURS[1], alpha=0.2, lw=0, label=f"end of discharge, {inside}")
            axes.axvline(median_s, color=COLOURS[1], lw=1.2)
        axes.set(xlabel="time (s)", ylabel="voltage (V)")
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=9, loc="lower left")
        return figure


def forecast(
    record: Record,
    estimate: Estimate,
    load: FutureLoad | None = None,
    cut_off_V: float | None = None,
    *,
    load_unit: LoadUnit = "current",
    model: RecordModel | None = None,
    mismatch_V: float = 0.05,
    nominal_Ah: float | None = None,
    samples: int = 1000,
    seed: int = 0,
    max_duration_s: float = 86_400.0,
) -> Forecast:
    """
    The end of a discharge in progress, under a load to come, with what is not known of it.

    Each sample is a cell with its own parameters, its own error of the model, and its own load if that is random. All follow
    the record and then the load, down to the cut-off.

    *Parameters* are drawn from the estimate and its standard deviations: ``q_mobile`` log-normal, above what the record has
    already taken out of the cell; ``r_o`` normal, with the correlation that the voltage of this record gives it with
    ``q_mobile``. Standard deviations of NaN count as zero, and ``notes`` say so.

    *The error of the model* has the standard deviation ``mismatch_V``. Shortly before the end of the record it is the mean
    difference between measured voltage and that of the sample, so that samples of any resistance agree with what was
    measured. From there it drifts with the charge that is drawn. Samples that would have reached the cut-off within the
    record are replaced by others.

    *The load.* Without ``load`` the discharge goes on as before: at its last current if that was constant (none, if it was
    switched off), and otherwise in blocks of the record (:class:`battery_env.loads.BlockBootstrap`), of its current or of its
    power, whichever is steadier between the switches of the load.

    :param record: one discharge from its first sample to now, of a cell that was full unless ``model`` says otherwise
    :param estimate: of any calibrator, best with its standard deviations
    :param load: from the end of the record on: a number; a profile, ``Load(time_s, value, unit)``; a ``Cycle``; a function
        of time in s that takes an array; or a ``RandomLoad``, of which each sample draws its own. ``None``: as above. Over
        each time step of the model the mean of the load flows, and of a function its value at the start of the step
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the ``VEOD`` of the model's cell
    :param load_unit: of a number or a function: ``"power"`` in W or ``"current"`` in A. Other loads have their own
    :param model: the model that the estimate belongs to, ``LeastSquares(...).model``; ``None``: ``RecordModel()``
    :param mismatch_V: error to expect of the model, V; 0.05 V suits the bundled real cells, 0 simulated ones without mismatch
    :param nominal_Ah: capacity that counts as a state of health of 1, Ah; ``None``: the charge that the model's cell, with
        its own ``q_mobile`` and ``r_o``, gives from full under the load to come, on average where that is random
    :param samples: how many
    :param seed: seed of all that is drawn
    :param max_duration_s: where to stop if the discharge does not end by itself, s
    :return: the samples, with quantiles, a summary and a plot
    :raises TypeError: for a load of another type
    :raises ValueError: for an argument out of range, an estimate that the record contradicts, or a load that charges the cell
        beyond full
    """
    model = RecordModel() if model is None else model
    cell = model.cell
    cut_off = cell.VEOD if cut_off_V is None else cut_off_V
    if not 0.0 <= mismatch_V < np.inf:
        raise ValueError(f"mismatch_V must be finite and at least 0 V, got {mismatch_V!r}")
    if not 0.0 < cut_off < np.inf:
        raise ValueError(f"cut_off_V must be a positive voltage in V, got {cut_off_V!r}")
    for name, value in (("max_duration_s", max_duration_s), ("nominal_Ah", nominal_Ah)):
        if value is not None:
            check_positive(name, value)
    if check_whole_number("samples", samples) < 1 or check_whole_number("seed", seed) < 0:
        raise ValueError(f"samples must be at least 1 and seed at least 0, got {samples!r} and {seed!r}")
    seen = check_record(record, least_samples=2)
    rng = np.random.default_rng(seed)
    to_come, load_name = _to_come(load, load_unit, seen, model)
    notes = []
    if not np.isfinite([estimate.sd_q_mobile, estimate.sd_r_o]).all():
        notes.append("The estimate states no standard deviation of all its parameters: the interval leaves theirs out.")
    if load is None and isinstance(to_come, RandomLoad):
        expected = expected_current(seen.time_s, seen.current_A)
        notes.append(
            f"The load varied: its means over quarters of the record lie {expected.sd_A:.2g} A apart (root mean square). "
            "The interval is that of a load that goes on so, not of one that drifts elsewhere. Give the load if it is known."
        )
    if not estimate.settled:
        notes.append(f"The estimate is not settled. {estimate.reason}".strip())

    _, current_A = model.grid(seen)
    q_mobile, r_o = _draw_parameters(model, current_A[:-1], estimate, samples, rng)
    cells = _Cells(model, q_mobile, r_o)
    recent = _follow(cells, seen, current_A[:-1])
    error = _ModelError.drawn(recent, seen, mismatch_V, rng)
    over = seen.voltage_V[-1] <= cut_off + _ROUNDING_V and seen.current_A[-1] > 0.0
    if not over:
        alive = np.flatnonzero(cells.voltage() + error.now_V > cut_off)
        if len(alive) == 0:
            raise ValueError(
                f"the estimate contradicts the record: no cell with q_mobile = {estimate.q_mobile:g} +- "
                f"{estimate.sd_q_mobile:.3g} C is still above {cut_off:g} V at its end. Estimate anew from this record."
            )
        if 2 * len(alive) < samples:
            notes.append(f"The record contradicts {1.0 - len(alive) / samples:.0%} of what the estimate takes to be possible.")
        chosen = np.arange(samples)
        chosen = np.where(np.isin(chosen, alive), chosen, rng.choice(alive, size=samples))
        cells, error = cells.part(chosen), error.part(chosen)
    soc = cells.soc()
    # the first draw is that of the new cell alone
    draws = _draws(to_come, samples + 1, rng) if isinstance(to_come, RandomLoad) else [to_come]
    if nominal_Ah is None:
        nominal_Ah = _nominal_Ah(model, draws[:_NOMINAL_DRAWS], cut_off, max_duration_s)
    if over:
        ends = _Ends(np.zeros(samples), soc, np.zeros(1), np.full((len(BAND), 1), cut_off))
        above = np.flatnonzero(seen.voltage_V > cut_off + _ROUNDING_V)
        around = [above[-1] + 1, above[-1]] if len(above) else [0]
        now_s = float(np.interp(cut_off, seen.voltage_V[around], seen.time_s[around]))
    else:
        ends, now_s = _discharge(cells, error, draws[-samples:], cut_off, max_duration_s), float(seen.time_s[-1])
    return Forecast(
        record=seen,
        load_name=load_name,
        cut_off_V=float(cut_off),
        eod_time_s=now_s + ends.time_s,
        soc=soc,
        q_mobile=cells.q_mobile,
        r_o=cells.r_o,
        capacity_Ah=(1.0 - ends.soc) * cells.q_mobile / 3600.0,
        nominal_Ah=float(nominal_Ah),
        time_s=now_s + ends.course_s,
        voltage_V=ends.course_V,
        notes=tuple(notes),
    )


def _quantile(values: FloatArray, probability: ArrayLike) -> FloatArray:
    # of the samples themselves: between two of them there is no number if one is infinite
    return np.asarray(np.quantile(values, np.asarray(probability, dtype=np.float64), method="inverted_cdf"))


class _Function:
    """A function of time as a load."""

    def __init__(self, function: Callable[[FloatArray], ArrayLike], unit: LoadUnit) -> None:
        self.function, self.unit = function, unit

    def __call__(self, time_s: FloatArray) -> FloatArray:
        values = check_load(self.function(time_s), self.unit)
        if values.shape not in ((), time_s.shape):
            raise ValueError(f"load must return one value for each time, shape {time_s.shape}, got shape {values.shape}")
        return np.broadcast_to(values, time_s.shape)


_Known = KnownLoad | _Function


def _to_come(load: FutureLoad | None, unit: LoadUnit, record: Samples, model: RecordModel) -> tuple[_Known | RandomLoad, str]:
    """The load to come, and its name."""
    if load is None:
        expected = expected_current(record.time_s, record.current_A)
        if expected.varied:
            return BlockBootstrap(record, steadier_unit(record), dt_s=model.dt_s), "a load as so far"
        load, unit = expected.mean_A, "current"
    if isinstance(load, (KnownLoad, RandomLoad)):
        return load, {Load: "a given load", Cycle: "a cycle"}.get(type(load), "a random load")
    if callable(load):
        return _Function(load, unit), "a given load"
    value = check_numbers("load", load)
    if value.ndim:
        raise TypeError(
            f"load must be a number, a function of time or a load of battery_env.loads, got an array of shape {value.shape}. "
            "Give Load(time_s, value, unit), with time_s from 0 at the end of the record."
        )
    return constant(float(value), unit), f"{value:g} {LOAD_UNIT_SYMBOLS[unit]}"


def _draws(load: RandomLoad, count: int, rng: np.random.Generator) -> list[_Known]:
    name, draws = type(load).__name__, [load(rng) for _ in range(count)]
    others = [drawn for drawn in draws if not isinstance(drawn, KnownLoad)]
    if others:
        raise TypeError(
            f"a draw of {name} must be a load of battery_env.loads, such as a Load or a Cycle, got {others[0]!r}. Lay a "
            "function of time out: Load(time_s, function(time_s), unit)."
        )
    units = sorted({drawn.unit for drawn in draws})
    if len(units) > 1:
        raise ValueError(f"the draws of {name} must all have the same unit, got {' and '.join(units)}")
    return list(draws)


def _nominal_Ah(model: RecordModel, loads: list[_Known], cut_off_V: float, max_duration_s: float) -> float:
    """The capacity of the model's cell, its mean over loads: under a single draw, health would be a matter of that draw."""
    given = [model.capacity_Ah(in_steps(load, model.dt_s), load.unit, cut_off_V, max_duration_s) for load in loads]
    reached = [each_Ah for each_Ah in given if each_Ah > 0.0]  # no charge takes a full cell to its end
    return float(np.mean(reached)) if reached else float("nan")


def _draw_parameters(
    model: RecordModel, current_A: FloatArray, estimate: Estimate, samples: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
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
        deviation = truncnorm.rvs(low / share, high / share, size=samples, random_state=rng)
    # at a given voltage a larger q_mobile goes with a larger r_o
    _, by_q, by_r = model.sensitivities(current_A, max(q_C, 1.01 * least_C), r_ohm)
    known = np.isfinite(by_q) & np.isfinite(by_r)
    squares = float(by_r[known] @ by_r[known])
    slope_ohm = -share * q_C * float(by_r[known] @ by_q[known]) / squares if squares > 0.0 else 0.0
    slope_ohm = float(np.clip(slope_ohm, -sd_ohm, sd_ohm))
    own_ohm = np.sqrt(sd_ohm**2 - slope_ohm**2)
    r_o = r_ohm + slope_ohm * deviation + own_ohm * rng.standard_normal(samples)
    return q_C * np.exp(share * deviation), np.clip(r_o, *R_O.limits)


class _Cells:
    """Cells that are simulated side by side."""

    def __init__(self, model: RecordModel, q_mobile: FloatArray, r_o: FloatArray, state: FloatArray | None = None) -> None:
        self.model, self.q_mobile, self.r_o = model, q_mobile, r_o
        self.state = model.start(q_mobile) if state is None else state

    def part(self, chosen: IntArray | BoolArray) -> _Cells:
        return _Cells(self.model, self.q_mobile[chosen], self.r_o[chosen], self.state[chosen])

    def voltage(self) -> FloatArray:
        out = np.empty(len(self.q_mobile))
        voltage_into(out, self.state, self.q_mobile, self.model.cell.packed)
        return out

    def step(self, load: FloatArray, unit: LoadUnit) -> None:
        model = self.model
        step_into(self.state, self.state, load, self.q_mobile, self.r_o, model.dt_s, unit, model.thermal, model.cell.packed)

    def soc(self) -> FloatArray:
        return state_of_charge(self.state, self.q_mobile)


def _follow(cells: _Cells, record: Samples, current_A: FloatArray) -> FloatArray:
    """Take cells through a record. How far below the measured voltage theirs is in the last part of it, V, shape (n,)."""
    dt_s, steps = cells.model.dt_s, len(current_A)
    measured_V = np.interp(record.time_s[0] + dt_s * np.arange(steps + 1), record.time_s, record.voltage_V)
    first = min(int((1.0 - _RECENT_SHARE) * steps), steps - 1)
    residual_V = np.zeros(len(cells.q_mobile))
    for k in range(steps):
        cells.step(np.full(len(cells.q_mobile), current_A[k]), "current")
        if k >= first:
            residual_V += measured_V[k + 1] - cells.voltage()
    return residual_V / (steps - first)


@dataclass(frozen=True)
class _ModelError:
    """What is added to the voltage of each cell: known at the end of the record, and less and less from there."""

    now_V: FloatArray
    mismatch_V: float
    other: FloatArray  # standard normal: how it drifts

    @classmethod
    def drawn(cls, recent_V: FloatArray, record: Samples, mismatch_V: float, rng: np.random.Generator) -> _ModelError:
        """
        The error of the model at the end of a record, from the mean difference to the voltage measured, which is noisy.
        """
        count = max(int((record.time_s >= record.time_s[-1] - _RECENT_SHARE * np.ptp(record.time_s)).sum()), 1)
        variance_V2, of_noise_V2 = mismatch_V**2, white_noise_V(record.voltage_V) ** 2 / count
        share = variance_V2 / (variance_V2 + of_noise_V2) if variance_V2 > 0.0 else 0.0
        draws = rng.standard_normal((2, len(recent_V)))
        return cls(share * recent_V + mismatch_V * np.sqrt(1.0 - share) * draws[0], mismatch_V, draws[1])

    def part(self, chosen: IntArray | BoolArray) -> _ModelError:
        return _ModelError(self.now_V[chosen], self.mismatch_V, self.other[chosen])

    def after(self, drawn_share: FloatArray) -> FloatArray:
        # what the last voltages showed stays, as an error of r_o would; what the error is beside that changes
        memory = np.exp(-np.maximum(drawn_share, 0.0) / _MEMORY_SHARE)
        return self.now_V + self.mismatch_V * np.sqrt(1.0 - memory**2) * self.other


class _Ends(NamedTuple):
    time_s: FloatArray  # of each cell, since the start; infinite if it does not end
    soc: FloatArray  # then; NaN likewise
    course_s: FloatArray
    course_V: FloatArray  # quantiles of all cells


def _discharge(cells: _Cells, error: _ModelError, loads: list[_Known], cut_off_V: float, max_duration_s: float) -> _Ends:
    """Take cells down to the cut-off; ``loads``: one for all, or one a cell."""
    dt_s, unit, count = cells.model.dt_s, loads[0].unit, len(cells.q_mobile)
    steps, every = int(max_duration_s / dt_s + 1e-9), max(round(_COURSE_S / dt_s), 1)
    # cells whose load is off for ever are followed no longer than the others
    off = np.broadcast_to([isinstance(load, Load) and not (load.value > 0.0).any() for load in loads], count)
    time_s, end_soc, shown_V = np.full(count, np.inf), np.full(count, np.nan), np.empty(count)
    course: list[tuple[float, FloatArray]] = []
    index, going = np.arange(count), np.ones(count, dtype=np.bool_)
    first_soc = last_soc = cells.soc()
    last_V = np.full(count, np.inf)
    for k in range(steps + 1):
        if k % _CHUNK_STEPS == 0:
            cells, error, index = cells.part(going), error.part(going), index[going]
            first_soc, last_soc, last_V, off = first_soc[going], last_soc[going], last_V[going], off[going]
            if len(loads) > 1:
                loads = [loads[n] for n in np.flatnonzero(going)]
            going = np.ones(len(index), dtype=np.bool_)
            times_s = dt_s * np.arange(k, k + _CHUNK_STEPS, dtype=np.float64)
            profiles = np.array([in_steps(load, dt_s)(times_s) for load in loads])
        soc = cells.soc()
        if (going & is_overfull(soc, first_soc)).any():
            raise overfull_error(dt_s * k)
        voltage_V = cells.voltage() + error.after(first_soc - soc)
        ended = np.flatnonzero(going & ~(voltage_V > cut_off_V))
        if len(ended):
            fall_V = last_V[ended] - voltage_V[ended]
            # a cell that has no voltage is empty: until this step it was above
            share = np.where(np.isfinite(fall_V), (last_V[ended] - cut_off_V) / fall_V, 1.0) if k else np.zeros(len(ended))
            time_s[index[ended]] = dt_s * (k - 1 + share) if k else 0.0
            end_soc[index[ended]] = last_soc[ended] + share * (soc[ended] - last_soc[ended])
            going[ended] = False
        is_over = not (going & ~off).any()
        if k % every == 0 or is_over:
            shown_V[:] = cut_off_V
            shown_V[index[going]] = voltage_V[going]
            course.append((dt_s * k, _quantile(shown_V, BAND)))
        if is_over:
            break
        last_V, last_soc = voltage_V, soc
        load = profiles[:, k % _CHUNK_STEPS]
        cells.step(np.array(np.broadcast_to(load, index.shape)), unit)
    return _Ends(time_s, end_soc, np.array([at_s for at_s, _ in course]), np.array([volts for _, volts in course]).T)
