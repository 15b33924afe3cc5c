"""What the environments, one cell or many, ask of a calibration task."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from battery_env.electrochemistry import FloatArray

Parameter = Literal["q_mobile", "r_o"]

#: Observations are clipped here; what a calibrated model shows is of order 1.
OBSERVATION_LIMIT = 100.0


def check_options(given: Iterable[str], known: Iterable[str]) -> None:
    """
    Refuse options that a task does not have.

    :param given: names of the options that were given
    :param known: names of those that there are
    :raises TypeError: if one is not known
    """
    unknown = set(given) - set(known)
    if unknown:
        raise TypeError(f"{', '.join(sorted(unknown))}: no such option. There are {', '.join(sorted(known))}")


def checked_action(action: NDArray[np.floating], shape: tuple[int, ...]) -> FloatArray:
    """
    Refuse what is no action: compiled code would read beyond a short one, and NaN would spread through the episode.

    :param action: the action
    :param shape: its shape
    :return: the same as a contiguous float64 array
    :raises ValueError: for another shape, NaN, or what is no number
    """
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

    :param cells: size of the batch
    :param parameters: what the action stands for, in its order
    :param observation_size: length of an observation
    :param episode_steps: decisions per episode; fewer where the data end
    :param decision_s: time between two decisions, s
    """

    #: what :meth:`report` returns
    REPORTED: ClassVar[tuple[str, ...]] = ("q_mobile", "r_o", "q_mobile_hat", "r_o_hat", "voltage", "voltage_hat", "soc")

    cells: int
    parameters: tuple[Parameter, ...]
    observation_size: int
    episode_steps: int
    decision_s: float

    @abstractmethod
    def start(
        self,
        rows: NDArray[np.intp],
        generators: Sequence[np.random.Generator],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """
        Begin a new episode for some cells.

        :param rows: which cells of the batch, shape (m,)
        :param generators: one source of randomness for each of them, of length m
        :param options: choices that replace random draws, the same for all these cells; the task's environment documents them
        :raises ValueError: for an option that is unknown or out of range
        """

    @abstractmethod
    def observation(self) -> NDArray[np.float32]:
        """
        What the agent sees.

        :return: shape (cells, observation_size), within ``OBSERVATION_LIMIT``; a new array each time
        """

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
        Whose episode is over, as its steps or its data have come to an end. No episode terminates.

        :return: shape (cells,); a new array each time
        """

    @abstractmethod
    def report(self) -> dict[str, FloatArray]:
        """
        Where each cell stands after its last decision; for ``info``, rendering and evaluation, never for the policy.

        :return: by name of ``REPORTED``, arrays of shape (cells,), new each time: true and estimated parameters, C and ohm;
            voltage of cell and model, V; the state of charge of the cell
        """
