"""The compiled kernels (numba) of the full-state task: a decision, a look ahead, and what the agent sees, for many cells."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

from battery_env.arrays import FloatArray
from battery_env.electrochemistry.kernels import (
    BLOCK,
    BLOCK_SIZE,
    VOLTAGE,
    asinh_ratio,
    fill_block,
    states_of_block,
    step_of_block,
)

_compiled = njit(cache=True, error_model="numpy")
_inlined = njit(cache=True, error_model="numpy", forceinline=True)


@_inlined
def _clipped(value: float, limit: float) -> float:
    # NaN stays NaN
    return -limit if value < -limit else (limit if value > limit else value)


@_inlined
def state_distance(model_state: FloatArray, measured: FloatArray, n: int, per_error: FloatArray, literal_cost: bool) -> float:
    voltages, charges = 0.0, 0.0
    for k in range(3):
        error = (model_state[n, k + 1] - measured[n, k + 1]) * per_error[k]
        voltages += error * error
    for k in range(3, 7):
        error = (model_state[n, k + 1] - measured[n, k + 1]) * per_error[k]
        charges += error * error
    if not literal_cost:
        return sqrt(voltages + charges)
    distance = 0.5 * sqrt(voltages) + 0.5 * sqrt(charges)
    return 50.0 * distance if distance > 1e-4 else distance


@_compiled
def decide(
    action: FloatArray,
    lowest: FloatArray,
    highest: FloatArray,
    finds_q: bool,
    finds_r: bool,
    dt: float,
    power: bool,
    thermal: bool,
    literal_cost: bool,
    cost_limit: float,
    consistency: float,
    per_error: FloatArray,
    measured: FloatArray,
    load: FloatArray,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    last_action: FloatArray,
    model_state: FloatArray,
    q_hat: FloatArray,
    r_hat: FloatArray,
    decisions: NDArray[np.int64],
    sample: NDArray[np.int64],
    cost: FloatArray,
) -> None:
    # Set the model's parameters, step it, and compare it with the measured state; overwrites what comes after the polynomials
    block = np.empty(BLOCK_SIZE)
    cells = len(cost)
    for n in range(cells):
        decisions[n] += 1
        sample[n] += 1
        squared_change = 0.0
        for k in range(action.shape[1]):
            chosen = _clipped(action[n, k], 1.0)
            squared_change += (chosen - last_action[n, k]) ** 2
            last_action[n, k] = chosen
        cost[n] = consistency * sqrt(squared_change)
        if finds_q:
            q_hat[n] = lowest[0] + 0.5 * (last_action[n, 0] + 1.0) * (highest[0] - lowest[0])
        if finds_r:
            k = action.shape[1] - 1
            r_hat[n] = lowest[k] + 0.5 * (last_action[n, k] + 1.0) * (highest[k] - lowest[k])
    for first in range(0, cells, BLOCK):
        size = min(BLOCK, cells - first)
        fill_block(block, first, size, model_state, load, q_hat, r_hat, constants)
        step_of_block(block, size, dt, power, power, thermal, True, poly_n, poly_p)
        states_of_block(block, first, size, model_state)
        for n in range(first, first + size):
            distance = state_distance(model_state, measured, n, per_error, literal_cost)
            cost[n] += cost_limit if distance > cost_limit else distance


@_compiled
def look_ahead(
    sample: NDArray[np.int64],
    last_sample: NDArray[np.int64],
    load_start: NDArray[np.int64],
    load_values: FloatArray,
    dt: float,
    power: bool,
    thermal: bool,
    state: FloatArray,
    q: FloatArray,
    r_o: FloatArray,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    load: FloatArray,
    next_state: FloatArray,
    voltage: FloatArray,
    soc: FloatArray,
) -> None:
    # The load and the cell's next state; overwrites what comes after the polynomials. At the end of its data a cell stays on
    # its last sample, and is not asked for more
    block = np.empty(BLOCK_SIZE)
    cells = len(load)
    for n in range(cells):
        load[n] = load_values[load_start[n] + min(sample[n], last_sample[n])]
    for first in range(0, cells, BLOCK):
        size = min(BLOCK, cells - first)
        fill_block(block, first, size, state, load, q, r_o, constants)
        step_of_block(block, size, dt, power, True, thermal, True, poly_n, poly_p)
        for j in range(size):
            n = first + j
            voltage[n] = block[VOLTAGE + j]
            soc[n] = (state[n, 4] + state[n, 5]) / q[n]
        states_of_block(block, first, size, next_state)


@_compiled
def observe(
    model_state: FloatArray,
    measured_before: FloatArray,
    measured: FloatArray,
    load: FloatArray,
    last_action: FloatArray,
    per_state: FloatArray,
    per_load: float,
    per_error: FloatArray,
    innovations: bool,
    shows_action: bool,
    limit: float,
    dt: float,
    power: bool,
    thermal: bool,
    nominal_q: FloatArray,
    nominal_r_o: FloatArray,
    constants: FloatArray,
    poly_n: FloatArray,
    poly_p: FloatArray,
    out: NDArray[np.float32],
) -> None:
    # The observations, into out
    block = np.empty(BLOCK_SIZE)
    cells = len(load)
    for n in range(cells):
        for k in range(7):
            out[n, k] = _clipped(model_state[n, k + 1] * per_state[k], limit)
            out[n, k + 7] = _clipped(measured[n, k + 1] * per_state[k], limit)
        out[n, 14] = _clipped(load[n] * per_load, limit)
        if shows_action:
            for k in range(last_action.shape[1]):
                out[n, out.shape[1] - last_action.shape[1] + k] = last_action[n, k]
    if not innovations:
        return
    for column, origin in ((15, model_state), (22, measured_before)):
        for first in range(0, cells, BLOCK):
            size = min(BLOCK, cells - first)
            fill_block(block, first, size, origin, load, nominal_q, nominal_r_o, constants)
            step_of_block(block, size, dt, power, power, thermal, True, poly_n, poly_p)
            for j in range(size):
                for k in range(1, 8):
                    block[k * BLOCK + j] = (measured[first + j, k] - block[k * BLOCK + j]) * per_error[k - 1]
            # asinh: they span five orders of magnitude, and must not drown the small ones in a network. A loop of its own, so
            # that the compiler uses vector instructions
            for k in range(1, 8):
                for j in range(size):
                    block[k * BLOCK + j] = asinh_ratio(block[k * BLOCK + j], 1.0)
            for j in range(size):
                for k in range(7):
                    out[first + j, k + column] = block[(k + 1) * BLOCK + j]
