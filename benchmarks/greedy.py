"""The parameter that explains each single step best, where the full state is measured: what the one-step cost can teach."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.compiled import compiled
from battery_env.electrochemistry import NEW_CELL, STATE_SIZE, VO, CellParameters, PackedConstants, Trajectory, check_dt
from battery_env.electrochemistry.kernels import cell_current, cell_step, cell_voltage
from battery_env.estimates import Estimate, EstimateTrace
from battery_env.estimators.estimator import Estimator
from battery_env.parameters import PARAMETERS

#: Where to search, C and ohm: what aged cells may have, with a margin.
SEARCH_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (3500.0, 8100.0), "r_o": (0.05, 0.4)}

# The range is cut into this many intervals, and those that hold a minimum of the cost once more: in q_mobile it has up to
# three, two of which can be near each other.
_INTERVALS = 48
_GOLDEN = 0.5 * (sqrt(5.0) - 1.0)
# How far golden sections narrow a bracket, as a share of the range: to rounding
_TOLERANCE = 1e-14


class _Search(NamedTuple):
    """A discharge, and a model whose parameter is searched for step by step."""

    search_q: bool
    q: float
    r_o: float
    dt: float
    power: bool
    thermal: bool
    packed: PackedConstants
    load: FloatArray  # over each step
    measured: FloatArray  # states of the cell, shape (T, 8)
    model: FloatArray  # state of the model before a step, and after it, which is overwritten, shape (2, 8)


@compiled
def _cost(value: float, k: int, search: _Search) -> float:
    # distance of the end of step k to the measured state; negative if its vo is too low
    model, measured, packed = search.model, search.measured, search.packed
    q, r_o = (value, search.r_o) if search.search_q else (search.q, value)
    volts = cell_voltage(model, 0, q, True, packed) if search.power else 0.0
    i = cell_current(search.load[k], search.power, volts, True)
    cell_step(model, 0, 1, i, q, r_o, search.dt, search.thermal, True, packed.constants)
    square = 0.0
    for n in range(VO, STATE_SIZE):
        square += (model[1, n] - measured[k + 1, n]) ** 2
    return sqrt(square) if model[1, VO] >= measured[k + 1, VO] else -sqrt(square)


@compiled
def _brackets(low: float, high: float, k: int, search: _Search, found: FloatArray) -> int:
    # Intervals of a grid that hold a minimum; returns how many they are. A change of the sign is one, which the magnitudes
    # alone do not show where two minima lie near each other; where there is none, the magnitudes of neighbours tell.
    width = (high - low) / _INTERVALS
    costs = np.array([_cost(low + n * width, k, search) for n in range(_INTERVALS + 1)])
    count = 0
    for n in range(_INTERVALS + 1):
        left, right = max(n - 1, 0), min(n + 1, _INTERVALS)
        if n < _INTERVALS and (costs[n] < 0.0) != (costs[right] < 0.0):
            found[count] = low + n * width, low + right * width
            count += 1
        elif abs(costs[left]) >= abs(costs[n]) <= abs(costs[right]) and (costs[left] < 0.0) == (costs[n] < 0.0):
            found[count] = low + left * width, low + right * width
            count += 1
    return count


@compiled
def _golden_section(low: float, high: float, tolerance: float, k: int, search: _Search) -> float:
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    cost_left, cost_right = abs(_cost(left, k, search)), abs(_cost(right, k, search))
    while high - low > tolerance and left < right:
        if cost_left < cost_right:
            high, right, cost_right = right, left, cost_left
            left = high - _GOLDEN * (high - low)
            cost_left = abs(_cost(left, k, search))
        else:
            low, left, cost_left = left, right, cost_right
            right = low + _GOLDEN * (high - low)
            cost_right = abs(_cost(right, k, search))
    return left if cost_left < cost_right else right


@compiled
def _greedy(low: float, high: float, resync: bool, search: _Search, best: FloatArray) -> None:
    # Fills best, the value of each step
    coarse, fine = np.empty((2, _INTERVALS + 1, 2))
    tolerance = _TOLERANCE * (high - low)
    for k in range(best.shape[0]):
        if resync:
            search.model[0] = search.measured[k]
        least = np.inf
        for a in range(_brackets(low, high, k, search, coarse)):
            for b in range(_brackets(coarse[a, 0], coarse[a, 1], k, search, fine)):
                value = _golden_section(fine[b, 0], fine[b, 1], tolerance, k, search)
                cost = abs(_cost(value, k, search))
                if cost < least:
                    least, best[k] = cost, value
        _cost(best[k], k, search)
        search.model[0] = search.model[1]


class GreedyOneStep(Estimator):
    """
    At each step the value of one parameter for which the model's next state is closest to the measured one. The other
    parameter is known. It is the minimum of the paper's cost ``|x̂_{t+1} - x_{t+1}|`` (SI units), which a policy that looks no
    further ahead can learn at best.

    In ``q_mobile`` this cost has up to three minima in mid discharge, as the voltage and with it the current for a given
    power is no monotonic function of it. All of them are searched, and the deepest one is taken.

    *Resynchronized* (the default) each step starts from the measured state: the minimum is the true value, to rounding, but
    for the few steps where two minima nearly meet. *Free-running* the model's own state goes on: what was wrong at one step
    stays in its charges and moves the minima of the next ones. 0.05 C too much in the negative surface is 13 % of ``q_mobile``
    at once, and up to 0.7 % in the minutes after. ``r_o`` forgets such errors within seconds.

    The load has to be a power for ``q_mobile``: at a given current it moves the next state by 1e-5 V or less.

    :param parameter: what to search for: ``"q_mobile"`` or ``"r_o"``
    :param search_range: where, C or ohm; ``None``: that of ``SEARCH_RANGES``
    :param resync: whether each step starts from the measured state, instead of from the model's own
    :param cell: constants of the model
    :param thermal: whether the temperature of the model moves
    :raises ValueError: for an unknown parameter, or a range that is none
    """

    def __init__(
        self,
        parameter: str,
        search_range: tuple[float, float] | None = None,
        resync: bool = True,
        cell: CellParameters = NEW_CELL,
        thermal: bool = False,
    ) -> None:
        if parameter not in SEARCH_RANGES:
            raise ValueError(f"parameter must be one of {tuple(SEARCH_RANGES)}, got {parameter!r}")
        self.parameter = parameter
        self.search_range = PARAMETERS[parameter].check_bounds("search_range", search_range or SEARCH_RANGES[parameter])
        self.resync = resync
        self.cell = cell
        self.thermal = thermal

    def estimate(self, record: Trajectory) -> Estimate:  # type: ignore[override]
        """
        The estimate of the last step of a simulated discharge (no recording has the full state); the other parameter is the
        true one.
        """
        trace = self.trace([record])[0]
        return Estimate(q_mobile=float(trace.q_mobile[-1]), r_o=float(trace.r_o[-1]))

    def trace(self, records: Sequence[Trajectory]) -> list[EstimateTrace]:  # type: ignore[override]
        """One estimate for every step of simulated discharges of at least two samples; the other parameter is the true one."""
        traces = []
        for record in records:
            steps = len(record.time_s) - 1
            values = {"q_mobile": np.full(steps, record.q_mobile), "r_o": np.full(steps, record.r_o)}
            values[self.parameter] = np.full(steps, np.nan)
            search = _Search(
                self.parameter == "q_mobile",
                record.q_mobile,
                record.r_o,
                check_dt(record.dt_s, self.cell),
                record.load_unit == "power",
                self.thermal,
                self.cell.packed,
                record.load,
                record.state,
                np.repeat(record.state[:1], 2, axis=0),
            )
            _greedy(*self.search_range, self.resync, search, values[self.parameter])
            traces.append(EstimateTrace(record.time_s[1:], values["q_mobile"], values["r_o"]))
        return traces
