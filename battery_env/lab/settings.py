"""Settings for the calibration of real cells, which check themselves and build their calibrator."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import exp, hypot, log
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypedDict, get_args

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.checks import check_positive, with_option_hints
from battery_env.electrochemistry import NEW_CELL, CellParameters
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.electrochemistry.cell import Q_MOBILE_PER_CAPACITY, new_cell_of
from battery_env.estimates import Estimate
from battery_env.estimates.findings import Finding, Reason
from battery_env.estimators.cell_fit import SAME_KIND_SD, UNFITTED_MISMATCH_V, CellFit, read_cell
from battery_env.estimators.diagnosis.rest import InitialSoc, Start
from battery_env.estimators.least_squares import LeastSquares
from battery_env.estimators.priors import RATE_PRIOR_SD, explained_ratio
from battery_env.estimators.search import SIZE_WIDTH, SizePrior
from battery_env.estimators.verdict import PRIOR_LIMIT_SD
from battery_env.parameters import Q_MOBILE
from battery_env.policies.policy_estimator import PolicyEstimator
from battery_env.records import CUT_OFF_V, DischargeStart, load_range_A
from battery_env.records.samples import check_cut_off

Method = Literal["least-squares", "policy"]
METHODS: tuple[Method, ...] = get_args(Method)

# Usual charge of a cell, new or aged, as a share of a new cell of its size.
_USUAL_SHARE = 0.75
# Constants that were fitted at one load moved q_mobile by 5 % at twice that load, and so by less than the 2 % of a settled
# estimate within this ratio.
_SAME_LOAD = 1.25


class SettingsOptions(TypedDict, total=False):
    """Keywords of :class:`Settings`."""

    method: Method | None
    cut_off_V: float | None
    prior_q_mobile_C: tuple[float, float] | None
    mismatch_V: float | None
    current_gain_sd: float
    thermal: bool | None
    nominal_Ah: float | None
    cell: CellFit | AgingPath | CellParameters | None
    cell_rates_sd: Mapping[str, float] | None
    initial_soc: InitialSoc | Literal["rest"]
    usual_start: DischargeStart | None


class ResolvedSettings(NamedTuple):
    """:class:`Settings` without ``None``: the cell gives what nobody stated."""

    cut_off_V: float
    mismatch_V: float
    thermal: bool
    usual_start: DischargeStart | None


@with_option_hints
@dataclass(frozen=True)
class Settings:
    """
    Set how to calibrate discharges of a real cell. ``Settings().calibrator()`` is least squares with settings for such cells.
    An option that nobody stated stays ``None`` and follows ``cell``; :attr:`resolved` has the numbers.

    :param method: method of calibration; ``None``: least squares. ``"policy"`` is the policy of the package, for both
        parameters; its model has constants along the ageing of the bundled cells, at constant temperature
    :param cut_off_V: voltage at which the discharge ends, V; ``None``: the cut-off of the fit of ``cell``, or 2.7
    :param prior_q_mobile_C: mean and standard deviation of ``q_mobile`` before the discharge, C; ``None``: no prior
    :param mismatch_V: expected error of the model, V; ``None``: the error of the fit of ``cell``, or 0.05
    :param current_gain_sd: standard deviation of the gain of the current sensor, relative
    :param thermal: whether the temperature of the model changes; ``None``: as in the fit of ``cell``, or true
    :param nominal_Ah: nominal capacity for the state of health, Ah; ``None``: the charge that ``cell`` with its own
        ``q_mobile`` and ``r_o`` gives from full at the current of the discharge, or unknown without a ``cell``. Without other
        prior knowledge the nominal capacity is also the expected size of a cell in progress, instead of a new 18650. No
        estimate of another size than such cells have, new or aged, is settled
    :param cell: constants of the model, or a result of ``fit_cell``: more than a quarter beyond the loads of the fit no
        estimate is settled, and the nominal capacity is unknown. Or a result of ``fit_life``, the path of aging cells of this
        kind, for least squares. ``None``: the constants of a new 18650
    :param cell_rates_sd: uncertainty of the rate constants of ``cell``: standard deviations of their logarithms, by name, for
        least squares. ``None``: for a fit its own; for a new 18650 the spread of cells of any kind
        (:data:`battery_env.estimators.priors.RATE_PRIOR_SD`), and for stated constants the spread of cells of one kind
    :param initial_soc: state of charge when the load is switched on, after a rest: a number, (mean, standard deviation), or
        ``"rest"``: computed from the voltage of at least a minute of rest before the load
    :param usual_start: how discharges of this cell start, such as ``Life.usual_start``: a start like this is full; ``None``:
        the start of the fit of ``cell``, or a full cell of the model at rest
    :raises ValueError: for an argument out of range, and for options that a policy does not take. :meth:`calibrator` raises
        the errors of the calibrators
    """

    method: Method | None = None
    cut_off_V: float | None = None
    prior_q_mobile_C: tuple[float, float] | None = None
    mismatch_V: float | None = None
    current_gain_sd: float = 0.005
    thermal: bool | None = None
    nominal_Ah: float | None = None
    cell: CellFit | AgingPath | CellParameters | None = None
    cell_rates_sd: Mapping[str, float] | None = None
    initial_soc: InitialSoc | Literal["rest"] = 1.0
    usual_start: DischargeStart | None = None

    def __post_init__(self) -> None:
        if self.method not in (None, *METHODS):
            raise ValueError(f"the method is {' or '.join(METHODS)}, got {self.method!r}")
        if self.nominal_Ah is not None:
            check_positive("the nominal capacity in Ah", self.nominal_Ah)
        if self.path is not None and self.method not in (None, "least-squares"):
            raise ValueError(f"a path of aging cells is for least squares, got the method {self.method!r}")
        if self.method == "policy":
            self._refuse_for_the_policy()
        check_cut_off(self.resolved.cut_off_V)

    def _refuse_for_the_policy(self) -> None:
        """Refuse settings that a policy cannot use: it has learned on one model."""
        defaults = {field.name: field.default for field in fields(self)} | {"mismatch_V": UNFITTED_MISMATCH_V}
        stated = vars(self) | self.resolved._asdict()
        for name in ("cell", "prior_q_mobile_C", "mismatch_V", "current_gain_sd", "initial_soc"):
            if stated[name] != defaults[name]:
                raise ValueError(
                    f"the policy that comes with the package takes no {name}: leave it out, or take another method"
                )

    @property
    def resolved(self) -> ResolvedSettings:
        """Cut-off, expected model error, kind of the model and usual start: as stated, or else of the cell."""
        resolved = ResolvedSettings(CUT_OFF_V, UNFITTED_MISMATCH_V, thermal=True, usual_start=None)
        if isinstance(self.cell, CellFit):
            resolved = ResolvedSettings(self.cell.cell.VEOD, self.cell.mismatch_V, self.cell.thermal, self.cell.usual_start)
        elif isinstance(self.cell, AgingPath):
            resolved = ResolvedSettings(self.cell.cell.VEOD, self.cell.mismatch_V, thermal=False, usual_start=None)
        stated = {name: value for name in resolved._fields if (value := getattr(self, name)) is not None}
        return resolved._replace(**stated)

    def but(self, **changes: Any) -> Settings:
        """Return settings with some changes; options that nobody stated follow a changed cell."""
        return replace(self, **changes)

    def expecting(self, current_A: FloatArray) -> Settings:
        """
        Return settings with the expected model error at the age of the prior, if no error is stated and the constants were
        fitted to these currents: at others the constants may be wrong by more than the fit left.
        """
        if self.fit is None or self.mismatch_V is not None or self.prior_q_mobile_C is None or self.fit.currents_A is None:
            return self
        (low_A, high_A), (least_A, most_A) = load_range_A(current_A), self.fit.currents_A
        if not least_A / _SAME_LOAD <= low_A <= high_A <= most_A * _SAME_LOAD:
            return self
        return replace(self, mismatch_V=self.fit.error_at_V(self.prior_q_mobile_C[0]))

    @property
    def constants(self) -> CellParameters:
        """Constants of the model."""
        return self.cell.cell if isinstance(self.cell, CellFit | AgingPath) else self.cell or NEW_CELL

    @property
    def fit(self) -> CellFit | None:
        """The fit of the constants to discharges of the cell; ``None`` without a fit."""
        return self.cell if isinstance(self.cell, CellFit) else None

    @property
    def path(self) -> AgingPath | None:
        """The path of aging cells of this kind; ``None`` without a path."""
        return self.cell if isinstance(self.cell, AgingPath) else None

    @property
    def q_mobile_bounds_C(self) -> tuple[float, float]:
        """Bounds of the search for ``q_mobile``, C."""
        return self.fit.q_mobile_bounds_C if self.fit else Q_MOBILE.limits

    @classmethod
    def for_file(cls, path: Path | None, **stated: Any) -> Settings:
        """
        Return settings with the cell of a file, if there is one; a doubtful fit is a warning.

        :param path: what the command fit, ``CellParameters.to_json`` or ``AgingPath.to_json`` wrote
        :param stated: further settings, which take precedence over the file
        """
        if path is None:
            return cls(**stated)
        if not path.is_file():
            raise FileNotFoundError(
                f"no file {str(path)!r} for --cell: give what the command fit, CellParameters.to_json or AgingPath.to_json "
                "wrote"
            )
        cell = read_cell(path)
        if isinstance(cell, CellFit) and cell.doubt:
            warnings.warn(f"{path}: {cell.doubt}", stacklevel=2)
        return cls(cell=cell, **stated)

    @property
    def _new_q_mobile_C(self) -> float:
        """``q_mobile`` of a new cell of the nominal capacity; of a new 18650 if no capacity is stated."""
        if self.nominal_Ah is None:
            return NEW_CELL.q_mobile
        return float(np.clip(Q_MOBILE_PER_CAPACITY * 3600.0 * self.nominal_Ah, *Q_MOBILE.limits))

    @property
    def _usual_size(self) -> SizePrior:
        return SizePrior(_USUAL_SHARE * self._new_q_mobile_C, is_stated=self.nominal_Ah is not None)

    @property
    def size(self) -> SizePrior | None:
        """Usual ``q_mobile`` of cells of this size, new or aged; ``None`` with a prior or a cell, which determine more."""
        is_known = self.prior_q_mobile_C is not None or self.cell is not None
        return None if is_known else self._usual_size

    @property
    def constants_in_progress(self) -> CellParameters:
        """Constants for a discharge in progress: of a cell of the nominal capacity, without a prior or a cell."""
        if self.size is None or self.method == "policy":
            return self.constants
        return new_cell_of(self._new_q_mobile_C)

    def other_size(self, estimate: Estimate, drawn_C: float) -> tuple[Finding, ...]:
        """
        Return why an estimate is not of a cell of the nominal capacity, new or aged; empty if it may be, or without a nominal
        capacity. The cell holds at least the charge drawn and at most ``q_mobile``: the nearest charge between is compared.
        """
        if self.nominal_Ah is None:
            return ()
        usual_C = self._usual_size.usual_C
        nearest_C = float(np.clip(usual_C, Q_MOBILE_PER_CAPACITY * drawn_C, estimate.q_mobile))
        ratio = exp(PRIOR_LIMIT_SD * hypot(SIZE_WIDTH, estimate.sd_q_mobile / estimate.q_mobile))
        if not abs(log(nearest_C / usual_C)) > log(ratio):
            return ()
        sizes_C = {"record_Ah": nearest_C, "least_Ah": usual_C / ratio, "most_Ah": usual_C * ratio}
        return (Finding.of(Reason.PRIOR_WRONG, "q_mobile", **{name: each_C / 3600.0 for name, each_C in sizes_C.items()}),)

    def other_load(self, current_A: float) -> tuple[Finding, ...]:
        """Return why the constants may be wrong at a mean current; empty if they were fitted to such a current."""
        if self.fit is None or self.fit.currents_A is None or not current_A > 0.0:
            return ()
        low_A, high_A = self.fit.currents_A
        if low_A / _SAME_LOAD <= current_A <= high_A * _SAME_LOAD:
            return ()
        return (Finding.of(Reason.OTHER_LOAD, load_A=current_A, least_fitted_A=low_A, most_fitted_A=high_A),)

    def tells_new_capacity(self, current_A: float) -> bool:
        """Return whether the constants determine the capacity of a new cell at a load: if fitted to this load alone."""
        low_A, high_A = (self.fit and self.fit.currents_A) or (current_A, current_A)
        return self.cell is not None and high_A <= low_A * _SAME_LOAD and not self.other_load(current_A)

    def calibrator(
        self, cell: CellParameters | None = None, start: Start | None = None, size: SizePrior | None = None
    ) -> LeastSquares | PolicyEstimator:
        """
        Build the calibrator, which refuses options that it cannot use.

        :param cell: constants of the model at the temperature of a discharge; ``None``: those of the settings
        :param start: how the discharge starts; ``None``: as the settings say
        :param size: usual ``q_mobile`` of cells of this size, for least squares of a record in progress; ``None``: all sizes
            are equally likely
        :raises ValueError: for an option out of range
        """
        if self.method == "policy":
            return PolicyEstimator.pretrained(recorded=True)
        resolved, rates_sd = self.resolved, self._rates_sd()
        initial_soc: InitialSoc = 1.0 if self.initial_soc == "rest" else self.initial_soc
        return LeastSquares(
            cell=cell or self.constants,
            thermal=resolved.thermal,
            mismatch_V=resolved.mismatch_V / explained_ratio(rates_sd),
            prior_q_mobile_C=self.prior_q_mobile_C,
            current_gain_sd=self.current_gain_sd,
            initial_soc=initial_soc if start is None else (start.soc, start.sd_soc),
            q_mobile_bounds_C=self.q_mobile_bounds_C,
            usual_start=resolved.usual_start,
            nuisance=rates_sd,
            path=self.path,
            size=size,
        )

    def _rates_sd(self) -> Mapping[str, float]:
        """Uncertainty of the rate constants that least squares estimate: of all that no setting, nor a path, determines."""
        if self.path is not None:
            return {}
        if self.cell_rates_sd is not None:
            return self.cell_rates_sd
        if self.fit is not None:
            return self.fit.rates_sd
        return RATE_PRIOR_SD if self.cell is None else dict.fromkeys(RATE_PRIOR_SD, SAME_KIND_SD)
