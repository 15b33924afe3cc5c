"""
The compiled kernels (numba) of the full-state task: decision, look-ahead and observation of many cells.

``settings`` is one record of :data:`~battery_env.tasks.full_state.layout.SETTINGS`, ``cells`` an array of records of
:data:`~battery_env.tasks.full_state.layout.CELL`, whose fields the kernels overwrite.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled, inlined
from battery_env.electrochemistry.cell import QNB, QNS, STATE_SIZE, VO, PackedConstants
from battery_env.electrochemistry.kernels import (
    BLOCK,
    BLOCK_SIZE,
    VOLTAGE,
    asinh_ratio,
    fill_block,
    states_of_block,
    step_batch,
    step_of_block,
)
from battery_env.tasks.full_state.layout import Records


@inlined
def _clipped(value: float, limit: float) -> float:
    # NaN stays NaN
    return -limit if value < -limit else (limit if value > limit else value)


@inlined
def _literal_distance(model_state: FloatArray, measured: FloatArray, n: int) -> float:
    voltages, charges = 0.0, 0.0
    for k in range(VO, QNB):
        voltages += (model_state[n, k] - measured[n, k]) ** 2
    for k in range(QNB, STATE_SIZE):
        charges += (model_state[n, k] - measured[n, k]) ** 2
    distance = 0.5 * sqrt(voltages) + 0.5 * sqrt(charges)
    return 50.0 * distance if distance > 1e-4 else distance


@inlined
def _cost_of_state(model_state: FloatArray, measured: FloatArray, n: int, task: Any) -> float:
    if task.literal_cost:
        return _clipped(_literal_distance(model_state, measured, n), task.cost_limit)
    cost = 0.0
    for k in range(2):
        if task.is_sought[k] > 0:
            voltage = task.cost_states[k]
            error = model_state[n, voltage] - measured[n, voltage]
            cost += _clipped(abs(error) * task.per_error[voltage - VO], task.cost_limit)
    return cost


@inlined
def _apply_action(action: FloatArray, task: Any, cells: Records, n: int) -> None:
    # Set the model's parameters
    cell, column = cells[n], 0
    for k in range(2):
        if task.is_sought[k] > 0:
            clipped_action = _clipped(action[n, column], 1.0)
            value = task.lowest[k] + 0.5 * (clipped_action + 1.0) * (task.highest[k] - task.lowest[k])
            if k == 0:
                cell.q_mobile_hat = value
            else:
                cell.r_o_hat = value
            column += 1


@compiled
def decide(action: FloatArray, settings: Records, cells: Records, cost: FloatArray) -> None:
    # Set the model's parameters, step it, compare it with the measured state, and move on to the next sample
    task = settings[0]
    state, next_state, model_state = cells["state"], cells["next_state"], cells["model_state"]
    for n in range(len(cells)):
        cells[n].decisions += 1
        cells[n].sample += 1
        _apply_action(action, task, cells, n)
    load, q, r_o = cells["load"], cells["q_mobile_hat"], cells["r_o_hat"]
    packed = PackedConstants(task.constants, task.polynomial_n, task.polynomial_p)
    step_batch(model_state, load, q, r_o, task.dt_s, task.power, task.thermal, True, packed, model_state)
    for n in range(len(cells)):
        cost[n] = _cost_of_state(model_state, next_state, n, task)
        for k in range(STATE_SIZE):
            state[n, k] = next_state[n, k]


@compiled
def look_ahead(settings: Records, load_values: FloatArray, constants: FloatArray, cells: Records) -> None:
    # The load and the cell's next state. At the end of its data a cell stays on its last sample
    task, block = settings[0], np.empty(BLOCK_SIZE)
    for n in range(len(cells)):
        cells[n].load = load_values[cells[n].load_start + min(cells[n].sample, cells[n].last_sample)]
    for first in range(0, len(cells), BLOCK):
        size = min(BLOCK, len(cells) - first)
        fill_block(block, first, size, cells["state"], cells["load"], cells["q_mobile"], cells["r_o"], constants)
        step_of_block(block, size, task.dt_s, task.power, True, task.thermal, True, task.polynomial_n, task.polynomial_p)
        for j in range(size):
            cell = cells[first + j]
            cell.voltage = block[VOLTAGE + j]
            cell.soc = (cell.state[QNB] + cell.state[QNS]) / cell.q_mobile
        states_of_block(block, first, size, cells["next_state"])


@compiled
def observe(settings: Records, cells: Records, limit: float, out: NDArray[np.float32]) -> None:
    # Write the observations into out
    task = settings[0]
    per_state, per_error, model_state, next_state = task.per_state, task.per_error, cells["model_state"], cells["next_state"]
    for n in range(len(cells)):
        cell = cells[n]
        for k in range(7):
            out[n, k] = _clipped(model_state[n, k + 1] * per_state[k], limit)
            out[n, k + 7] = _clipped(next_state[n, k + 1] * per_state[k], limit)
        out[n, 14] = _clipped(cell.load * task.per_load, limit)
    if not task.innovations:
        return
    q, r_o = np.full(len(cells), task.new_parameters[0]), np.full(len(cells), task.new_parameters[1])
    packed = PackedConstants(task.constants, task.polynomial_n, task.polynomial_p)
    predicted = np.empty((len(cells), STATE_SIZE))
    innovations = predicted.ravel()
    for column, origin in ((15, model_state), (22, cells["state"])):
        step_batch(origin, cells["load"], q, r_o, task.dt_s, task.power, task.thermal, True, packed, predicted)
        for n in range(len(cells)):
            for k in range(7):
                predicted[n, k + 1] = (next_state[n, k + 1] - predicted[n, k + 1]) * per_error[k]
        # asinh: innovations span five orders of magnitude, and large ones would hide small ones in a network. A separate loop,
        # so that the compiler uses vector instructions
        for j in range(len(innovations)):
            innovations[j] = asinh_ratio(innovations[j], 1.0)
        for n in range(len(cells)):
            for k in range(7):
                out[n, k + column] = predicted[n, k + 1]
