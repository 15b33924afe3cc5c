"""What every calibrator returns, and the interfaces that evaluation and live use rely on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from battery_env.cells import check_record, drawn_charge_C
from battery_env.electrochemistry import FloatArray, check_q_mobile, check_r_o

#: What can be calibrated.
PARAMETERS: tuple[str, ...] = ("q_mobile", "r_o")

BoolArray = NDArray[np.bool_]
StringArray = NDArray[np.object_]


class Record(Protocol):
    """
    What was measured during one discharge; a simulated :class:`~battery_env.trajectories.Trajectory` and a recorded
    :class:`~battery_env.cells.Discharge` are both records. All arrays have shape (T,); the current is positive in discharge.
    """

    @property
    def time_s(self) -> FloatArray: ...

    @property
    def voltage_V(self) -> FloatArray: ...

    @property
    def current_A(self) -> FloatArray: ...


@dataclass(frozen=True)
class Estimate:
    """
    What a calibrator believes about a cell.

    :param q_mobile: charge that can move, C
    :param r_o: ohmic resistance, ohm
    :param sd_q_mobile: its stated standard deviation, C; NaN if the calibrator states none
    :param sd_r_o: likewise, ohm
    :param settled: whether the data determine the estimate, and nothing in the record contradicts it: a fully charged cell
        says nothing about ``q_mobile``, and a prior alone settles nothing
    :param reason: why it is not settled, in a sentence or two; empty if it is
    """

    q_mobile: float
    r_o: float
    sd_q_mobile: float = float("nan")
    sd_r_o: float = float("nan")
    settled: bool = True
    reason: str = ""


@dataclass(frozen=True)
class EstimateTrace:
    """
    The estimates of one discharge in the order they were made, arrays of shape (K,), K >= 1.

    :param time_s: time of the last sample that each estimate has seen, s
    :param q_mobile: C
    :param r_o: ohm
    :param sd_q_mobile: stated standard deviations, C; ``None`` if the calibrator states none
    :param sd_r_o: likewise, ohm
    :param settled: whether the calibrator takes each estimate for settled; ``None`` if it does not say
    :param reason: why each is not settled, strings, empty for those that are; ``None`` if the calibrator does not say
    """

    time_s: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    sd_q_mobile: FloatArray | None = None
    sd_r_o: FloatArray | None = None
    settled: BoolArray | None = None
    reason: StringArray | None = None

    @classmethod
    def of(cls, time_s: Sequence[float] | FloatArray, estimates: Sequence[Estimate]) -> EstimateTrace:
        """
        A trace of single estimates.

        :param time_s: time of the last sample that each has seen, s
        :param estimates: as many
        :return: the trace
        """
        names = ("q_mobile", "r_o", "sd_q_mobile", "sd_r_o", "settled")
        columns = {name: np.array([getattr(estimate, name) for estimate in estimates]) for name in names}
        return cls(np.array(time_s), **columns, reason=np.array([estimate.reason for estimate in estimates], dtype=object))


class Estimator(ABC):
    """
    A calibrator: from the record of a discharge to (q_mobile, r_o), without labels.
    """

    @abstractmethod
    def estimate(self, record: Record) -> Estimate:
        """
        The estimate after the whole record.

        :param record: one discharge
        :return: the estimate
        """

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        The estimates over time of many discharges; a calibrator that only looks back gives one each, at the end.

        :param records: discharges
        :return: one trace per discharge, in the same order
        """
        return [EstimateTrace.of([record.time_s[-1]], [self.estimate(record)]) for record in records]


class OnlineEstimator(Estimator):
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
        """
        Forget all samples: the next one is the first of a discharge.
        """

    @abstractmethod
    def update(self, voltage_V: float, current_A: float, dt_s: float) -> Estimate:
        """
        Take in one sample.

        :param voltage_V: terminal voltage, V
        :param current_A: current that flows from this sample to the next one, positive in discharge, A
        :param dt_s: time since the previous sample, s; without meaning at the first one
        :return: the estimate
        :raises ValueError: for values that cannot be meant
        """

    def estimate(self, record: Record) -> Estimate:
        """
        The estimate at the last sample of a record.

        :param record: one discharge
        :return: the estimate
        :raises ValueError: if the record cannot be used
        """
        return last_estimate(self.trace([record])[0])

    def trace(self, records: Sequence[Record]) -> list[EstimateTrace]:
        """
        One estimate for every sample of many discharges.

        :param records: discharges
        :return: one trace per discharge, in the same order
        :raises ValueError: if a record cannot be used
        """
        traces = []
        for record in records:
            samples = Samples.of(record, self.dt_s)
            self.reset()
            traces.append(EstimateTrace.of(samples.time_s, [self.update(*sample) for sample in samples.measured()]))
        self.reset()
        return traces


