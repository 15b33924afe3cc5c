"""
The layout of the full-state tasks: ranges of actions, scales of observations, costs, and the records of the kernels.

The kernels take records (structured arrays): numba passes one record with all its fields faster than one more array.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.electrochemistry import STATE_SIZE, VO, VSP
from battery_env.electrochemistry.cell import CONSTANTS_SIZE, POLYNOMIAL_SIZE

Records = NDArray[np.void]

#: The state of the isothermal model, without the temperature.
OBSERVED = slice(VO, STATE_SIZE)
OBSERVED_SIZE = STATE_SIZE - VO

#: Error scales of Vo, Vsn, Vsp, qnB, qnS, qpB, qpS, V and C. An error of 10 % in a parameter changes Vo, Vsn and Vsp by some
#: tenths of their scales in one step.
ERROR_SCALE: FloatArray = np.array([0.01, 1e-5, 1e-5, 20.0, 20.0, 20.0, 20.0])
#: The voltage in the cost of each parameter: a wrong parameter moves this voltage in one step, and the error decays in a
#: minute (time constants of 46 and 6 s). Errors of Vsn last a quarter of an hour, and errors of charges last for ever: in a
#: cost these old errors would hide the effect of the last decision.
COST_STATES: Mapping[str, int] = {"q_mobile": VSP, "r_o": VO}


@dataclass(frozen=True, eq=False)
class Formulation:
    """
    Scales of observations, and the cost. The arrays have the order of the state without temperature: Vo, Vsn, Vsp, qnB, qnS,
    qpB, qpS, in V and C.

    :param action_ranges: the parameters at actions of -1 and 1, C and ohm. They reach beyond the parameters of all cells,
        because the agent corrects errors of the charges by errors of the other sign. In the authors' range no estimate is
        below the truth of the oldest cells, so that their models drift off
    :param state_scale: divisor of observed states, shape (7,)
    :param load_scale: divisor of observed loads, W
    :param innovations: whether the observation holds both innovations, asinh of x_{t+1} minus the prediction of a model with
        a new cell's parameters, in error scales: one from the model's state x̂_t, one from the measured state x_t
    :param literal_cost: whether the cost is the authors': 0.5 times the norm of the errors of the voltages plus 0.5 times the
        norm of the errors of the charges, times 50 where this exceeds 1e-4. Otherwise the cost is the sum of the errors of the
        voltages of the parameters to estimate (:data:`COST_STATES`)
    :param cost_limit: largest cost of a parameter. Errors span four orders of magnitude near the end of a discharge, so that a
        critic would not resolve small costs
    """

    action_ranges: Mapping[str, tuple[float, float]]
    state_scale: FloatArray
    load_scale: float
    innovations: bool
    literal_cost: bool
    cost_limit: float


#: Scales are the largest states and loads of a new cell under 8 to 16 W.
SCALED = Formulation(
    action_ranges={"q_mobile": (3500.0, 8100.0), "r_o": (0.08, 0.22)},
    state_scale=np.array([0.5, 0.1, 0.01, 6840.0, 760.0, 11400.0, 1266.0]),
    load_scale=16.0,
    innovations=True,
    literal_cost=False,
    cost_limit=5.0,
)
#: The authors' code: scales are a new cell's charges, 1 V and 20 W.
LITERAL = Formulation(
    action_ranges={"q_mobile": (4000.0, 8000.0), "r_o": (0.08, 0.22)},
    state_scale=np.array([1.0, 1.0, 1.0, 6840.0, 760.0, 4560.0, 506.67]),
    load_scale=20.0,
    innovations=False,
    literal_cost=True,
    cost_limit=1e4,
)

#: Settings of a task for the kernels, one record. Pairs have the order (q_mobile, r_o).
SETTINGS = np.dtype(
    [
        ("dt_s", float),
        ("power", bool),  # whether the load is power, not current
        ("thermal", bool),
        ("constants", float, (1, CONSTANTS_SIZE)),  # of the model
        ("polynomial_n", float, (POLYNOMIAL_SIZE,)),
        ("polynomial_p", float, (POLYNOMIAL_SIZE,)),
        ("new_parameters", float, (2,)),
        ("is_sought", np.int64, (2,)),  # 1 for a parameter to estimate
        ("lowest", float, (2,)),  # at an action of -1
        ("highest", float, (2,)),  # at an action of 1
        ("literal_cost", bool),
        ("cost_limit", float),
        ("cost_states", np.int64, (2,)),  # index of a voltage
        ("per_state", float, (OBSERVED_SIZE,)),
        ("per_load", float),
        ("per_error", float, (OBSERVED_SIZE,)),
        ("innovations", bool),
    ],
    align=True,
)
#: A cell at its sample t, one record; a batch is an array of them.
CELL = np.dtype(
    [
        ("trajectory", np.int64),  # number of the discharge
        ("sample", np.int64),  # t
        ("last_sample", np.int64),  # of the discharge
        ("last_decision", np.int64),  # last sample at which there is a decision
        ("load_start", np.int64),  # index of the first load of the discharge
        ("steps", np.int64),  # decisions of this episode, fewer if the data end earlier
        ("decisions", np.int64),  # number of decisions so far
        ("state", float, (STATE_SIZE,)),  # x_t
        ("next_state", float, (STATE_SIZE,)),  # x_{t+1}
        ("model_state", float, (STATE_SIZE,)),  # of the model at t
        ("load", float),  # u_{t+1}, over the step from t to t + 1, W or A
        ("voltage", float),  # of the cell at t, V
        ("soc", float),  # state of charge of the cell at t
        ("q_mobile", float),  # of the cell, C
        ("r_o", float),  # of the cell, ohm
        ("q_mobile_hat", float),  # of the model, C
        ("r_o_hat", float),  # of the model, ohm
    ]
)
