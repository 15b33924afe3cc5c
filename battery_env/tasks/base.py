"""The interface of a calibration task, for the environments of one cell and of many."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.records import Record

if TYPE_CHECKING:
    from battery_env.tasks.voltage.fit import FitResult

# Indices of cells in a batch, and one random generator a cell.
Rows = NDArray[np.intp]
Generators = Sequence[np.random.Generator]
#: Limit of observations; the observations of a calibrated model are of order 1.
OBSERVATION_LIMIT = 100.0


class CalibrationTask(ABC):
    """
    A calibration task as a Markov decision process, for ``cells`` cells side by side, each in its own episode.

    A task draws all randomness of an episode at its start, from the generator of the cell: the scalar environment is the batch
    of one, and a batch makes the same episodes as that many scalar environments.

    The registry holds classes of tasks: the keyword arguments of a class are the options of its environments.

    :ivar parameters: the parameters that the action sets, in its order
    :ivar cells: size of the batch
    :ivar dataset: the discharges that episodes are drawn from
    :ivar observation_size: length of an observation
    :ivar episode_steps: decisions per episode; fewer if the data end earlier
    :ivar decision_s: time between two decisions, s
    """

    #: names of :meth:`report`
    REPORT_NAMES: ClassVar[tuple[str, ...]] = ("q_mobile", "r_o", "q_mobile_hat", "r_o_hat", "voltage", "voltage_hat", "soc")

    #: whether estimates are independent of each other, so that the mean over a record is the result, instead of the last
    is_averaged: ClassVar[bool]

    parameters: tuple[str, ...]
    cells: int
    dataset: Sequence[Record]
    observation_size: int
    episode_steps: int
    decision_s: float

    @property
    @abstractmethod
    def estimate(self) -> FloatArray:
        """(q_mobile, r_o) of the model, C and ohm, shape (cells, 2); a new array each time."""

    @classmethod
    def options(cls) -> dict[str, Any]:
        """Return the options of the task, default values by name; the page of the task explains them."""
        arguments = inspect.signature(cls).parameters.values()
        return {argument.name: argument.default for argument in arguments if argument.kind is argument.KEYWORD_ONLY}

    def _refuse_with_dataset(self, **options: Any) -> None:
        """Refuse options of a standard data set together with ``dataset``."""
        defaults = self.options()
        conflicting = [name for name, value in options.items() if value != defaults.get(name, value)]
        if conflicting:
            raise ValueError(f"dataset stands in place of {', '.join(conflicting)}: give one or the other")

    @abstractmethod
    def start(self, rows: Rows, generators: Generators, options: Mapping[str, Any] | None = None) -> None:
        """
        Begin a new episode for some cells.

        :param rows: indices of the cells, shape (m,)
        :param generators: one random generator a cell, of length m
        :param options: choices that replace random draws, for all these cells; the page of the task names them
        :raises ValueError: for an option that is unknown or out of range
        """

    @abstractmethod
    def observation(self) -> NDArray[np.float32]:
        """Return the observations: a new array of shape (cells, observation_size), within ``OBSERVATION_LIMIT``."""

    @abstractmethod
    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """
        Take one decision for every cell. A cell whose episode is over may be among them: its results mean nothing until its
        next start, but must not fail.

        :param action: in [-1, 1], clipped, shape (cells, len(parameters))
        :return: cost, shape (cells,), at least 0
        :raises ValueError: for another shape, NaN, or a value that is no number
        """

    def _checked_action(self, action: NDArray[np.floating]) -> FloatArray:
        """Refuse an invalid action: compiled code would read beyond a short array, and NaN would spread."""
        array, shape = np.asarray(action), (self.cells, len(self.parameters))
        if array.dtype.kind not in "fiu" or array.shape != shape:
            raise ValueError(f"action must hold numbers, shape {shape}, got {array.dtype} values of shape {array.shape}")
        if np.isnan(array).any():
            raise ValueError(f"action must hold numbers in [-1, 1], got NaN: {array}")
        return np.asarray(array, dtype=np.float64, order="C")

    @abstractmethod
    def truncated(self) -> NDArray[np.bool_]:
        """Return whether the episode of a cell is over: a new array of shape (cells,). No episode terminates."""

    @classmethod
    @abstractmethod
    def of_records(cls, records: Sequence[Any], decision_s: float, **options: Any) -> CalibrationTask:
        """
        Make a task of whole records, for evaluation: every episode is as long as its record, and only options bring
        randomness.

        :param records: the discharges
        :param decision_s: time between two decisions, s, where the task can choose it
        :param options: of the task, without its data and the length of its episodes
        :return: the task, at its first observations
        """

    @abstractmethod
    def available_data(self) -> tuple[IntArray, FloatArray, IntArray]:
        """
        Return the data of the next decision: the discharge of each cell, the time of its last sample, s, and the number of
        samples, new arrays of shape (cells,).
        """

    def fit(self) -> FitResult | None:
        """Return the fit in the observation of each cell, if there is one (options ``nuisance`` and ``path``)."""
        return None

    def drop_truncated(self) -> None:  # noqa: B027 (a task may go on with all cells)
        """Drop the cells whose episodes are over, if that saves time; by default all cells stay."""

    @abstractmethod
    def report(self) -> dict[str, FloatArray]:
        """
        Return the state of each cell after its last decision; for ``info``, rendering and evaluation, never for the policy.

        :return: by ``REPORT_NAMES``, new arrays of shape (cells,): true and estimated parameters, C and ohm; voltage of cell
            and model, V; the state of charge of the cell
        """
