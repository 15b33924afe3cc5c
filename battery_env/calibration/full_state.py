"""
The calibration of a battery model as a Markov decision process, for a batch of cells at once.

The agent picks the aged parameter of the model; the model then takes one step from its own state x̂_t under the load; the
cost is its distance from the measured state x_{t+1} (Unagar et al. 2020). The scalar environment is the batch of one, and
a policy is evaluated on the batch of all test trajectories: both run this code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from battery_env.electrochemistry import (
    NEW_CELL,
    STATE_SIZE,
    VO,
    FloatArray,
    state_of_charge,
    step_into,
    voltage_into,
)
from battery_env.trajectories import IntArray, TrajectoryDataset

Parameter = Literal["q_mobile", "r_o"]

#: What the action's range [-1, 1] is mapped to (the authors' code), C and ohm.
ACTION_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (4000.0, 8000.0), "r_o": (0.08, 0.22)}

#: The state of the isothermal model, without the temperature.
OBSERVED = slice(VO, STATE_SIZE)
OBSERVED_SIZE = STATE_SIZE - VO


# A model that was wrong for a while has moved too much or too little charge from one electrode to the other; in both, nine
# tenths of it are in the bulk
_PERTURBATION = np.array([1.0, 1.0, 1.0, -0.9, -0.1, 0.9, 0.1])


@dataclass(frozen=True, eq=False)
class Formulation:
    """
    How states become observations and costs. All arrays follow the state without temperature: Vo, Vsn, Vsp, qnB, qnS, qpB,
    qpS, in V and C.

    :param state_scale: what observed states are divided by, shape (7,)
    :param load_scale: what observed loads are divided by, W
    :param error_scale: what state errors are divided by, in the cost and in the innovation, shape (7,)
    :param innovation: whether the observation holds x_{t+1} minus what the model predicts from x̂_t with a new cell's
        parameters
    :param cost_limit: the largest cost
    """

    state_scale: FloatArray
    load_scale: float
    error_scale: FloatArray
    innovation: bool
    cost_limit: float

    def cost(self, error: FloatArray) -> FloatArray:
        """
        The Euclidean norm of the scaled error of the state, at most ``cost_limit``: near the end of a discharge the norm spans
        four orders of magnitude; the cost must not, or the critic does not see the small ones.

        :param error: x̂_{t+1} - x_{t+1}, shape (n, 7)
        :return: shape (n,)
        """
        scaled = error / self.error_scale
        return np.minimum(np.sqrt(np.einsum("ij,ij->i", scaled, scaled)), self.cost_limit)


class PaperFormulation(Formulation):
    """
    The authors' literal observation and cost: states divided by the new cell's, loads by 20 W; cost 0.5 times the norm of the
    error of the voltages in V plus 0.5 times that of the charges in C, times 50 where it exceeds 1e-4.
    """

    def cost(self, error: FloatArray) -> FloatArray:
        """
        The authors' cost.

        :param error: x̂_{t+1} - x_{t+1}, shape (n, 7)
        :return: shape (n,)
        """
        distance = 0.5 * np.linalg.norm(error[:, :3], axis=1) + 0.5 * np.linalg.norm(error[:, 3:], axis=1)
        return np.minimum(np.where(distance > 1e-4, 50.0 * distance, distance), self.cost_limit)


# State scales: what a new cell's states reach under 8 to 16 W. Error scales: a step with a parameter that is off by 10 % is
# off by some tenths in Vo, Vsn and Vsp. Charges count little on purpose: they never forget an error, so that any weight in
# the cost makes the agent repay old errors with wrong parameters.
_SCALED = Formulation(
    state_scale=np.array([0.5, 0.1, 0.01, 6840.0, 760.0, 11400.0, 1266.0]),
    load_scale=16.0,
    error_scale=np.array([0.01, 1e-5, 1e-5, 20.0, 20.0, 20.0, 20.0]),
    innovation=True,
    cost_limit=5.0,
)

# The authors' code
_PAPER = PaperFormulation(
    state_scale=np.array([1.0, 1.0, 1.0, 6840.0, 760.0, 4560.0, 506.67]),
    load_scale=20.0,
    error_scale=np.ones(OBSERVED_SIZE),
    innovation=False,
    cost_limit=1e4,
)

FORMULATIONS: dict[str, Formulation] = {"scaled": _SCALED, "paper": _PAPER}

#: Observations are clipped here; what a calibrated model shows is of order 1.
OBSERVATION_LIMIT = 100.0


class FullStateTask:
    """
    The paper's task for ``cells`` cells side by side: the state of the cell is measured, one parameter is to be found, the
    other one is known.

    The truth is simulated beside the model, from the data set's parameters and loads. The model is continued where a wrong
    parameter leaves its domain (:func:`battery_env.electrochemistry.step_into`, ``extended``).

    :param dataset: the discharges
    :param parameter: what the action is: ``"q_mobile"`` or ``"r_o"``
    :param formulation: observation and cost: ``"scaled"`` or ``"paper"``
    :param cells: size of the batch
    :raises ValueError: for an unknown parameter or formulation
    """

    def __init__(self, dataset: TrajectoryDataset, parameter: Parameter, formulation: str, cells: int) -> None:
        if parameter not in ACTION_RANGES:
            raise ValueError(f"parameter must be one of {tuple(ACTION_RANGES)}, got {parameter!r}")
        if formulation not in FORMULATIONS:
            raise ValueError(f"formulation must be one of {tuple(FORMULATIONS)}, got {formulation!r}")
        self.dataset = dataset
        self.parameter: Parameter = parameter
        self.formulation = FORMULATIONS[formulation]
        self.action_low, self.action_high = ACTION_RANGES[parameter]
        self.trajectory: IntArray = np.zeros(cells, dtype=np.int64)
        self.sample: IntArray = np.zeros(cells, dtype=np.int64)  # t: x̂_t and x_t are at this sample
        self.state = np.zeros((cells, STATE_SIZE))  # x_t
        self.next_state = np.zeros((cells, STATE_SIZE))  # x_{t+1}
        self.model_state = np.zeros((cells, STATE_SIZE))  # x̂_t
        self.load = np.zeros(cells)  # u_{t+1}: holds over the step from t to t + 1
        self.q_mobile, self.r_o = np.ones(cells), np.zeros(cells)
        self.q_mobile_hat, self.r_o_hat = np.ones(cells), np.zeros(cells)
        self._nominal_q_mobile = np.full(cells, NEW_CELL.q_mobile)
        self._nominal_r_o = np.full(cells, NEW_CELL.r_o)
        self._predicted = np.zeros((cells, STATE_SIZE))

    @property
    def cells(self) -> int:
        return len(self.sample)

    @property
    def observation_size(self) -> int:
        return OBSERVED_SIZE * (3 if self.formulation.innovation else 2) + 1

    def begin(
        self, rows: NDArray[np.intp], trajectory: IntArray, sample: IntArray, perturbation: FloatArray | None = None
    ) -> None:
        """
        Start some cells at given points of given trajectories, with the model in the true state or near it.

        :param rows: which cells of the batch, shape (m,)
        :param trajectory: which trajectories of the data set, shape (m,)
        :param sample: which of their samples, counted from full charge, shape (m,)
        :param perturbation: how far the model is off in Vo, Vsn, Vsp, and in charge that has moved from the negative to the
            positive electrode, each in units of its error scale, shape (m, 4)
        """
        self.trajectory[rows] = trajectory
        self.sample[rows] = sample
        self.q_mobile[rows] = self.dataset.q_mobile[trajectory]
        self.r_o[rows] = self.dataset.r_o[trajectory]
        # before the first action the model is the new cell's; the parameter that is known stays the true one
        self.q_mobile_hat[rows] = NEW_CELL.q_mobile if self.parameter == "q_mobile" else self.q_mobile[rows]
        self.r_o_hat[rows] = NEW_CELL.r_o if self.parameter == "r_o" else self.r_o[rows]
        state = self.dataset.states_at(trajectory, sample)
        self.state[rows] = state
        if perturbation is not None:
            offset = perturbation[:, [0, 1, 2, 3, 3, 3, 3]] * _PERTURBATION
            state[:, OBSERVED] += offset * self.formulation.error_scale
        self.model_state[rows] = state
        self._look_ahead()

    def _look_ahead(self) -> None:
        # u_{t+1} and x_{t+1} for all cells; at the end of its data a cell stays on its last sample, and is not asked for more
        dataset = self.dataset
        last = dataset.samples[self.trajectory] - 1
        self.load[:] = dataset.load_values[dataset.load_start[self.trajectory] + np.minimum(self.sample, last)]
        self._step(self.next_state, self.state, self.q_mobile, self.r_o)

    def _step(self, out: FloatArray, state: FloatArray, q_mobile: FloatArray, r_o: FloatArray) -> None:
        data = self.dataset
        step_into(
            out,
            state,
            self.load,
            q_mobile,
            r_o,
            data.dt_s,
            data.load_unit,
            data.thermal,
            data.parameters.packed,
            extended=True,
        )

    def transitions_left(self) -> IntArray:
        """
        How many more decisions each cell's data allow; after the last one its next observation still lies in the data.

        :return: shape (cells,)
        """
        return self.dataset.stop[self.trajectory] - 2 - self.sample

    def observation(self) -> NDArray[np.float32]:
        """
        s_t = [x̂_t, x_{t+1}, u_{t+1}] and, with an innovation, x_{t+1} - f(x̂_t, u_{t+1}; new cell), all scaled.

        :return: shape (cells, observation_size)
        """
        form, size = self.formulation, OBSERVED_SIZE
        out = np.empty((self.cells, self.observation_size))
        np.divide(self.model_state[:, OBSERVED], form.state_scale, out=out[:, :size])
        np.divide(self.next_state[:, OBSERVED], form.state_scale, out=out[:, size : 2 * size])
        np.divide(self.load, form.load_scale, out=out[:, 2 * size])
        if form.innovation:
            self._step(self._predicted, self.model_state, self._nominal_q_mobile, self._nominal_r_o)
            innovation = out[:, 2 * size + 1 :]
            np.subtract(self.next_state[:, OBSERVED], self._predicted[:, OBSERVED], out=innovation)
            innovation /= form.error_scale
        return np.clip(out, -OBSERVATION_LIMIT, OBSERVATION_LIMIT, dtype=np.float32, casting="same_kind")

    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """
        Take the actions, step the model, and move on to the next sample.

        :param action: in [-1, 1], mapped to the parameter's range, shape (cells,)
        :return: cost, shape (cells,)
        """
        hat = self.q_mobile_hat if self.parameter == "q_mobile" else self.r_o_hat
        hat[:] = self.parameter_of(action)
        self._step(self.model_state, self.model_state, self.q_mobile_hat, self.r_o_hat)
        cost = self.formulation.cost(self.model_state[:, OBSERVED] - self.next_state[:, OBSERVED])
        self.state, self.next_state = self.next_state, self.state
        self.sample += 1
        self._look_ahead()
        return cost

    def parameter_of(self, action: NDArray[np.floating]) -> FloatArray:
        """
        The parameter that an action stands for.

        :param action: in [-1, 1] (beyond, it is clipped), any shape
        :return: C or ohm, same shape
        """
        share = 0.5 * (np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) + 1.0)
        return self.action_low + share * (self.action_high - self.action_low)

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """
        Go on with some of the cells only.

        :param rows: which cells to keep, shape (cells,)
        """
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, np.ascontiguousarray(value[rows]))

    def report(self) -> dict[str, FloatArray]:
        """
        Where each cell stands after its last decision; for ``info``, rendering and evaluation, never for the policy.

        :return: arrays of shape (cells,): true and inferred parameters, C and ohm; voltages of cell and model, V; the state
            of charge of the cell
        """
        voltage, voltage_hat = np.empty(self.cells), np.empty(self.cells)
        voltage_into(voltage, self.state, self.q_mobile, self.dataset.parameters.packed, extended=True)
        voltage_into(voltage_hat, self.model_state, self.q_mobile_hat, self.dataset.parameters.packed, extended=True)
        return {
            "q_mobile": self.q_mobile.copy(),
            "r_o": self.r_o.copy(),
            "q_mobile_hat": self.q_mobile_hat.copy(),
            "r_o_hat": self.r_o_hat.copy(),
            "voltage": voltage,
            "voltage_hat": voltage_hat,
            "soc": state_of_charge(self.state, self.q_mobile),
        }
