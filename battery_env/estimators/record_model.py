"""The model under the current of a record: what it shows, and how that depends on both parameters, by exact derivatives."""

from __future__ import annotations

from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from battery_env.cells import SWITCH_SHARE, check_record, drawn_charge_C, resample_current
from battery_env.electrochemistry import (
    FULL_CHARGE_SHARES,
    NEW_CELL,
    Q_MOBILE_LIMITS_C,
    QNB,
    STATE_SIZE,
    CellParameters,
    Trajectory,
    check_dt,
    initial_state,
    simulate,
)
from battery_env.estimators.base import Record
from battery_env.kernels import FloatArray, cell_step, cell_voltage, mole_fraction, nominal_overpotentials, polynomial

#: A load whose current spreads by more than this share (from the 5th to the 95th percentile) has varied.
VARIED_SHARE = 0.05

# The total of the four charges is q_mobile / 0.6 at all times.
_Q_PER_CHARGE = 1.0 / float(FULL_CHARGE_SHARES.sum())


@njit(cache=True, error_model="numpy")
def equilibrium_slopes(
    xn: float, xp: float, tb: float, constants: FloatArray, c: int, slope_n: FloatArray, slope_p: FloatArray
) -> tuple[float, float]:
    # of kernels.equilibrium_voltage with respect to xn and xp; slope_n and slope_p: derivatives of its polynomials
    nernst = constants[c, 3] * tb
    by_xn = nernst / (xn * (1.0 - xn)) - 2.0 * polynomial(slope_n, 2.0 * xn - 1.0)
    by_xp = 2.0 * polynomial(slope_p, 2.0 * xp - 1.0) - nernst / (xp * (1.0 - xp))
    return by_xn, by_xp


@njit(cache=True, error_model="numpy")
def overpotential_slopes(i: float, xn: float, xp: float, tb: float, constants: FloatArray, c: int) -> tuple[float, float]:
    # of kernels.nominal_overpotentials, each with respect to the mole fraction of its own electrode
    thermal_voltage = constants[c, 3] * tb * constants[c, 4]
    an, wn = i * constants[c, 5], (1.0 - xn) * xn
    ap, wp = i * constants[c, 6], (1.0 - xp) * xp
    by_xn = thermal_voltage * an * (xn - 0.5) / (wn * sqrt(wn + an * an))
    by_xp = thermal_voltage * ap * (xp - 0.5) / (wp * sqrt(wp + ap * ap))
    return by_xn, by_xp


@njit(cache=True, error_model="numpy")
def _diffuse(bulk: float, surface: float, dt: float, constants: FloatArray) -> tuple[float, float]:
    # what one step makes of the derivatives of the charges of one electrode; the current does not depend on parameters
    moved = dt * (bulk * constants[0, 1] - surface * constants[0, 2])
    return bulk - moved, surface + moved


@njit(cache=True, error_model="numpy")
def _roll_out_with_sensitivities(
    current: FloatArray,
    q: float,
    r_o: float,
    dt: float,
    thermal: bool,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    slope_n: FloatArray,
    slope_p: FloatArray,
    start: FloatArray,
    shares: FloatArray,
    voltage: FloatArray,
    by_q: FloatArray,
    by_r: FloatArray,
) -> None:
    # Fills voltage and its derivatives up to the last sample at which the model has a voltage. tb_q is the derivative of tb
    # with respect to q, and so on; without heat r_o moves nothing but vo.
    x = np.empty((1, start.shape[0]))
    x[0] = start
    qnb_q, qns_q, qpb_q, qps_q = shares[0], shares[1], shares[2], shares[3]
    tb_q, vsn_q, vsp_q = 0.0, 0.0, 0.0
    tb_r, vo_r, vsn_r, vsp_r = 0.0, 0.0, 0.0, 0.0
    for k in range(current.shape[0]):
        volts = cell_voltage(x, 0, q, False, constants, 0, poly_n, poly_p)
        if np.isnan(volts):
            return
        i, tb = current[k], x[0, 0]
        xn, xp = mole_fraction(x[0, 5], q, False, constants, 0), mole_fraction(x[0, 7], q, False, constants, 0)
        xn_q = mole_fraction(qns_q, q, False, constants, 0) - xn / q
        xp_q = mole_fraction(qps_q, q, False, constants, 0) - xp / q
        v_xn, v_xp = equilibrium_slopes(xn, xp, tb, constants, 0, slope_n, slope_p)
        voltage[k] = volts
        by_q[k] = v_xn * xn_q + v_xp * xp_q - vsn_q - vsp_q
        by_r[k] = -vo_r - vsn_r - vsp_r
        vsn_xn, vsp_xp = overpotential_slopes(i, xn, xp, tb, constants, 0)
        nominal_vsn_q, nominal_vsp_q = vsn_xn * xn_q, vsp_xp * xp_q
        if thermal:
            v_tb = constants[0, 3] * log((1.0 - xp) * xn / (xp * (1.0 - xn)))
            by_q[k] += v_tb * tb_q
            by_r[k] += v_tb * tb_r
            vsn, vsp = nominal_overpotentials(i, xn, xp, tb, constants, 0)
            nominal_vsn_q += vsn / tb * tb_q
            nominal_vsp_q += vsp / tb * tb_q
            heat_q, heat_r = (vsn_q + vsp_q) * i, (vo_r + vsn_r + vsp_r) * i
            vsn_r += dt * (vsn / tb * tb_r - vsn_r) * constants[0, 8]
            vsp_r += dt * (vsp / tb * tb_r - vsp_r) * constants[0, 9]
            tb_q += dt * (heat_q * constants[0, 11] - tb_q * constants[0, 12])
            tb_r += dt * (heat_r * constants[0, 11] - tb_r * constants[0, 12])
        vo_r += dt * (i - vo_r) * constants[0, 7]
        vsn_q += dt * (nominal_vsn_q - vsn_q) * constants[0, 8]
        vsp_q += dt * (nominal_vsp_q - vsp_q) * constants[0, 9]
        qnb_q, qns_q = _diffuse(qnb_q, qns_q, dt, constants)
        qpb_q, qps_q = _diffuse(qpb_q, qps_q, dt, constants)
        cell_step(x, 0, i, q, r_o, dt, thermal, False, constants, 0, x, 0)


