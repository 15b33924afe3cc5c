"""The interfaces that evaluation and live use rely on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from battery_env.arrays import FloatArray
from battery_env.checks import check_numbers
from battery_env.electrochemistry import LoadUnit, voltage
from battery_env.electrochemistry.ends import LONGEST_S, Cells, simulate_to_cut_off
from battery_env.estimates import Estimate, EstimateTrace, last_estimate
from battery_env.estimators.state_files import Saved
from battery_env.loads import KnownLoad, Load, known_load
from battery_env.parameters import PARAMETERS
from battery_env.records import Record, Stream
from battery_env.records.model import RecordModel


class Estimator(ABC):
    """A calibrator: from the record of a discharge to (q_mobile, r_o), without labels."""

    @abstractmethod
    def estimate(self, record: Record) -> Estimate:
        """The estimate after the whole record of one discharge."""

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        The estimates over time of many discharges, in their order; a calibrator that only looks back gives one each, at the
        end.
        """
        return [EstimateTrace.of([record.time_s[-1]], [self.estimate(record)]) for record in records]


class Remaining(NamedTuple):
    """
    How long a discharge will go on.

    :param time_s: until the cut-off, s; infinite if it is not reached within a week
    :param sd_s: its standard deviation, s; NaN if the estimator states none
    """

    time_s: float
    sd_s: float = float("nan")


class OnlineEstimator(Saved, Estimator):
    """
    A calibrator that runs along with a discharge: one estimate a sample, from what was measured until then.

    .. code-block:: python

      estimator.reset()  # the cell is fully charged and at rest
      for voltage_V, current_A in measurements:
          estimate = estimator.update(voltage_V, current_A, dt_s=1.0)

    The methods that take whole records start anew with each, and leave the estimator reset.
    """

    #: Time step of the model, s. The current of a record whose samples lie that far apart, as simulated ones do, is taken as
    #: it is.
    dt_s: float

    @abstractmethod
    def reset(self) -> None:
        """Forget all samples: the next one is the first of a discharge."""

    @abstractmethod
    def update(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> Estimate:
        """
        Take in one sample.

        :param voltage_V: terminal voltage, V; NaN where it is missing, but for the first sample
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one. The current of the previous sample
            has flowed all the time
        :param temperature_C: of the cell, degC; ``None``: not measured
        :raises TypeError: for what is no number
        :raises ValueError: for invalid values; after either error the estimator is as it was
        """

    def check(self, voltage_V: float, current_A: float, dt_s: float, temperature_C: float | None = None) -> None:
        """Refuse a sample that :meth:`update` would refuse, and change nothing."""

    def at_last_sample(self) -> tuple[RecordModel, Cells]:
        """
        The model that follows the discharge, if there is one, and its cell at the last sample, which ``soc``, ``voltage_V``
        and :meth:`remaining` are told from.
        """
        raise NotImplementedError(f"{type(self).__name__} has no model that follows the discharge")

    @property
    def soc(self) -> float:
        """State of charge at the last sample: the share of ``q_mobile`` in the negative electrode."""
        _, cell = self.at_last_sample()
        return float(cell.soc[0])

    @property
    def voltage_V(self) -> float:
        """Voltage of the model at the last sample, V."""
        model, cell = self.at_last_sample()
        return float(voltage(cell.state[0], cell.q_mobile[0], model.cell))

    def remaining(
        self,
        load: float | ArrayLike | KnownLoad | Callable[[FloatArray], ArrayLike],
        cut_off_V: float | None = None,
        load_unit: LoadUnit = "current",
    ) -> Remaining:
        """
        The time to the cut-off under a load, from the last sample on. What is not known of it :func:`battery_env.forecast`
        tells, which takes random loads too; it needs the record.

        :param load: a number; an array of one value a step of ``dt_s``; a :class:`battery_env.loads.Load` or a ``Cycle``, of
            which the mean over each step counts, in its own unit; or any function of time in s, of which its value at the
            start of each step does. Under a negative number, a charge, the cut-off is never reached
        :param cut_off_V: V; ``None``: the ``VEOD`` of the cell
        :param load_unit: of a number, an array or a function: ``"current"`` in A or ``"power"`` in W
        :raises ValueError: for an invalid load, also for one that varies and charges the cell beyond full, and for
            an array that ends before the discharge does
        """
        model, cell = self.at_last_sample()
        values = np.empty(0) if callable(load) or np.ndim(load) == 0 else check_numbers("load", load)
        starts_s = model.dt_s * np.arange(len(values), dtype=np.float64)
        given_s = len(values) * model.dt_s if len(values) else np.inf
        given = Load(starts_s, values, load_unit) if len(values) else known_load(load, load_unit)
        (end_s,) = simulate_to_cut_off(cell, model, [given], model.cell.VEOD if cut_off_V is None else cut_off_V).time_s
        if given_s < min(end_s, LONGEST_S):
            raise ValueError(
                f"load ends after {given_s:g} s, before the discharge does. Append what is to come, or "
                "give a Load of battery_env.loads, whose last value goes on."
            )
        return Remaining(float(end_s))

    def estimate(self, record: Record) -> Estimate:
        """The estimate at the last sample of a record; a ``ValueError`` if that cannot be used."""
        return last_estimate(self.trace([record])[0])

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """One estimate for every sample of many discharges. A temperature that was measured is taken in with each sample."""
        traces = [self.follow(record) for record in records]
        self.reset()
        return traces

    def follow(self, record: Record) -> EstimateTrace:
        """One estimate for every sample of a discharge, after which the estimator stands at the last one."""
        stream = Stream.of(record, self.dt_s)
        measured: Iterable[tuple[float, ...]] = stream.samples()
        if stream.temperature_C is not None:
            measured = ((*sample, t_C) for sample, t_C in zip(measured, stream.temperature_C.tolist(), strict=True))
        self.reset()
        return EstimateTrace.of(stream.time_s, [self.update(*sample) for sample in measured])


def check_bounds(
    q_mobile_bounds_C: tuple[float, float], r_o_bounds_ohm: tuple[float, float]
) -> dict[str, tuple[float, float]]:
    """Refuse invalid bounds."""
    given = zip(PARAMETERS.values(), (q_mobile_bounds_C, r_o_bounds_ohm), strict=True)
    return {parameter.name: parameter.check_bounds(f"the bounds of {parameter.name}", bounds) for parameter, bounds in given}
