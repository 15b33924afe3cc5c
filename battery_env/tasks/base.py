"""What the environments, one cell or many, ask of a calibration task."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from battery_env.checks import check_whole_number
from battery_env.electrochemistry import FloatArray
from battery_env.estimators.estimator import Record
from battery_env.trajectories import IntArray

if TYPE_CHECKING:
    from battery_env.tasks.voltage.fit import Fitted

# Which cells of a batch, and a source of randomness for each of them.
Rows = NDArray[np.intp]
Generators = Sequence[np.random.Generator]
#: Observations are clipped here; what a calibrated model shows is of order 1.
OBSERVATION_LIMIT = 100.0


def check_counts(**values: int) -> None:
    """Refuse numbers of things that there must be."""
    for name, value in values.items():
        if check_whole_number(name, value) < 1:
            raise ValueError(f"{name} must be at least 1, got {value!r}")


def checked_action(action: NDArray[np.floating], shape: tuple[int, ...]) -> FloatArray:
    """Refuse what is no action: compiled code would read beyond a short one, and NaN would spread through the episode."""
    array = np.asarray(action)
    if array.dtype.kind not in "fiu" or array.shape != shape:
        raise ValueError(f"action must hold numbers, shape {shape}, got {array.dtype} values of shape {array.shape}")
    if np.isnan(array).any():
        raise ValueError(f"action must hold numbers in [-1, 1], got NaN: {array}")
    return np.asarray(array, dtype=np.float64, order="C")


class CalibrationTask(ABC):
    """
    A calibration task as a Markov decision process, for ``cells`` cells side by side, each in its own episode.

    All randomness of an episode is drawn when it starts, from the generator of its cell: the scalar environment is the batch
    of one, and a batch makes the same episodes as that many scalar environments.

    What is registered is a class: its keyword arguments are the options of its environments.

    :ivar parameters: what the action stands for, in its order
    :ivar cells: size of the batch
    :ivar dataset: the discharges that episodes are drawn from
    :ivar observation_size: length of an observation
    :ivar episode_steps: decisions per episode; fewer where the data end
    :ivar decision_s: time between two decisions, s
    """

    #: what :meth:`report` returns
    REPORTED: ClassVar[tuple[str, ...]] = ("q_mobile", "r_o", "q_mobile_hat", "r_o_hat", "voltage", "voltage_hat", "soc")

    #: whether estimates are independent of each other, so that the mean of those over a record counts, and not the last one
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
        """What the task can be asked for, default values by name; its page says what each option means."""
        arguments = inspect.signature(cls).parameters.values()
        return {argument.name: argument.default for argument in arguments if argument.kind is argument.KEYWORD_ONLY}

    def _refuse_beside_a_dataset(self, **chosen: Any) -> None:
        """Refuse options that choose discharges, where the discharges are given."""
        defaults = self.options()
        others = [name for name, value in chosen.items() if value != defaults.get(name, value)]
        if others:
            raise ValueError(f"dataset stands in place of {', '.join(others)}: give one or the other")

    @abstractmethod
    def start(self, rows: Rows, generators: Generators, options: Mapping[str, Any] | None = None) -> None:
        """
        Begin a new episode for some cells.

        :param rows: which cells of the batch, shape (m,)
        :param generators: one source of randomness for each of them, of length m
        :param options: choices that replace random draws, the same for all these cells; the task's page names them
        :raises ValueError: for an option that is unknown or out of range
        """

    @abstractmethod
    def observation(self) -> NDArray[np.float32]:
        """What the agent sees: a new array of shape (cells, observation_size), within ``OBSERVATION_LIMIT``."""

    @abstractmethod
    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """
        Take one decision for every cell. A batch goes on while some of its episodes are over: what such a cell does until it
        is started again means nothing, but must not fail.

        :param action: in [-1, 1], beyond it is clipped, shape (cells, len(parameters))
        :return: cost, shape (cells,), at least 0
        :raises ValueError: for another shape, NaN, or what is no number
        """

    @abstractmethod
    def truncated(self) -> NDArray[np.bool_]:
        """
        Whose episode is over, as its steps or its data have come to an end: a new array of shape (cells,). No episode
        terminates.
        """

    @classmethod
    @abstractmethod
    def follow(cls, records: Sequence[Any], decision_s: float, **options: Any) -> CalibrationTask:
        """
        Go through whole records from their beginning, for evaluation: every episode is as long as its records, and nothing is
        random but what options ask for.

        :param records: the discharges
        :param decision_s: time between two decisions, s, where the task can choose it
        :param options: of the task, but for those of its data and the length of its episodes
        :return: the task, at its first observations
        """

    @abstractmethod
    def seen(self) -> tuple[IntArray, FloatArray, IntArray]:
        """
        Which data the next decision knows: each cell's discharge, the time of its last sample, s, and how many samples these
        are, new arrays of shape (cells,).
        """

    def fitted(self) -> Fitted | None:
        """What the fit in the observation says of each cell (options ``nuisance`` and ``path``), if there is one."""
        return None

    def drop_ended(self) -> None:  # noqa: B027 (a task may go on with all cells)
        """Go on without the cells whose episodes are over, if that saves time; by default they stay."""

    @abstractmethod
    def report(self) -> dict[str, FloatArray]:
        """
        Where each cell stands after its last decision; for ``info``, rendering and evaluation, never for the policy.

        :return: by name of ``REPORTED``, arrays of shape (cells,), new each time: true and estimated parameters, C and ohm;
            voltage of cell and model, V; the state of charge of the cell
        """