@njit(cache=True, error_model="numpy")
def _least_q_mobile(
    current: FloatArray, q: float, full: float, dt: float, constants: FloatArray, start: FloatArray, shares: FloatArray
) -> float:
    # q is large enough for any record. A surface charge that is `charge` at q is charge + slope * (least - q) at least, and
    # must stay within 0 .. full * least
    x = np.empty((1, start.shape[0]))
    x[0] = start
    qnb_q, qns_q, qpb_q, qps_q = shares[0], shares[1], shares[2], shares[3]
    least = 0.0
    for k in range(current.shape[0]):
        moved_n, moved_p = x[0, 5] - qns_q * q, x[0, 7] - qps_q * q
        least = max(least, -moved_n / qns_q, moved_n / (full - qns_q), -moved_p / qps_q, moved_p / (full - qps_q))
        qnb_q, qns_q = _diffuse(qnb_q, qns_q, dt, constants)
        qpb_q, qps_q = _diffuse(qpb_q, qps_q, dt, constants)
        cell_step(x, 0, current[k], q, 0.0, dt, False, False, constants, 0, x, 0)
    return least


def _slopes(polynomial: FloatArray) -> FloatArray:
    """The coefficients of the derivative of a polynomial, as many as of the polynomial."""
    return np.append(polynomial[1:] * np.arange(1, len(polynomial)), 0.0)


class ExpectedCurrent(NamedTuple):
    """
    What a record lets expect of the current after its end.

    :param mean_A: current, A; 0 if the load was switched off and not on again
    :param varied: whether the load varied, so that ``mean_A`` is the mean of the last half of it and an assumption
    :param sd_A: how far means over quarters of the record lie from each other (standard deviation), A
    """

    mean_A: float
    varied: bool
    sd_A: float


def expected_current(time_s: ArrayLike, current_A: ArrayLike) -> ExpectedCurrent:
    """
    The current to expect after the end of a record: the last one of a constant load, and the mean over the last half of a load
    that varied by more than ``VARIED_SHARE``, pulses among them.

    :param time_s: times of the samples, s, shape (T,)
    :param current_A: positive in discharge, A, shape (T,)
    :return: the current and how sure it is
    """
    time, current = np.asarray(time_s, dtype=np.float64), np.asarray(current_A, dtype=np.float64)
    loaded = current > SWITCH_SHARE * np.abs(current).max()
    switches = np.flatnonzero(np.diff(loaded.astype(np.int64)) > 0)
    if not loaded.any() or not (loaded[-1] or len(switches) + loaded[0] > 1):
        return ExpectedCurrent(0.0, False, 0.0)
    first = int(np.flatnonzero(loaded)[0])
    low, high = np.quantile(current[first:], [0.05, 0.95])
    if first == len(time) - 1 or high - low <= VARIED_SHARE * high:
        return ExpectedCurrent(float(current[-1]), False, 0.0)
    ends_s = np.linspace(time[first], time[-1], 5)
    quarters_A = np.diff(drawn_charge_C(time, current, ends_s)) / np.diff(ends_s)
    return ExpectedCurrent(max(float(quarters_A[2:].mean()), 0.0), True, float(quarters_A.std(ddof=1)))


