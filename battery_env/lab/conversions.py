"""From an estimate to what a test bench measures: a capacity at another load, the resistance of a pulse."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from battery_env.checks import LoadUnit, check_load, check_positive
from battery_env.electrochemistry import NEW_CELL
from battery_env.estimates import Estimate
from battery_env.loads import constant
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.records import CUT_OFF_V
from battery_env.records.model import RecordModel

# For its derivatives a capacity is computed again with q_mobile moved by this share, and r_o by this many ohm.
_STEP_SHARE, _STEP_OHM = 0.01, 0.002


class Derived(NamedTuple):
    """
    A quantity that follows from an estimate.

    :param value: in the unit that ends the name of the function
    :param sd: its standard deviation, in the same unit; NaN if the estimate states none
    """

    value: float
    sd: float


def capacity_Ah(
    estimate: Estimate,
    load: float,
    cut_off_V: float | None = None,
    *,
    load_unit: LoadUnit = "current",
    model: RecordModel | None = None,
) -> Derived:
    """
    Convert an estimate to the capacity at a constant load: the charge from full down to the cut-off.

    .. code-block:: python

      record = load_nasa_discharges("B0005")[99].loaded_part(cut_off_V=2.7)
      estimate = LeastSquares(thermal=True, mismatch_V=0.05).estimate(record)
      at_1_A = capacity_Ah(estimate, 1.0, cut_off_V=2.7, model=RecordModel(thermal=True))
      print(f"{at_1_A.value:.3f} +- {at_1_A.sd:.3f} Ah")

    The standard deviation is that of the estimate, to first order, with independent errors of ``q_mobile`` and ``r_o``. The
    errors of a fit offset each other at the load of its record, where the standard deviation is therefore too large. It does
    not hold the error of the model at a load that is far from that of the record.

    :param estimate: of any calibrator
    :param load: constant, above 0, in A, or with ``load_unit="power"`` in W
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the ``VEOD`` of the model's cell, 2.7 V if no
        ``model`` is given
    :param load_unit: ``"current"`` or ``"power"``
    :param model: the model that the estimate belongs to, ``RecordModel(cell, thermal)``; ``None``: ``RecordModel()``
    :return: Ah; NaN if the cut-off is not reached within a week
    :raises ValueError: for an argument out of range
    """
    model = RecordModel(NEW_CELL.replace(VEOD=CUT_OFF_V)) if model is None else model
    check_load(check_positive("load", load), load_unit)
    cut_off = check_positive("cut_off_V", model.cell.VEOD if cut_off_V is None else cut_off_V)
    q_C, r_ohm = float(Q_MOBILE.check(estimate.q_mobile)), float(R_O.check(estimate.r_o))

    step_C = _STEP_SHARE * q_C
    q_mobile, r_o = q_C + step_C * np.array([0.0, -1.0, 1.0, 0.0]), r_ohm + np.array([0.0, 0.0, 0.0, _STEP_OHM])
    value, less, more, of_r = model.capacity_Ah([constant(float(load), load_unit)], cut_off, q_mobile, r_o).tolist()
    by_q, by_r = (more - less) / (2.0 * step_C), (of_r - value) / _STEP_OHM
    return Derived(value, _sd(estimate, by_q, by_r))


def dc_resistance_ohm(
    estimate: Estimate,
    current_A: float,
    duration_s: float = 10.0,
    soc: float = 0.5,
    *,
    model: RecordModel | None = None,
) -> Derived:
    """
    Convert an estimate to the DC resistance of a pulse: the fall of the voltage from rest, over the current.

    .. code-block:: python

      value, sd = dc_resistance_ohm(estimate, 2.0, duration_s=10.0, soc=0.5, model=RecordModel(thermal=True))

    The standard deviation is that of the estimate, to first order, with independent errors of ``q_mobile`` and ``r_o``. It
    does not hold the error of the model. The ohmic drop of the model follows the current with a time constant of 6 s
    (``to``): pulses shorter than three of them miss a part of ``r_o`` that a real cell shows.

    :param estimate: of any calibrator
    :param current_A: of the pulse, above 0, A
    :param duration_s: of the pulse, s
    :param soc: state of charge at rest before the pulse, within 0 .. 1
    :param model: the model that the estimate belongs to, ``RecordModel(cell, thermal)``; ``None``: ``RecordModel()``
    :return: ohm; NaN if the cell is empty before the pulse ends
    :raises ValueError: for an argument out of range
    """
    model = RecordModel() if model is None else model
    check_load(check_positive("current_A", current_A), "current")
    at_rest = RecordModel(model.cell, model.thermal, model.dt_s, initial_soc=soc)
    q_C, r_ohm = float(Q_MOBILE.check(estimate.q_mobile)), float(R_O.check(estimate.r_o))
    steps = int(np.ceil(check_positive("duration_s", duration_s) / model.dt_s - 1e-9))
    columns = at_rest.sensitivities(np.full(steps + 1, float(current_A)), q_C, r_ohm)
    times_s = model.dt_s * np.arange(steps + 1)
    value, by_q, by_r = ((column[0] - np.interp(duration_s, times_s, column)) / current_A for column in columns)
    return Derived(float(value), _sd(estimate, float(by_q), float(by_r)))


def _sd(estimate: Estimate, by_q: float, by_r: float) -> float:
    return float(np.hypot(by_q * estimate.sd_q_mobile, by_r * estimate.sd_r_o))
