"""A batch of cells, each in its own episode of a full-state task."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray


@dataclass(eq=False)
class Cells:
    """
    n cells, each at its own sample t. All arrays have one row a cell. An array that no option asks for has no columns.

    :param trajectory: number of the discharge
    :param sample: t
    :param last_sample: last sample of the discharge
    :param last_decision: last sample at which there is a decision
    :param load_start: index of the first load of the discharge
    :param steps: decisions of this episode, fewer where the data end
    :param decisions: number of those made
    :param state: x_t, shape (n, 8)
    :param next_state: x_{t+1}
    :param model_state: x̂_t
    :param sensed_before: x_t as sensors with errors measured it
    :param sensed: x_{t+1} as sensors with errors measure it
    :param load: u_{t+1}, over the step from t to t + 1, W or A
    :param voltage: of the cell at t, V
    :param soc: state of charge of the cell at t
    :param q_mobile: of the cell, C
    :param r_o: of the cell, ohm
    :param q_mobile_hat: of the model, C
    :param r_o_hat: of the model, ohm
    :param last_action: shape (n, parameters)
    :param constants: of the cell, where they are not the model's, shape (n, 13)
    :param noise: standard normal draws of the episode, of the process first, shape (n, measured states, columns)
    """

    trajectory: IntArray
    sample: IntArray
    last_sample: IntArray
    last_decision: IntArray
    load_start: IntArray
    steps: IntArray
    decisions: IntArray
    state: FloatArray
    next_state: FloatArray
    model_state: FloatArray
    sensed_before: FloatArray
    sensed: FloatArray
    load: FloatArray
    voltage: FloatArray
    soc: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    q_mobile_hat: FloatArray
    r_o_hat: FloatArray
    last_action: FloatArray
    constants: FloatArray
    noise: FloatArray

    @property
    def measured(self) -> FloatArray:
        """x_{t+1} as the sensors measure it, shape (n, 8)."""
        return self.sensed if self.sensed.size else self.next_state

    @property
    def measured_before(self) -> FloatArray:
        """x_t as the sensors measured it, shape (n, 8)."""
        return self.sensed_before if self.sensed_before.size else self.state

    def take(self, rows: NDArray[np.bool_]) -> Cells:
        """Some of the cells."""
        return Cells(**{name: np.ascontiguousarray(values[rows]) for name, values in vars(self).items()})

    def put(self, rows: NDArray[np.intp], others: Cells) -> None:
        """Overwrite some of the cells."""
        for values, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            values[rows] = theirs