class RecordModel:
    """
    The model as it follows the current of a record: what calibration by the voltage of whole records rests on.

    :param cell: constants of the model; ``None``: the new cell's
    :param thermal: whether the temperature of the model moves
    :param dt_s: time step of the model, s
    :param initial: state of the model at the first sample, shape (8,). It stands for a history of the current: its charges
        move along with ``q_mobile``. ``None``: fully charged, at rest
    :raises ValueError: for an argument out of range
    """

    def __init__(
        self,
        cell: CellParameters | None = None,
        thermal: bool = False,
        dt_s: float = 1.0,
        initial: ArrayLike | None = None,
    ) -> None:
        self.cell = cell or NEW_CELL
        self.thermal = thermal
        self.dt_s = check_dt(dt_s, self.cell)
        reference_q_C = Q_MOBILE_LIMITS_C[1]
        self.initial = initial_state(reference_q_C, self.cell) if initial is None else np.array(initial, dtype=np.float64)
        if self.initial.shape != (STATE_SIZE,) or not np.isfinite(self.initial).all():
            raise ValueError(f"initial must hold {STATE_SIZE} finite numbers, got {initial!r}")
        packed = self.cell.packed
        self._constants = (*packed, _slopes(packed.polynomial_n), _slopes(packed.polynomial_p))

    def grid(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """
        A record on the time grid of the model, which starts at the first sample.

        :param record: one discharge
        :return: times of the samples since the first one, s, shape (T,); current over each step, A, shape (K,), such that
            the K points of the grid reach the last sample
        :raises ValueError: as :func:`battery_env.cells.check_record`
        """
        time_s, _, current_A = check_record(record.time_s, record.voltage_V, record.current_A, least_samples=2)
        n_steps = int(np.ceil((time_s[-1] - time_s[0]) / self.dt_s - 1e-6)) + 1
        return time_s - time_s[0], resample_current(time_s, current_A, self.dt_s, n_steps)

    def start(self, q_mobile: float) -> FloatArray:
        """
        The state at the first sample of a cell with the history that ``initial`` stands for.

        :param q_mobile: charge that can move, C
        :return: shape (8,)
        """
        start = self.initial.copy()
        start[QNB:] += (q_mobile - _Q_PER_CHARGE * start[QNB:].sum()) * FULL_CHARGE_SHARES
        return start

    def simulate(self, current_A: FloatArray, q_mobile: float, r_o: float) -> Trajectory:
        """
        What the model does under a current, with no cut-off.

        :param current_A: current over each step, A, shape (K,)
        :param q_mobile: charge that can move, C
        :param r_o: ohmic resistance, ohm
        :return: the samples down to where the model cell is empty, or all K of them
        """
        return simulate(
            current_A,
            q_mobile,
            r_o,
            dt=self.dt_s,
            load_unit="current",
            thermal=self.thermal,
            parameters=self.cell,
            initial=self.start(q_mobile),
            cut_off_V=-np.inf,
            max_duration_s=len(current_A) * self.dt_s,
        )

    def sensitivities(
        self, current_A: FloatArray, q_mobile: float, r_o: float, stride: int = 1
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        The voltage under a current and its derivatives with respect to both parameters; unchecked.

        :param current_A: current over each step, A, shape (K,)
        :param q_mobile: charge that can move, C
        :param r_o: ohmic resistance, ohm
        :param stride: steps of ``dt_s`` that ``current_A`` holds for: 1, or more for a coarse look
        :return: voltage, V, dV/dq_mobile, V/C, and dV/dr_o, A, each of shape (K,); NaN after the model cell is empty
        """
        columns = np.full((3, len(current_A)), np.nan)
        _roll_out_with_sensitivities(
            current_A,
            q_mobile,
            r_o,
            stride * self.dt_s,
            self.thermal,
            *self._constants,
            self.start(q_mobile),
            FULL_CHARGE_SHARES,
            *columns,
        )
        return columns[0], columns[1], columns[2]

    def least_q_mobile_C(self, current_A: FloatArray) -> float:
        """
        The ``q_mobile`` below which the model cell is empty before a current ends. At a fixed current its charges are linear
        in ``q_mobile``, so that one roll-out gives it exactly.

        :param current_A: current over each step, A, shape (K,)
        :return: C
        """
        q_C = Q_MOBILE_LIMITS_C[1]
        full = self.cell.VolSFraction / _Q_PER_CHARGE
        return float(
            _least_q_mobile(current_A, q_C, full, self.dt_s, self.cell.packed.constants, self.start(q_C), FULL_CHARGE_SHARES)
        )