def last_estimate(trace: EstimateTrace) -> Estimate:
    """
    The last estimate of a trace that states uncertainties and what is settled.

    :param trace: of one discharge
    :return: its last estimate
    """
    assert trace.sd_q_mobile is not None and trace.sd_r_o is not None
    assert trace.settled is not None and trace.reason is not None
    return Estimate(
        q_mobile=float(trace.q_mobile[-1]),
        r_o=float(trace.r_o[-1]),
        sd_q_mobile=float(trace.sd_q_mobile[-1]),
        sd_r_o=float(trace.sd_r_o[-1]),
        settled=bool(trace.settled[-1]),
        reason=str(trace.reason[-1]),
    )


class Samples(NamedTuple):
    """
    A record in the form in which it is measured live, arrays of shape (T,).

    :param time_s: s
    :param voltage_V: V
    :param current_A: mean current from each sample to the next, A
    :param dt_s: time since the previous sample, s; 0 for the first one
    """

    time_s: FloatArray
    voltage_V: FloatArray
    current_A: FloatArray
    dt_s: FloatArray

    @classmethod
    def of(cls, record: Record, dt_s: float) -> Samples:
        """
        Check a record and convert it. Between samples the current is linear, as
        :func:`battery_env.cells.drawn_charge_C` has it, so that the charge drawn is kept exactly.

        :param record: one discharge
        :param dt_s: in a record whose samples lie this far apart the current is taken as it is, s
        :return: its samples
        :raises ValueError: as :func:`battery_env.cells.check_record`
        """
        time_s, voltage_V, current_A = check_record(record.time_s, record.voltage_V, record.current_A)
        step_s = np.diff(time_s)
        if not np.allclose(step_s, dt_s, rtol=1e-6, atol=0.0):
            mean_A = np.diff(drawn_charge_C(time_s, current_A, time_s)) / step_s
            current_A = np.append(mean_A, current_A[-1])
        return cls(time_s, voltage_V, current_A, np.append(0.0, step_s))

    def measured(self) -> zip[tuple[float, float, float]]:
        """
        What :meth:`OnlineEstimator.update` takes, sample by sample.

        :return: voltage, current and time since the previous sample
        """
        return zip(self.voltage_V.tolist(), self.current_A.tolist(), self.dt_s.tolist(), strict=True)


def check_parameters(parameters: Sequence[str]) -> tuple[str, ...]:
    """
    Refuse a choice of parameters that a calibrator cannot search for.

    :param parameters: their names
    :return: the same as a tuple
    :raises ValueError: unless they are one or both of ``PARAMETERS``
    """
    names = tuple(parameters)
    if not names or len(set(names)) < len(names) or set(names) - set(PARAMETERS):
        raise ValueError(f"parameters must be one or both of {PARAMETERS}, got {parameters!r}")
    return names


def check_bounds(
    q_mobile_bounds_C: tuple[float, float], r_o_bounds_ohm: tuple[float, float]
) -> dict[str, tuple[float, float]]:
    """
    Refuse bounds that cannot be meant.

    :param q_mobile_bounds_C: least and largest ``q_mobile``, C
    :param r_o_bounds_ohm: least and largest ``r_o``, ohm
    :return: both, by name
    :raises ValueError: if they are out of range or not in order
    """
    bounds = {"q_mobile": q_mobile_bounds_C, "r_o": r_o_bounds_ohm}
    for name, limits in (("q_mobile", check_q_mobile(q_mobile_bounds_C)), ("r_o", check_r_o(r_o_bounds_ohm))):
        if limits.shape != (2,) or not limits[0] < limits[1]:
            raise ValueError(f"the bounds of {name} must be (lower, upper) with lower < upper, got {bounds[name]!r}")
    return bounds


def check_gain_sd(current_gain_sd: float) -> float:
    """
    Refuse an uncertainty of the current sensor that cannot be meant.

    :param current_gain_sd: standard deviation of its gain, as a share of it
    :return: the same
    :raises ValueError: unless it is within 0 .. 1
    """
    if not 0.0 <= current_gain_sd < 1.0:
        raise ValueError(f"current_gain_sd is a share within 0 .. 1 (1 %: 0.01), got {current_gain_sd!r}")
    return float(current_gain_sd)
