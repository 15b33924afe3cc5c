"""What a fit says of the constants of a cell: how sure they are, what speaks against them, and its file."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from math import exp, hypot, log, log1p, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import check_numbers, check_positive
from battery_env.electrochemistry import CellParameters, check_cell
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.estimators.diagnosis.rest import BELOW_REST_V, rest_voltage_V
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.priors import RATE_PRIOR_SD
from battery_env.estimators.verdict import MISMATCH_MARGIN
from battery_env.files import WrongFormatError, read_json, write_json
from battery_env.parameters import Q_MOBILE
from battery_env.records import ChargeBefore, DischargeStart

#: Cells of one kind differ by so much in each of them, also as standard deviations of logarithms.
SAME_KIND_SD = 0.2
#: A constant is identified if the discharges leave less than this share of the standard deviation of its prior.
IDENTIFIED_SHARE = 0.5
#: Error to expect on a real cell of constants that were not fitted to it, V.
UNFITTED_MISMATCH_V = 0.05
#: Over its life a cell loses this share of ``q_mobile``. Constants that were fitted at one end of it are taken to be
#: :data:`UNFITTED_MISMATCH_V` off at the other one, and between in proportion to the logarithm of ``q_mobile``: constants of
#: one discharge of B0005 are off the others by that.
LIFE_LOSS = 0.3
# Version 1 took the residuals of what was fitted for the error to expect.
_FORMAT, _FORMAT_VERSION = "battery_env.CellFit", 2
# A cell is not expected to hold more than this times the largest q_mobile that was fitted.
_GROWTH = 1.2
# For the error to expect each of so many groups, from the youngest to the oldest, is left out of the fit once.
_GROUPS = 3
# How much the logarithm of q_mobile falls over a life.
_LIFE = -log1p(-LIFE_LOSS)


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
    The result of a fit for one of its discharges.

    :param name: name of the cell and number of the discharge, if the record has both; otherwise the position
    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param sd_q_mobile: standard deviation of ``q_mobile``, with the uncertainty of the constants, C
    :param sd_r_o: standard deviation of ``r_o``, with the uncertainty of the constants, ohm
    :param rmse_V: root mean square of the voltage error, V
    :param rmse_before_V: the same with the constants before the fit, and the best ``q_mobile`` and ``r_o`` for them
    :param left_out_V: the same with constants fitted without this discharge, or, of a single discharge, without the part that
        is compared; ``None`` in files of older fits
    :param current_A: mean current, A; ``None`` if the file of the fit has none
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
    The constants of a cell from :func:`fit_cell`, for any calibrator:

    .. code-block:: python

      fit = fit_cell(discharges)
      print(fit.summary())
      estimate = fit.calibrator().estimate(record)
      fit.to_json("my_cell.json")

    :param cell: the constants, with ``q_mobile`` and ``r_o`` of the discharge with the largest ``q_mobile``, and the cut-off
        voltage as ``VEOD``
    :param start: the constants before the fit, with the same ``q_mobile``, ``r_o`` and ``VEOD``
    :param mismatch_V: expected error of the model with these constants, V, also at ages outside the fit
    :param rmse_V: root mean square of the residuals, V
    :param thermal: whether the temperature of the model changes
    :param constants: the result for each constant
    :param discharges: the result for each discharge
    :param usual_start: how the discharges start, which means full for this cell; ``None``: they start differently, or the file
        of the fit has no start
    :raises TypeError: for a value of another type
    :raises ValueError: for errors that are not positive, and numbers that are not finite
    """

    cell: CellParameters
    start: CellParameters
    mismatch_V: float
    rmse_V: float
    thermal: bool
    constants: tuple[FittedConstant, ...]
    discharges: tuple[FittedDischarge, ...]
    usual_start: DischargeStart | None = None

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
        start = [] if self.usual_start is None else [*self.usual_start[:3], *(self.usual_start.charge or ())]
        if not np.isfinite(check_numbers("usual_start", start)).all():
            raise ValueError(f"usual_start has finite numbers, got {self.usual_start!r}")

    @property
    def full_V(self) -> float:
        """The voltage at which a full cell rests with these constants, V."""
        return rest_voltage_V(self.cell)

    @property
    def currents_A(self) -> tuple[float, float] | None:
        """The lowest and the highest mean current of the discharges, A; ``None`` if the file of the fit does not tell."""
        currents_A = [each.current_A for each in self.discharges if each.current_A is not None]
        return (min(currents_A), max(currents_A)) if currents_A else None

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
        if uncovered_life(q_C) <= 0.5 * _LIFE:
            return ""
        return (
            "The discharges that were fitted show one age, or less than half of a cell's life: q_mobile is "
            f"{q_C.min():.0f} to {q_C.max():.0f} C. What the constants are worth at other ages is not known: mismatch_V, "
            f"{1e3 * self.mismatch_V:.0f} mV, allows for that. Add discharges of other ages when there are some."
        )

    def _doubt_of_others(self) -> str:
        log_q = np.log([discharge.q_mobile for discharge in self.discharges])
        ratios: dict[int, float] = {}
        for group, others in groups(log_q):
            for d in group.tolist():
                by_age_V = aged_V(float(np.abs(log_q[others] - log_q[d]).min()))
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
        """
        of_fit = {
            "cell": self.cell,
            "thermal": self.thermal,
            "mismatch_V": self.mismatch_V,
            "q_mobile_bounds_C": self.q_mobile_bounds_C,
            "nuisance": self.rates_sd,
            "usual_start": self.usual_start,
        }
        return LeastSquares(**{**of_fit, **arguments})

    @property
    def rates_sd(self) -> dict[str, float]:
        """
        How well the constants that say how fast the cell follows its load are known for another discharge, or another cell of
        the kind: standard deviations of their logarithms, by name.
        """
        return {each.name: hypot(each.sd, SAME_KIND_SD) for each in self.constants if each.name in RATE_PRIOR_SD}

    @property
    def q_mobile_bounds_C(self) -> tuple[float, float]:
        """Where to search for ``q_mobile``, C: a cell does not grow."""
        return Q_MOBILE.limits[0], min(_GROWTH * self.cell.q_mobile, Q_MOBILE.limits[1])

    @property
    def life_q_mobile_C(self) -> tuple[float, float]:
        """
        Where ``q_mobile`` lies over the life of such a cell, C: between those fitted, further down by what they leave out of a
        life, and a fifth beyond both ends, as another cell of the kind may hold more or less.
        """
        q_C = np.array([discharge.q_mobile for discharge in self.discharges])
        return float(q_C.min()) * exp(-uncovered_life(q_C)) / _GROWTH, self.q_mobile_bounds_C[1]

    def error_at_V(self, q_mobile_C: float) -> float:
        """The error to expect at some ``q_mobile``, C, in V: the larger the farther that age is from those fitted."""
        q_C = np.array([discharge.q_mobile for discharge in self.discharges])
        near_V2 = max(self.mismatch_V**2 - aged_V(uncovered_life(q_C)) ** 2, self.rmse_V**2)
        log_distance = max(log(q_C.min() / q_mobile_C), log(q_mobile_C / q_C.max()), 0.0)
        return hypot(sqrt(near_V2), aged_V(log_distance))

    def summary(self) -> str:
        """The fit in a few lines."""
        before_V = np.sqrt(np.mean([discharge.rmse_before_V**2 for discharge in self.discharges]))
        lines = [
            f"{len(self.discharges)} discharges, voltage RMSE {1e3 * before_V:.1f} mV before, {1e3 * self.rmse_V:.1f} mV "
            f"after; expect an error of {1e3 * self.error_at_V(self.cell.q_mobile):.1f} mV at these ages, of "
            f"{1e3 * self.mismatch_V:.1f} mV over a life (mismatch_V)",
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
        """Save the fit to a new file; a ``FileExistsError`` if it exists already."""
        return write_json(path, _FORMAT, _FORMAT_VERSION, asdict(self))

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> CellFit:
        """
        Load what :meth:`to_json` wrote; a ``ValueError`` for a file that is damaged, another one, or of another format
        version.
        """
        content = read_json(path, _FORMAT, _FORMAT_VERSION)
        try:
            for name in ("cell", "start"):
                content[name] = CellParameters.of_mapping(content[name])
            for name, row in (("constants", FittedConstant), ("discharges", FittedDischarge)):
                content[name] = tuple(row(**fields) for fields in content[name])
            if content.get("usual_start") is not None:
                *first, charge = content["usual_start"]
                content["usual_start"] = DischargeStart._make([*first, charge and ChargeBefore._make(charge)])
            return cls(**content)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged, or no fit saved by CellFit.to_json: {error}") from error


def read_cell(path: str | os.PathLike[str]) -> CellFit | AgingPath | CellParameters:
    """Read what a file says of the constants of a cell."""
    for kind in (CellFit, AgingPath):
        try:
            return kind.from_json(path)
        except WrongFormatError:
            continue
    return CellParameters.from_json(path)


def groups(q_mobile_C: ArrayLike) -> list[tuple[IntArray, IntArray]]:
    """Discharges in groups of one age, each with all others; one discharge has no others."""
    order = np.argsort(q_mobile_C, kind="stable")
    groups = np.array_split(order, min(_GROUPS, len(order)))
    return [(group, np.setdiff1d(order, group)) for group in groups if len(group) < len(order)]


def aged_V(log_distance: float) -> float:
    """The error to expect of constants at ages whose logarithms of ``q_mobile`` are so far apart from those fitted."""
    return UNFITTED_MISMATCH_V * log_distance / _LIFE


def uncovered_life(q_mobile_C: FloatArray) -> float:
    """How much of a life lies outside of the ages of some discharges, as a logarithm of ``q_mobile``."""
    return max(_LIFE - float(np.log(q_mobile_C.max() / q_mobile_C.min())), 0.0)
