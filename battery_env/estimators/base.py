"""The interfaces that evaluation and live use rely on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from battery_env.estimates import Estimate, EstimateTrace, last_estimate
from battery_env.parameters import PARAMETERS
from battery_env.records import Record, Stream


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
            stream = Stream.of(record, self.dt_s)
            self.reset()
            traces.append(EstimateTrace.of(stream.time_s, [self.update(*sample) for sample in stream.samples()]))
        self.reset()
        return traces


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
    given = zip(PARAMETERS.values(), (q_mobile_bounds_C, r_o_bounds_ohm), strict=True)
    return {parameter.name: parameter.check_bounds(f"the bounds of {parameter.name}", bounds) for parameter, bounds in given}
