"""The constants of your own cell, from a few of its discharges."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from math import hypot, log
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.polynomial import Legendre, Polynomial
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import ZERO_CELSIUS_K, check_numbers, check_positive
from battery_env.electrochemistry import NEW_CELL, CellParameters, check_cell, check_dt
from battery_env.electrochemistry.tangents import BY_Q, BY_R, RATE_CONSTANTS
from battery_env.estimates import Estimate
from battery_env.estimators.diagnosis.conditions import ABOVE_REST_V, BELOW_REST_V, MISMATCH_MARGIN, rest_voltage_V
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.search import MARGIN, OnGrid, distance_C, minimized, square
from battery_env.files import WrongFormatError, read_json, write_json
from battery_env.parameters import Q_MOBILE, R_O
from battery_env.records import (
    CUT_OFF_V,
    SWITCH_SHARE,
    Record,
    check_drawn_charge,
    check_record,
    drawn_charge_C,
    mean_current_A,
)
from battery_env.records.discharge import Discharge
from battery_env.records.model import RecordModel

#: How well the constants that say how fast a cell follows its load are known before any data: standard deviations of their
#: logarithms. The overpotential of kn stands for whatever slows a worn cell down, so that it may differ most.
RATE_PRIOR_SD: Mapping[str, float] = {"kn": 1.5, "kp": 0.5, "tDiffusion": 0.5, "to": 0.5, "tsn": 0.5, "tsp": 0.5}
#: How far the equilibrium voltage may be another one: standard deviations of the coefficients of Legendre polynomials 0, 1,
#: ... over the mole fractions of the positive electrode that a discharge passes through, V.
EQUILIBRIUM_PRIOR_SD_V: tuple[float, ...] = (0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
#: A constant is identified if the discharges leave less than this share of the standard deviation of its prior.
IDENTIFIED_SHARE = 0.5
#: A fit that is farther from the measured voltages than this (root mean square), V, is refused.
LIMIT_V = 0.05
#: Error to expect on a real cell of constants that were not fitted to it, V.
UNFITTED_MISMATCH_V = 0.05
#: Over its life a cell loses this share of ``q_mobile``. Constants that were fitted at one end of it are taken to be
#: :data:`UNFITTED_MISMATCH_V` off at the other one, and between in proportion to the logarithm of ``q_mobile``: constants of
#: one discharge of B0005 are off the others by that.
LIFE_LOSS = 0.3

# Version 1 took the residuals of what was fitted for the error to expect.
_FORMAT, _FORMAT_VERSION = "battery_env.CellFit", 2

_MOST_DISCHARGES, _FEWEST_SAMPLES = 30, 20
# Longer records are thinned: what the constants shape is slower.
_MOST_SAMPLES = 2000
# Mole fractions of the positive electrode at full charge and at none.
_FRACTIONS_P = (0.4, 1.0)
# A cell that holds less or more than the new one by this factor is one of another size.
_OTHER_SIZE = 2.0
# The charge that can move is about this much more than what a discharge delivers.
_UNDELIVERED = 1.05
# A cell is not expected to hold more than this times the largest q_mobile that was fitted.
_GROWTH = 1.2
# Rounds of weighing the residuals by how large they turn out, and how large they are taken for in the first one, V.
_ROUNDS = 3
_FIRST_MISMATCH_V, _LEAST_MISMATCH_V = 0.02, 1e-3
# The error of the model drifts slowly: a discharge shows so many independent ones, unless its residuals change sign more
# often.
_INDEPENDENT_ERRORS = 50.0
# For the error to expect each of so many groups, from the youngest to the oldest, is left out of the fit once.
_GROUPS = 3
# How much the logarithm of q_mobile falls over a life.
_LIFE = -log(1.0 - LIFE_LOSS)
# The search: how many standard deviations of its prior a constant may move, the logarithm of the distance of q_mobile to its
# least value, C, and the scale of r_o, ohm.
_REACH_SD, _LOG_DISTANCE_LIMITS, _R_O_SCALE_OHM = 6.0, (-30.0, 16.0), 0.1
# Where the search for q_mobile starts beside the fit with the constants known before, and how near that may be to its least
# value, as shares of it.
_START_EXCESS, _LEAST_EXCESS = 0.02, 1e-4


@dataclass(frozen=True)
class FittedConstant:
    """
    What a fit says of one constant.

    :param name: a constant of :class:`~battery_env.CellParameters`; or ``equilibrium 0``, ``equilibrium 1``, ...: the
        coefficient of that Legendre polynomial in what is added to the equilibrium voltage
    :param prior: its value before the data; 0 V for what is added
    :param prior_sd: how sure that was: standard deviation of its logarithm; of what is added, in V
    :param value: its value now
    :param sd: how sure that is, as ``prior_sd``
    """

    name: str
    prior: float
    prior_sd: float
    value: float
    sd: float

    @property
    def identified(self) -> bool:
        """Whether the discharges leave less than half of the uncertainty of its prior."""
        return self.sd < IDENTIFIED_SHARE * self.prior_sd


@dataclass(frozen=True)
class FittedDischarge:
    """
    What a fit says of one of its discharges.

    :param name: of the cell and the discharge, if the record tells; otherwise its number
    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param sd_q_mobile: its standard deviation, with that of the constants, C
    :param sd_r_o: likewise, ohm
    :param rmse_V: root mean square of the voltage error, V
    :param rmse_before_V: likewise with the constants known before and the ``q_mobile`` and ``r_o`` that fit best to them
    :param left_out_V: likewise with constants that were fitted without this discharge; ``None`` if there are no others
    :param current_A: its mean current, A; ``None`` in files of fits that were made without it
    """

    name: str
    q_mobile: float
    r_o: float
    sd_q_mobile: float
    sd_r_o: float
    rmse_V: float
    rmse_before_V: float
    left_out_V: float | None = None
    current_A: float | None = None


@dataclass(frozen=True)
class CellFit:
    """
    The constants of a cell as :func:`fit_cell` found them, for any calibrator:

    .. code-block:: python

      fit = fit_cell(discharges)
      print(fit.summary())
      estimate = fit.calibrator().estimate(record)
      fit.to_json("my_cell.json")

    :param cell: the constants, with ``q_mobile`` and ``r_o`` of the discharge with the largest ``q_mobile``, and the cut-off
        voltage as ``VEOD``
    :param start: the constants before, with the same ``q_mobile``, ``r_o`` and ``VEOD``
    :param mismatch_V: error to expect of the model with these constants, V, also at ages that were not fitted
    :param rmse_V: root mean square of the residuals, V
    :param thermal: whether the temperature of the model moves
    :param constants: what the discharges say about each constant
    :param discharges: the discharges
    :raises TypeError: for a value of another kind
    :raises ValueError: for errors that are not positive, and numbers that are not finite
    """

    cell: CellParameters
    start: CellParameters
    mismatch_V: float
    rmse_V: float
    thermal: bool
    constants: tuple[FittedConstant, ...]
    discharges: tuple[FittedDischarge, ...]

    def __post_init__(self) -> None:
        for name in ("cell", "start"):
            if getattr(self, name) is None:
                raise TypeError(f"{name} must be CellParameters, got None")
            check_cell(getattr(self, name), self.thermal)
        for name in ("mismatch_V", "rmse_V"):
            check_positive(name, getattr(self, name))
        if not self.discharges:
            raise ValueError("a fit is of at least one discharge")
        Q_MOBILE.check([discharge.q_mobile for discharge in self.discharges])
        rows: tuple[FittedConstant | FittedDischarge, ...] = (*self.constants, *self.discharges)
        for row in rows:
            absent = {("left_out_V", None), ("current_A", None)}
            _, *numbers = (value for item, value in vars(row).items() if (item, value) not in absent)
            if not isinstance(row.name, str) or not np.isfinite(check_numbers(row.name, numbers)).all():
                raise ValueError(f"constants and discharges have names and finite numbers, got {row!r}")

    @property
    def full_V(self) -> float:
        """The voltage at which a full cell rests with these constants, V."""
        return rest_voltage_V(self.cell)

    @property
    def currents_A(self) -> tuple[float, float] | None:
        """The lowest and the highest mean current of the discharges, A; ``None`` if the file of the fit does not tell."""
        found = [each.current_A for each in self.discharges if each.current_A is not None]
        return (min(found), max(found)) if found else None

    @property
    def doubt(self) -> str:
        """What the discharges that were fitted may lack: a full cell at rest, other ages, one cell. Empty if they do not."""
        return " ".join(filter(None, (self._doubt_of_start(), self._doubt_of_ages(), self._doubt_of_others())))

    def _doubt_of_start(self) -> str:
        before_V = rest_voltage_V(self.start)
        if self.full_V >= before_V - BELOW_REST_V:
            return ""
        return (
            f"A full cell rests at {self.full_V:.2f} V with these constants, at {before_V:.2f} V with those before. If the "
            "discharges that were fitted did not start full, or lack the rest before the load, the constants are wrong, and "
            "so is every q_mobile found with them: fit others. If a full cell of this kind rests there, all is well."
        )

    def _doubt_of_ages(self) -> str:
        q_C = np.array([discharge.q_mobile for discharge in self.discharges])
        if _unseen(q_C) <= 0.5 * _LIFE:
            return ""
        return (
            "The discharges that were fitted show one age, or less than half of a cell's life: q_mobile is "
            f"{q_C.min():.0f} to {q_C.max():.0f} C. What the constants are worth at other ages is not known: mismatch_V, "
            f"{1e3 * self.mismatch_V:.0f} mV, allows for that. Add discharges of other ages when there are some."
        )

    def _doubt_of_others(self) -> str:
        log_q = np.log([discharge.q_mobile for discharge in self.discharges])
        ratios: dict[int, float] = {}
        for group, others in _groups(log_q):
            for d in group.tolist():
                by_age_V = _aged_V(float(np.abs(log_q[others] - log_q[d]).min()))
                ratios[d] = (self.discharges[d].left_out_V or 0.0) / hypot(self.rmse_V, by_age_V)
        odd = max(ratios, key=ratios.__getitem__, default=0)
        if ratios.get(odd, 0.0) <= MISMATCH_MARGIN:
            return ""
        return (
            f"Constants fitted without {self.discharges[odd].name} are {ratios[odd]:.1f} times as far off it as its age "
            "explains: leave it out if it is of another cell; if it is of another load, add discharges of that load."
        )

    def calibrator(self, **arguments: Any) -> LeastSquares:
        """
        Least squares with these constants and the error to expect of them, for a ``q_mobile`` of up to 1.2 times the largest
        that was fitted: a cell does not grow. Without that bound the first quarter of a discharge allows for far larger ones.

        :param arguments: others of :class:`~battery_env.LeastSquares`; they replace these
        :return: the calibrator
        """
        own = {
            "cell": self.cell,
            "thermal": self.thermal,
            "mismatch_V": self.mismatch_V,
            "q_mobile_bounds_C": self.q_mobile_bounds_C,
        }
        return LeastSquares(**{**own, **arguments})

    @property
    def q_mobile_bounds_C(self) -> tuple[float, float]:
        """Where to search for ``q_mobile``, C: a cell does not grow."""
        return Q_MOBILE.limits[0], min(_GROWTH * self.cell.q_mobile, Q_MOBILE.limits[1])

    def constants_table(self) -> pd.DataFrame:
        """
        The constants before and after, and how sure they are.

        :return: one row a constant, the fields of :class:`FittedConstant` and ``identified``
        """
        table = pd.DataFrame(self.constants)
        return table.assign(identified=[constant.identified for constant in self.constants])

    def summary(self) -> str:
        """
        The fit in a few lines.

        :return: text for a terminal
        """
        before_V = np.sqrt(np.mean([discharge.rmse_before_V**2 for discharge in self.discharges]))
        lines = [
            f"{len(self.discharges)} discharges, voltage RMSE {1e3 * before_V:.1f} mV before, {1e3 * self.rmse_V:.1f} mV "
            f"after; expect an error of {1e3 * self.mismatch_V:.1f} mV (mismatch_V)",
            f"a full cell rests at {rest_voltage_V(self.start):.2f} V before, at {self.full_V:.2f} V after",
            "",
            f"{'constant':<16}{'before':>12}{'after':>12}{'sd before':>12}{'after':>10}",
        ]
        for constant in self.constants:
            added = constant.name not in RATE_PRIOR_SD
            unit, factor = ("mV", 1e3) if added else ("%", 1e2)
            value, prior = (f"{1e3 * x:.1f} mV" if added else f"{x:.5g}" for x in (constant.value, constant.prior))
            sds = (f"{factor * x:.3g} {unit}" for x in (constant.prior_sd, constant.sd))
            lines.append(
                f"{constant.name:<16}{prior:>12}{value:>12}{next(sds):>12}{next(sds):>10}"
                + ("" if constant.identified else "   not identified")
            )
        lines += [
            "",
            f"{'discharge':<16}{'q_mobile':>10}{'sd':>8}{'r_o':>12}{'sd':>12}{'RMSE before':>14}{'after':>10}{'left out':>12}",
        ]
        for discharge in self.discharges:
            lines.append(
                f"{discharge.name:<16}{discharge.q_mobile:>8.0f} C{discharge.sd_q_mobile:>6.0f} C"
                f"{discharge.r_o:>8.4f} ohm{discharge.sd_r_o:>8.4f} ohm"
                f"{1e3 * discharge.rmse_before_V:>11.1f} mV{1e3 * discharge.rmse_V:>7.1f} mV"
                + ("" if discharge.left_out_V is None else f"{1e3 * discharge.left_out_V:>9.1f} mV")
            )
        return "\n".join(lines)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """
        Save the fit.

        :param path: where to
        :return: the file
        :raises FileExistsError: if the file exists already
        """
        return write_json(path, _FORMAT, _FORMAT_VERSION, asdict(self))

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> CellFit:
        """
        Load a fit.

        :param path: what :meth:`to_json` wrote
        :return: the fit
        :raises ValueError: if the file is damaged, was not written so, or is of another format version
        """
        content = read_json(path, _FORMAT, _FORMAT_VERSION)
        try:
            for name in ("cell", "start"):
                content[name] = CellParameters.of_mapping(content[name])
            for name, row in (("constants", FittedConstant), ("discharges", FittedDischarge)):
                content[name] = tuple(row(**fields) for fields in content[name])
            return cls(**content)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged, or no fit saved by CellFit.to_json: {error}") from error


def read_cell(path: str | os.PathLike[str]) -> CellFit | CellParameters:
    """Read the constants of a cell."""
    try:
        return CellFit.from_json(path)
    except WrongFormatError:
        return CellParameters.from_json(path)


def fit_cell(
    discharges: Sequence[Record],
    cut_off_V: float = CUT_OFF_V,
    start: CellParameters | None = None,
    thermal: bool = True,
    dt_s: float = 1.0,
    limit_V: float = LIMIT_V,
) -> CellFit:
    """
    Fit the constants of the model to a cell of your own: how fast it follows its load (``kn``, ``kp``, ``tDiffusion``,
    ``to``, ``tsn``, ``tsp``) and its equilibrium voltage (``U0p``, ``Ap``), to a few of its discharges at once, each with a
    ``q_mobile`` and ``r_o`` of its own. Three discharges suffice; take them from all ages, and at all loads, that the
    constants are to hold for. Each must start with a full cell, and reach the cut-off: one in progress is refused.

    *What is minimized* is the sum of squares of the residuals of the voltage and of the distances to the priors: logarithms
    of the rate constants have ``RATE_PRIOR_SD``, and the change of the equilibrium voltage is a polynomial in the mole
    fraction of the positive electrode with ``EQUILIBRIUM_PRIOR_SD_V``, which ``U0p`` and ``Ap`` can make exactly. So constants
    that the discharges do not determine stay near what they were. The voltage at rest of a full cell counts as much as all
    that follows within a fiftieth of the discharge. The search is scipy's trust region with exact derivatives.

    *How sure it is.* The residuals are the error of the model, and drift slowly: those of a discharge count as 50 independent
    ones, or as many as they change their sign. Their variance is found along with the constants.

    *The error to expect* of another discharge, ``mismatch_V``, is what discharges show that are left out of the fit: the
    young, the middle and the old third, one after the other. What none shows, of a life (:data:`LIFE_LOSS` of ``q_mobile``)
    and of ``q_mobile`` itself, counts in proportion to the error of constants that were not fitted.

    *Other cells.* A cell of another capacity starts with electrodes of another size. Another chemistry works as far as the
    equations bend; where they do not, the residuals stay large and the fit is refused. A start that is not full is taken for
    that of another chemistry: a fit whose full cell rests more than 0.04 V below that of ``start`` warns of it (``doubt``). So
    does a fit of less than half a life, and one that a discharge does not belong to.

    :param discharges: of one cell, each from full charge. Of a :class:`~battery_env.Discharge` the part from load-on to the
        cut-off is taken; other records are taken whole
    :param cut_off_V: cut-off voltage, V
    :param start: what is thought of the constants before; ``None``: the new cell's, at the size of this one
    :param thermal: whether the temperature of the model moves. It starts at the measured one, if that is known
    :param dt_s: time step of the model, s
    :param limit_V: the largest root mean square of the residuals, V
    :return: the fit
    :raises TypeError: for what is no sequence of records
    :raises ValueError: for an argument out of range, records that cannot be used or stay more than 0.05 V above the cut-off,
        or a cell that the equations cannot describe
    """
    records = _records(discharges, cut_off_V)
    check_positive("limit_V", limit_V)
    prior = _prior(records, start, thermal, cut_off_V)
    check_dt(dt_s, prior)
    # a simulated record is at rest before its first current acts
    at_rest = [
        not isinstance(whole, Discharge) or bool(whole.current_A[0] <= SWITCH_SHARE * whole.current_A.max())
        for whole in discharges
    ]
    _check_starts_alike(records, at_rest)
    fit = JointFit(records, at_rest, prior, thermal, dt_s).solve()
    if not fit.rmse_V <= limit_V:
        raise ValueError(
            f"the equations do not describe this cell: with all constants fitted the voltage is still {1e3 * fit.rmse_V:.0f} "
            f"mV off (limit_V: {1e3 * limit_V:.0f} mV). Check units, sign and cut_off_V, that all discharges are of one cell "
            "and start full, and leave out odd ones; or raise limit_V and take the fit for what it is."
        )
    if fit.doubt:
        warnings.warn(fit.doubt, stacklevel=2)
    return fit


def _records(discharges: Sequence[Record], cut_off_V: float) -> list[Record]:
    if isinstance(discharges, Discharge) or not isinstance(discharges, Sequence):
        raise TypeError(f"discharges must be a list of discharges, got {type(discharges).__name__}")
    check_positive("cut_off_V", cut_off_V)
    if not 1 <= len(discharges) <= _MOST_DISCHARGES:
        raise ValueError(
            f"fit_cell takes 1 to {_MOST_DISCHARGES} discharges, got {len(discharges)}. A few of all ages tell as much."
        )
    records: list[Record] = []
    for number, discharge in enumerate(discharges, start=1):
        try:
            record = discharge.loaded_part(cut_off_V) if isinstance(discharge, Discharge) else discharge
            samples = check_record(record, _FEWEST_SAMPLES)
            check_drawn_charge(drawn_charge_C(samples))
            _check_ends(float(samples.voltage_V.min()), cut_off_V)
        except AttributeError as error:
            raise TypeError(f"discharge {_name(discharge, number)} is no record: {error}") from error
        except (TypeError, ValueError) as error:
            raise type(error)(f"discharge {_name(discharge, number)}: {error}") from error
        records.append(record)
    return records


def _check_ends(lowest_V: float, cut_off_V: float) -> None:
    """Refuse a discharge in progress: before its knee, a cell that holds less looks like one that follows its load slower."""
    if lowest_V > cut_off_V + UNFITTED_MISMATCH_V:
        raise ValueError(
            f"its lowest voltage is {lowest_V:.4g} V, above the cut-off, {cut_off_V:.4g} V. A discharge in progress does not "
            "determine the constants: leave it out. If it was discharged no further, state cut_off_V (--cut-off)."
        )


def _check_starts_alike(records: Sequence[Record], at_rest: Sequence[bool]) -> None:
    """Refuse discharges that cannot all start full: a full cell, of whatever kind, rests at about one voltage."""
    found = enumerate(zip(records, at_rest, strict=True), start=1)
    rests = [(float(each.voltage_V[0]), _name(each, n)) for n, (each, rested) in found if rested]
    (low_V, low), (high_V, high) = min(rests, default=(0.0, "")), max(rests, default=(0.0, ""))
    if high_V - low_V > BELOW_REST_V + ABOVE_REST_V:
        raise ValueError(
            f"discharge {low} starts at rest at {low_V:.2f} V, discharge {high} at {high_V:.2f} V: they "
            "cannot both be of a full cell. Leave out those that do not start full."
        )


def _prior(records: Sequence[Record], start: CellParameters | None, thermal: bool, cut_off_V: float) -> CellParameters:
    """Return what is thought of the constants before the data, but for what is measured."""
    check_cell(start, thermal)
    q_mobile = float(Q_MOBILE.check(_UNDELIVERED * max(drawn_charge_C(record) for record in records)))
    if start is None:
        size = q_mobile / NEW_CELL.q_mobile
        start = NEW_CELL
        if not 1.0 / _OTHER_SIZE < size < _OTHER_SIZE:
            surfaces = {name: size * getattr(NEW_CELL, name) for name in ("Sn", "Sp", "mC")}
            start = NEW_CELL.replace(q_mobile=q_mobile, r_o=NEW_CELL.r_o / size, **surfaces)
    known = [getattr(record, "temperature_C", None) for record in records]
    temperatures_C = [column[0] for column in known if column is not None]
    measured = {"Tb0": ZERO_CELSIUS_K + float(np.mean(temperatures_C))} if temperatures_C else {}
    return start.replace(VEOD=float(cut_off_V), **measured)


def with_equilibrium(cell: CellParameters, coefficients_V: Sequence[float] | FloatArray) -> CellParameters:
    """Return a cell with a Legendre series over ``_FRACTIONS_P`` added to its equilibrium voltage."""
    # as a polynomial in y = 2x - 1, from the highest power down: term k of the Redlich-Kister sum is
    # A_k / F * ((1 + k / 2) * y^(k + 1) - (k / 2) * y^(k - 1))
    x = Polynomial([0.5, 0.5])
    powers = Legendre(coefficients_V).convert(kind=Polynomial)(_on_unit_range(x)).coef
    terms = np.zeros(max(len(cell.Ap), len(powers) - 1))
    for k in range(len(powers) - 2, -1, -1):
        terms[k] = powers[k + 1] / (1.0 + k / 2.0)
        if k > 0:
            powers[k - 1] += k / 2.0 * terms[k]
    terms[: len(cell.Ap)] += np.array(cell.Ap) / cell.F
    return cell.replace(U0p=cell.U0p + float(powers[0]), Ap=tuple((cell.F * terms).tolist()))


def _on_unit_range(fraction: Any) -> Any:
    # numbers, arrays and polynomials alike
    low, high = _FRACTIONS_P
    return (fraction - 0.5 * (high + low)) * (2.0 / (high - low))


def _name(record: Record, number: int) -> str:
    meta = getattr(record, "meta", {})
    return f"{meta['cell']}:{meta['cycle']}" if {"cell", "cycle"} <= set(meta) else str(number)


@dataclass(frozen=True)
class AtDischarge:
    """The model of one discharge at an x of the search."""

    residual_V: FloatArray  # at the samples
    jacobian: FloatArray  # of these, by x
    q_mobile: float
    r_o: float
    q_gradient_C: FloatArray  # of q_mobile, by x


@dataclass(frozen=True)
class _Weights:
    """How much the residuals of each discharge count."""

    mismatch_V: float
    independent: FloatArray  # errors in each discharge, shape (D,)


class JointFit:
    """
    The search over the constants and, for each discharge, ``q_mobile`` and ``r_o``. An x holds, in this order: of each
    constant how many standard deviations of its prior it has moved; of each discharge the logarithm of the distance of
    ``q_mobile`` to its least value; of each discharge ``r_o`` in units of ``_R_O_SCALE_OHM``.
    """

    def __init__(
        self, records: Sequence[Record], at_rest: Sequence[bool], start: CellParameters, thermal: bool, dt_s: float
    ) -> None:
        self.model = RecordModel(start, thermal, dt_s)
        self.names = [_name(record, number) for number, record in enumerate(records, start=1)]
        self.sd = np.array([*(RATE_PRIOR_SD[name] for name in RATE_CONSTANTS), *EQUILIBRIUM_PRIOR_SD_V])
        self.records, self.at_rest = records, at_rest  # whether the first sample is the voltage of a full cell at rest
        self.data = [_thinned(OnGrid.of(record, self.model)) for record in records]
        self.charges_C = np.array([drawn_charge_C(record) for record in records])
        self._evaluated = lru_cache(maxsize=1)(self.evaluate)

    @cached_property
    def before(self) -> list[tuple[Estimate, float]]:
        """With the constants known before, what fits best to each discharge, and the error left, V."""
        return [self._alone(self.model.cell, d) for d in range(len(self.data))]

    def _alone(self, cell: CellParameters, d: int) -> tuple[Estimate, float]:
        """With some constants, what fits best to one discharge, and the error left (root mean square), V."""
        model, data = self.model.of_cell(cell), self.data[d]
        estimate = LeastSquares(
            cell=cell, thermal=model.thermal, dt_s=model.dt_s, q_mobile_bounds_C=Q_MOBILE.limits, r_o_bounds_ohm=R_O.limits
        ).estimate(self.records[d])
        (voltage_V,) = data.at_samples([model.tangents(data.current_A, estimate.q_mobile, estimate.r_o).voltage_V])
        return estimate, _rms(voltage_V - data.voltage_V)

    def cell(self, x: FloatArray) -> CellParameters:
        """The constants of an x."""
        start, moved = self.model.cell, x[: len(self.sd)] * self.sd
        rates = {
            name: getattr(start, name) * float(np.exp(log))
            for name, log in zip(RATE_CONSTANTS, moved[: len(RATE_CONSTANTS)], strict=True)
        }
        return with_equilibrium(start.replace(**rates), moved[len(RATE_CONSTANTS) :])

    def starts(self) -> list[FloatArray]:
        """Where to start: at the constants known before."""
        least_C = np.array([self.model.least_q_mobile_C(data.current_A) for data in self.data])
        fitted_C = np.array([estimate.q_mobile for estimate, _ in self.before]) - least_C
        r_o = [estimate.r_o / _R_O_SCALE_OHM for estimate, _ in self.before]
        return [
            np.concatenate([np.zeros(len(self.sd)), np.log(np.maximum(above_C, _LEAST_EXCESS * least_C)), r_o])
            for above_C in (fitted_C, _START_EXCESS * least_C)
        ]

    def solve(self) -> CellFit:
        """The best fit that is found from any start, with the weights that its residuals imply."""
        weights = _Weights(_FIRST_MISMATCH_V, np.full(len(self.data), _INDEPENDENT_ERRORS))
        found = [self._search(x, weights) for x in self.starts()]
        best = min(found, key=lambda x: square(self._objective(x, weights)[0]))
        for _ in range(_ROUNDS):
            weights = self._weights(best, weights)
            best = self._search(best, weights)
        return self._result(best, self._weights(best, weights))

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        low, high = np.full(len(self.sd), -_REACH_SD), np.full(len(self.sd), _REACH_SD)
        for k, name in enumerate(RATE_CONSTANTS):
            if name in ("to", "tsn", "tsp"):  # the model is stable at twice this step
                low[k] = max(low[k], np.log(self.model.dt_s / getattr(self.model.cell, name)) / self.sd[k])
        (least, most), each = _LOG_DISTANCE_LIMITS, np.ones(len(self.data))
        low_r, high_r = R_O.limits
        return (
            np.concatenate([low, least * each, low_r / _R_O_SCALE_OHM * each]),
            np.concatenate([high, most * each, high_r / _R_O_SCALE_OHM * each]),
        )

    def _search(self, x: FloatArray, weights: _Weights) -> FloatArray:
        low, high = self._bounds()
        room = 1e-6 * (high - low)
        tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-7)
        x = np.clip(x, low + room, high - room)
        return minimized(lambda x: self._objective(x, weights), x, bounds=(low, high), max_nfev=200, **tolerances)

    def _objective(self, x: FloatArray, weights: _Weights) -> tuple[FloatArray, FloatArray]:
        """Weighted residuals and distances to the priors, and their derivatives."""
        n = len(self.sd)
        residuals, derivatives = [], []
        for seen, at_rest, count in zip(self._evaluated(tuple(x)), self.at_rest, weights.independent, strict=True):
            scale = np.full(len(seen.residual_V), np.sqrt(count / len(seen.residual_V)))
            if at_rest:
                scale[0] = 1.0  # one sample alone says what a full cell shows, however many follow
            scale /= weights.mismatch_V
            residuals.append(scale * seen.residual_V)
            derivatives.append(scale[:, None] * seen.jacobian)
        return np.concatenate([*residuals, x[:n]]), np.concatenate([*derivatives, np.eye(n, len(x))])

    def evaluate(self, x: Sequence[float]) -> list[AtDischarge]:
        """The model of every discharge at an x."""
        values = np.array(x)
        model = self.model.of_cell(self.cell(values))
        n, rates = len(self.sd), len(RATE_CONSTANTS)
        t_diffusion = RATE_CONSTANTS.index("tDiffusion")
        found = []
        for d, data in enumerate(self.data):
            u, r = n + d, n + len(self.data) + d
            least_C, least_by_log_C = model.least_q_mobile_tangent_C(data.current_A)
            above_C, r_o = distance_C(values[u]), _R_O_SCALE_OHM * float(values[r])
            q_mobile = (1.0 + MARGIN) * least_C + above_C
            q_gradient_C = np.zeros(len(values))
            q_gradient_C[u] = above_C
            q_gradient_C[t_diffusion] = (1.0 + MARGIN) * least_by_log_C * self.sd[t_diffusion]
            voltage_V, by_parameter, fraction_p = model.tangents(data.current_A, q_mobile, r_o)
            columns = by_parameter[BY_Q] * q_gradient_C[:, None]
            columns[:rates] += self.sd[:rates, None] * by_parameter[BY_R + 1 :]
            columns[rates:n] = self.sd[rates:, None] * legvander(_on_unit_range(fraction_p), n - rates - 1).T
            columns[r] = _R_O_SCALE_OHM * by_parameter[BY_R]
            seen_V, *by_x = data.at_samples([voltage_V, *columns])
            found.append(AtDischarge(seen_V - data.voltage_V, np.column_stack(by_x), q_mobile, r_o, q_gradient_C))
        return found

    def _covariance(self, x: FloatArray, weights: _Weights) -> FloatArray:
        jacobian = self._objective(x, weights)[1]
        return np.asarray(np.linalg.pinv(jacobian.T @ jacobian))

    def _weights(self, x: FloatArray, weights: _Weights) -> _Weights:
        """What the residuals say about their own size, and how many of them are independent."""
        residuals_V = [seen.residual_V for seen in self._evaluated(tuple(x))]
        changes = [float(np.count_nonzero(np.diff(np.signbit(residual)))) for residual in residuals_V]
        independent = np.maximum(changes, _INDEPENDENT_ERRORS)
        # what was fitted makes residuals smaller than errors, by as much as the data determine
        left = np.diag(self._covariance(x, weights))[: len(self.sd)]
        fitted = float(np.sum(1.0 - left)) + 2.0 * len(residuals_V)
        square_V2 = sum(count * _rms(residual) ** 2 for count, residual in zip(independent, residuals_V, strict=True))
        return _Weights(max(float(np.sqrt(square_V2 / (independent.sum() - fitted))), _LEAST_MISMATCH_V), independent)

    def _left_out_V(self, x: FloatArray, weights: _Weights) -> list[float | None]:
        """
        How far each discharge is from constants that were fitted without it, and without those of its age (root mean square),
        V. That is what a discharge shows that nobody has fitted.
        """
        count, n = len(self.data), len(self.sd)
        errors_V: list[float | None] = [None] * count
        for group, kept in _groups([at.q_mobile for at in self._evaluated(tuple(x))]):
            others = JointFit(
                [self.records[d] for d in kept],
                [self.at_rest[d] for d in kept],
                self.model.cell,
                self.model.thermal,
                self.model.dt_s,
            )
            own = np.append(np.arange(n), (n + kept, n + count + kept))
            fitted = others._search(x[own], _Weights(weights.mismatch_V, weights.independent[kept]))
            for d in group.tolist():
                try:
                    errors_V[d] = self._alone(others.cell(fitted), d)[1]
                except ValueError as error:
                    raise ValueError(
                        f"constants fitted to the other discharges cannot follow {self.names[d]}: leave it out"
                    ) from error
        return errors_V

    def _expected_V(self, discharges: Sequence[FittedDischarge], residual_V: float) -> float:
        """The error to expect of any discharge of the cell: of those left out, and of ages and charges that none shows."""
        q_mobile_C = np.array([each.q_mobile for each in discharges])
        shown_V = [each.left_out_V for each in discharges if each.left_out_V is not None]
        undrawn = 1.0 - float((self.charges_C / q_mobile_C).max())
        unseen_V = hypot(_aged_V(_unseen(q_mobile_C)), UNFITTED_MISMATCH_V * max(undrawn, 0.0))
        return hypot(max(residual_V, _rms(np.array(shown_V or [0.0]))), unseen_V)

    def _result(self, x: FloatArray, weights: _Weights) -> CellFit:
        """What was found."""
        start, cell, n, seen = self.model.cell, self.cell(x), len(self.sd), self._evaluated(tuple(x))
        covariance = self._covariance(x, weights)
        sds = np.sqrt(np.diag(covariance))
        before = [getattr(start, name) for name in RATE_CONSTANTS] + [0.0] * len(EQUILIBRIUM_PRIOR_SD_V)
        after = [getattr(cell, name) for name in RATE_CONSTANTS] + (self.sd * x[:n])[len(RATE_CONSTANTS) :].tolist()
        names = [*RATE_CONSTANTS, *(f"equilibrium {k}" for k in range(len(EQUILIBRIUM_PRIOR_SD_V)))]
        rows = zip(names, before, self.sd.tolist(), after, (self.sd * sds[:n]).tolist(), strict=True)
        discharges = []
        left_out_V = self._left_out_V(x, weights)
        rows_of = zip(self.names, self.before, seen, left_out_V, self.records, strict=True)
        for d, (name, (_, before_V), at, error_V, record) in enumerate(rows_of):
            sd_q_C = float(np.sqrt(at.q_gradient_C @ covariance @ at.q_gradient_C))
            sd_r_ohm = float(_R_O_SCALE_OHM * sds[n + len(seen) + d])
            others = _rms(at.residual_V), before_V, error_V, mean_current_A(record)
            discharges.append(FittedDischarge(name, at.q_mobile, at.r_o, sd_q_C, sd_r_ohm, *others))
        largest = max(discharges, key=lambda discharge: discharge.q_mobile)
        new = {"q_mobile": largest.q_mobile, "r_o": largest.r_o}
        return CellFit(
            cell.replace(**new),
            start.replace(**new),
            self._expected_V(discharges, weights.mismatch_V),
            _rms(np.concatenate([at.residual_V for at in seen])),
            self.model.thermal,
            tuple(FittedConstant(*row) for row in rows),
            tuple(discharges),
        )


def _groups(q_mobile_C: ArrayLike) -> list[tuple[IntArray, IntArray]]:
    """Discharges in groups of one age, each with all others; one discharge has no others."""
    order = np.argsort(q_mobile_C, kind="stable")
    groups = np.array_split(order, min(_GROUPS, len(order)))
    return [(group, np.setdiff1d(order, group)) for group in groups if len(group) < len(order)]


def _aged_V(apart: float) -> float:
    """The error to expect of constants at ages whose logarithms of ``q_mobile`` are so far apart from those fitted."""
    return UNFITTED_MISMATCH_V * apart / _LIFE


def _unseen(q_mobile_C: FloatArray) -> float:
    """How much of a life lies outside of the ages of some discharges, as a logarithm of ``q_mobile``."""
    return max(_LIFE - float(np.log(q_mobile_C.max() / q_mobile_C.min())), 0.0)


def _thinned(data: OnGrid) -> OnGrid:
    samples = len(data.time_s)
    kept = np.unique(np.linspace(0, samples - 1, min(samples, _MOST_SAMPLES)).round().astype(np.int64))
    return replace(data, time_s=data.time_s[kept], voltage_V=data.voltage_V[kept])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
