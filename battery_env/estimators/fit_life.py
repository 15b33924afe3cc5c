"""How cells age, from the recorded discharges of one or more lives."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from math import log, sqrt
from typing import Any

import numpy as np

from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, CellParameters
from battery_env.electrochemistry.aging_path import EQUILIBRIUM_NAMES, PATH_NAMES, AgingPath
from battery_env.estimators.diagnosis.faults import RESOLUTION_V
from battery_env.estimators.error import ErrorModel
from battery_env.estimators.joint_fit import EQUILIBRIUM_PRIOR_SD_V, INDEPENDENT_ERRORS, LIMIT_V, fit_cell
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.priors import RATE_PRIOR_SD
from battery_env.estimators.search import Prior, Search, spread_over
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import CUT_OFF_V, Record, check_record
from battery_env.records.discharge import Discharge
from battery_env.records.model import RecordModel

# Ages of a life that are fitted one by one, and ages that are fitted at once for the constants that all share.
_AGES, _JOINT_AGES = 12, 6
# Error of the model of a single age, V: the smaller, the less its priors weigh.
_MISMATCH_V = 0.005
# Standard deviation of q_mobile around that with the constants before the fit, as a share.
_SAME_Q_SHARE = 0.002


def fit_life(
    discharges: Sequence[Record] | Sequence[Sequence[Record]],
    cut_off_V: float = CUT_OFF_V,
    start: CellParameters | None = None,
    limit_V: float = LIMIT_V,
) -> AgingPath:
    """
    Find how cells age: a path of the constants, ``q_mobile`` and ``r_o`` along their recorded lives.

    .. code-block:: python

      path = fit_life(load_nasa_discharges("B0006"))  # or fit_life([life_of_one, life_of_another])
      print(LeastSquares(path=path).estimate(load_nasa_discharges("B0005")[80].until(1500.0).loaded_part(2.7)))

    First :func:`fit_cell` fits six ages of each life at once, because no single age determines more than all six together.
    Then 12 ages of each life, evenly spread, are fitted one by one, each with constants of its own under the priors of
    ``fit_cell`` around the common constants. This takes ten seconds a life, and uses only time, current and voltage.

    If the equilibrium voltage may change, no voltage shows which part of the charge that can move lies beyond the cut-off.
    Therefore ``q_mobile`` keeps its meaning elsewhere in the package: at each age it is the ``q_mobile`` of
    :class:`~battery_env.LeastSquares` with the constants of ``start``, to 0.2 %.

    :param discharges: discharges of one cell, from the youngest to the oldest, each from full charge to the cut-off; or one
        such sequence for each of several cells
    :param cut_off_V: cut-off voltage, V
    :param start: the constants before the fit, as in :func:`fit_cell`
    :param limit_V: the largest root mean square of the residuals of a single age, V
    :return: the path
    :raises TypeError: if ``discharges`` is no sequence of records
    :raises ValueError: for less than two discharges of a cell, records that cannot be used, or cells that the equations cannot
        describe
    """
    lives = _lives(discharges)
    chosen = [[life[n] for n in spread_over(len(life), _AGES)] for life in lives]
    several = [life[n] for life in chosen for n in spread_over(len(life), max(_JOINT_AGES // len(lives), 2))]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)  # its doubts are of one set of constants for all ages
        common = fit_cell(several, cut_off_V, start, thermal=False, limit_V=2.0 * limit_V).cell
    reference = LeastSquares(cell=start)
    model, errors_V, fitted = RecordModel(common), [], []
    for life in chosen:
        ages = []
        for record in life:
            row, error_V = _fit_age(record, model, reference, cut_off_V)
            if not error_V <= limit_V:
                raise ValueError(
                    f"the equations do not describe this cell: with its own constants an age is still {1e3 * error_V:.0f} mV "
                    f"off (limit_V: {1e3 * limit_V:.0f} mV). Check units, sign and cut_off_V, and leave out odd discharges"
                )
            ages.append(row)
            errors_V.append(error_V)
        fitted.append(tuple(ages))
    return AgingPath(common, tuple(fitted), max(sqrt(float(np.mean(np.square(errors_V)))), RESOLUTION_V))


def _lives(discharges: Sequence[Record] | Sequence[Sequence[Record]]) -> list[list[Record]]:
    if isinstance(discharges, Discharge) or not isinstance(discharges, Sequence):
        raise TypeError(f"discharges must be a list of discharges, or of lists of them, got {type(discharges).__name__}")
    several = [isinstance(each, Sequence) and not hasattr(each, "time_s") for each in discharges]
    if any(several) != all(several):
        raise TypeError("discharges must be those of one cell, or a list of them for each cell, got both at once")
    given: Any = discharges if several and all(several) else [discharges]
    lives: list[list[Record]] = [list(life) for life in given]
    if any(len(life) < 2 for life in lives):
        raise ValueError(f"a life is of at least two discharges, got {[len(life) for life in lives]}")
    return lives


def _fit_age(record: Record, model: RecordModel, reference: LeastSquares, cut_off_V: float) -> tuple[tuple[float, ...], float]:
    """The values of one age, in the order of ``PATH_NAMES``, and the error that is left, V."""
    loaded = record.loaded_part(cut_off_V) if isinstance(record, Discharge) else record
    samples = check_record(loaded)
    nuisance = {name: RATE_PRIOR_SD[name] for name in UNCERTAIN_CONSTANTS}
    nuisance |= dict(zip(EQUILIBRIUM_NAMES, EQUILIBRIUM_PRIOR_SD_V, strict=True))
    error_V, q_C = sqrt(len(samples.time_s) / INDEPENDENT_ERRORS) * _MISMATCH_V, reference.estimate(loaded).q_mobile
    search = replace(Search.of(samples, model, PARAMETER_NAMES, nuisance, reference.bounds), error=ErrorModel(noise_V=error_V))
    priors = [Prior(name, 0.0, 1.0 / sd) for name, sd in nuisance.items()]
    priors.append(Prior("q_mobile", q_C, 1.0 / (_SAME_Q_SHARE * q_C)))
    fit = search.best(search.starts([q_C])[0], priors)
    values = {**fit.values, **{name: log(fit.values[name]) for name in PARAMETER_NAMES}}
    error_V = float(np.sqrt(np.mean(fit.residual_V**2)))
    return tuple(float(values[name]) for name in PATH_NAMES), error_V
