"""
The calibration of a battery model as a Markov decision process, for a batch of cells at once.

The agent picks the aged parameter of the model; the model then takes one step from its own state x̂_t under the load; the
cost is its distance from the measured state x_{t+1} (Unagar et al. 2020). The scalar environment is the batch of one, and
a policy is evaluated on the batch of all test trajectories: both run this code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from battery_env.arrays import IntArray
from battery_env.calibration.data import LoadKind, Split, standard_dataset
from battery_env.calibration.full_state_kernels import decide, look_ahead, observe
from battery_env.calibration.task import OBSERVATION_LIMIT, CalibrationTask, check_counts, check_not_negative, checked_action
from battery_env.electrochemistry import (
    NEW_CELL,
    QNB,
    STATE_SIZE,
    VO,
    FloatArray,
    Trajectory,
    advance_in_place,
    initial_state,
    voltage_into,
)
from battery_env.trajectories import AgedParameter, TrajectoryDataset

#: What the action's range [-1, 1] is mapped to (the authors' code), C and ohm.
ACTION_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (4000.0, 8000.0), "r_o": (0.08, 0.22)}

#: The state of the isothermal model, without the temperature.
OBSERVED = slice(VO, STATE_SIZE)
OBSERVED_SIZE = STATE_SIZE - VO

#: Error scales of Vo, Vsn, Vsp, qnB, qnS, qpB, qpS, V and C: a step with a parameter that is off by 10 % is off by some tenths
#: in Vo, Vsn and Vsp. Charges count little on purpose: they never forget an error, so that any weight in the cost makes the
#: agent repay old errors with wrong parameters.
ERROR_SCALE: FloatArray = np.array([0.01, 1e-5, 1e-5, 20.0, 20.0, 20.0, 20.0])

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
    :param innovations: whether the observation holds asinh of x_{t+1} minus what a model with a new cell's parameters
        predicts, in error scales, once from the model's state x̂_t and once from the measured state x_t
    :param literal_cost: the authors' cost: 0.5 times the norm of the error of the voltages plus 0.5 times that of the charges,
        times 50 where it exceeds 1e-4. Otherwise it is the norm of all errors
    :param cost_limit: the largest cost of a distance. Near the end of a discharge distances span four orders of magnitude;
        costs must not, or the critic does not see the small ones
    """

    state_scale: FloatArray
    load_scale: float
    error_scale: FloatArray
    innovations: bool
    literal_cost: bool
    cost_limit: float


#: Everything divided by what it reaches in a new cell under 8 to 16 W, and measured in error scales.
SCALED = Formulation(
    state_scale=np.array([0.5, 0.1, 0.01, 6840.0, 760.0, 11400.0, 1266.0]),
    load_scale=16.0,
    error_scale=ERROR_SCALE,
    innovations=True,
    literal_cost=False,
    cost_limit=5.0,
)
#: The authors' code: divided by a new cell's charges, 1 V and 20 W.
LITERAL = Formulation(
    state_scale=np.array([1.0, 1.0, 1.0, 6840.0, 760.0, 4560.0, 506.67]),
    load_scale=20.0,
    error_scale=np.ones(OBSERVED_SIZE),
    innovations=False,
    literal_cost=True,
    cost_limit=1e4,
)


@dataclass(eq=False)
class Cells:
    """
    Where n cells stand at sample t. All arrays have one row a cell; what no option asks for has no columns.

    :param trajectory: number of the discharge
    :param sample: t
    :param last_sample: of the discharge
    :param last_decision: the last sample at which there is a decision
    :param load_start: where the loads of the discharge start
    :param decisions: made in this episode
    :param state: x_t, shape (n, 8)
    :param next_state: x_{t+1}
    :param model_state: x̂_t
    :param sensed_before: x_t as sensors with errors had it
    :param sensed: x_{t+1} as sensors with errors have it
    :param load: u_{t+1}, over the step from t to t + 1, W or A
    :param voltage: of the cell at t, V
    :param soc: state of charge of the cell at t
    :param q_mobile: of the cell, C
    :param r_o: of the cell, ohm
    :param q_mobile_hat: of the model, C
    :param r_o_hat: of the model, ohm
    :param new_q_mobile: a new cell's, C
    :param new_r_o: a new cell's, ohm
    :param last_action: shape (n, parameters)
    :param constants: of the cell, where they are not the model's, shape (n, 14)
    :param noise: standard normal draws of the episode, of the process first, shape (n, measured states, columns)
    """

    trajectory: IntArray
    sample: IntArray
    last_sample: IntArray
    last_decision: IntArray
    load_start: IntArray
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
    new_q_mobile: FloatArray
    new_r_o: FloatArray
    last_action: FloatArray
    constants: FloatArray
    noise: FloatArray

    @property
    def measured(self) -> FloatArray:
        """x_{t+1} as the sensors have it, shape (n, 8)."""
        return self.sensed if self.sensed.size else self.next_state

    @property
    def measured_before(self) -> FloatArray:
        """x_t as the sensors had it, shape (n, 8)."""
        return self.sensed_before if self.sensed_before.size else self.state

    def take(self, rows: NDArray[np.bool_]) -> Cells:
        """
        Some of the cells.

        :param rows: which, shape (n,)
        :return: copies of them
        """
        return Cells(**{name: np.ascontiguousarray(values[rows]) for name, values in vars(self).items()})

    def put(self, rows: NDArray[np.intp], others: Cells) -> None:
        """
        Overwrite some of the cells.

        :param rows: which, shape (m,)
        :param others: m cells
        """
        for values, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            values[rows] = theirs


@lru_cache(maxsize=4)
def _reachable(parameter: AgedParameter, load: LoadKind, split: Split, dt_s: float, mismatch: float) -> TrajectoryDataset:
    # the discharges of the standard data set whose parameters actions can stand for
    dataset = standard_dataset(parameter, load, split, dt_s, mismatch)
    values = {"q_mobile": dataset.q_mobile, "r_o": dataset.r_o}
    within = np.all([(low <= values[name]) & (values[name] <= high) for name, (low, high) in ACTION_RANGES.items()], axis=0)
    return dataset if within.all() else dataset.subset(np.flatnonzero(within))


class FullStateTask(CalibrationTask):
    """
    The paper's task for ``cells`` cells side by side: the state of the cell is measured; one parameter is to be found and the
    other one is known, or both are to be found. What differs between the registered ones is data of their classes; their
    options are described on the page of :class:`BatteryQmax`.

    The truth is simulated beside the model, from the data set's parameters and loads. The model is continued where a wrong
    parameter leaves its domain (:func:`battery_env.electrochemistry.step_into`, ``extended``).

    :ivar formulation: how states become observations and costs
    :ivar now: where the cells stand
    :param cells: size of the batch
    :raises ValueError: for values out of range
    """

    formulation: Formulation = SCALED
    episode_steps = 64
    dataset: TrajectoryDataset

    def __init__(
        self,
        cells: int,
        *,
        episode_steps: int | None = None,
        start: Literal["true", "new_cell"] = "true",
        initial_perturbation: float = 0.0,
        resync: int | None = None,
        process_noise_V: float = 0.0,
        sensor_noise: float = 0.0,
        sensor_offset: float = 0.0,
        sensor_gain: float = 1.0,
        consistency: float = 0.0,
        cost_limit: float | None = None,
        load: LoadKind = "paper",
        split: Split = "train",
        dt_s: float = 1.0,
        mismatch: float = 0.0,
        dataset: TrajectoryDataset | None = None,
    ) -> None:
        if start not in ("true", "new_cell"):
            raise ValueError(f"start must be 'true' or 'new_cell', got {start!r}")
        if resync is not None and resync < 1:
            raise ValueError(f"resync must be None or at least 1, got {resync!r}")
        check_not_negative(
            initial_perturbation=initial_perturbation,
            process_noise_V=process_noise_V,
            sensor_noise=sensor_noise,
            consistency=consistency,
        )
        if not np.isfinite(sensor_offset):
            raise ValueError(f"sensor_offset must be finite, got {sensor_offset!r}")
        form = self.formulation
        limit = form.cost_limit if cost_limit is None else cost_limit
        for name, value in (("sensor_gain", sensor_gain), ("cost_limit", limit)):
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be finite and greater than 0, got {value!r}")
        self.cells = cells
        if episode_steps is not None:
            self.episode_steps = episode_steps
        check_counts(episode_steps=self.episode_steps)
        data: dict[str, Any] = {"load": load, "split": split, "dt_s": dt_s, "mismatch": mismatch}
        if dataset is None:
            self.dataset = dataset = _reachable("joint" if len(self.parameters) == 2 else self.parameters[0], **data)
        else:
            self._refuse_beside_a_dataset(**data)
            self.dataset = dataset
        self.decision_s = dataset.dt_s
        self.starts_new = start == "new_cell"
        self.initial_perturbation = initial_perturbation
        self.resync = resync
        self.process_noise_V = process_noise_V
        self.sensor_noise, self.sensor_offset, self.sensor_gain = sensor_noise, sensor_offset, sensor_gain
        shows_action = consistency > 0.0
        shown = (4 if form.innovations else 2) * OBSERVED_SIZE + 1
        self.observation_size = shown + (len(self.parameters) if shows_action else 0)
        self._action_range = np.array([ACTION_RANGES[name] for name in self.parameters]).T.copy()
        self._first_action = self.action_of({"q_mobile": NEW_CELL.q_mobile, "r_o": NEW_CELL.r_o})
        # one decision needs the two samples that follow
        self._starts = list(zip(dataset.first.tolist(), (dataset.stop - 2).tolist(), strict=True))

        self._has_sensor_errors = (sensor_noise, sensor_offset, sensor_gain) != (0.0, 0.0, 1.0)
        self._is_disturbed = self._has_sensor_errors or process_noise_V > 0.0
        # one row of draws for each measured state, of which the first is x_t at the start
        columns = OBSERVED_SIZE * (sensor_noise > 0.0) + 3 * (process_noise_V > 0.0)
        self._draws = (self.episode_steps + 2 if self._is_disturbed else 0, columns)
        self._has_own_constants = bool((dataset.factors != 1.0).any())
        self._model_packed = dataset.cell.packed
        # what the kernels read, in their order. They take arrays one by one: numba spends 13 us a step on NamedTuples of them,
        # half of what a whole step of one cell takes
        self._of_step = (dataset.dt_s, dataset.load_unit == "power", dataset.thermal)
        self._of_decision = (
            self._action_range[0],
            self._action_range[1],
            "q_mobile" in self.parameters,
            "r_o" in self.parameters,
            *self._of_step,
            form.literal_cost,
            float(limit),
            float(consistency),
            1.0 / form.error_scale,
        )
        scales = (1.0 / form.state_scale, 1.0 / form.load_scale, 1.0 / form.error_scale)
        self._of_observation = (*scales, form.innovations, shows_action, OBSERVATION_LIMIT, *self._of_step)
        nowhere = np.zeros(cells, dtype=np.int64)
        self.now = self._begin(nowhere, nowhere + dataset.first[0], np.zeros((cells, 4)), np.zeros((cells, *self._draws)))

    def start(
        self,
        rows: NDArray[np.intp],
        generators: Sequence[np.random.Generator],
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """
        Start some cells at random points of random trajectories.

        :param rows: which cells of the batch, shape (m,)
        :param generators: one source of randomness for each of them, of length m
        :param options: ``trajectory`` and ``sample`` (counted from the start of the discharge) choose the point instead
        :raises ValueError: for an unknown option, or a point outside the data
        """
        chosen = options or {}
        unknown = set(chosen) - {"trajectory", "sample"}
        if unknown:
            raise ValueError(f"options of reset are 'trajectory' and 'sample', got {sorted(unknown)}")
        bound = self.initial_perturbation
        trajectories = len(self.dataset)
        trajectory, sample = np.empty((2, len(rows)), dtype=np.int64)
        perturbation, noise = np.zeros((len(rows), 4)), np.empty((len(rows), *self._draws))
        for k, generator in enumerate(generators):
            n = int(generator.integers(trajectories))
            if "trajectory" in chosen:
                n = int(chosen["trajectory"])
                if not 0 <= n < trajectories:
                    raise ValueError(f"options['trajectory'] must lie within 0 .. {trajectories - 1}, got {n}")
            first, stop = self._starts[n]
            t = int(generator.integers(first, stop))
            if "sample" in chosen:
                t = int(chosen["sample"])
                if not first <= t < stop:
                    raise ValueError(f"options['sample'] must lie within {first} .. {stop - 1} for trajectory {n}, got {t}")
            trajectory[k], sample[k] = n, t
            if bound > 0.0:
                perturbation[k] = generator.uniform(-bound, bound, size=4)
            if noise.size > 0:
                generator.standard_normal(out=noise[k])
        self.now.put(rows, self._begin(trajectory, sample, perturbation, noise))

    def _begin(self, trajectory: IntArray, sample: IntArray, perturbation: FloatArray, noise: FloatArray) -> Cells:
        """Cells at some samples of some discharges."""
        dataset, n = self.dataset, len(sample)
        load_start, q_mobile, r_o = dataset.load_start[trajectory], dataset.q_mobile[trajectory], dataset.r_o[trajectory]
        new_q_mobile, new_r_o = np.full(n, NEW_CELL.q_mobile), np.full(n, NEW_CELL.r_o)
        # before the first action the model is the new cell's; the parameter that is known stays the true one
        q_mobile_hat = (new_q_mobile if "q_mobile" in self.parameters else q_mobile).copy()
        r_o_hat = (new_r_o if "r_o" in self.parameters else r_o).copy()
        state = dataset.states_at(trajectory, sample)
        if self.starts_new:
            model_state = initial_state(q_mobile_hat, dataset.cell)
            of_step = (dataset.dt_s, dataset.load_unit, dataset.thermal, self._model_packed)
            advance_in_place(
                model_state, dataset.load_values, load_start, sample, q_mobile_hat, r_o_hat, *of_step, extended=True
            )
        else:
            model_state = state.copy()
        if self.initial_perturbation > 0.0:
            model_state[:, OBSERVED] += perturbation[:, [0, 1, 2, 3, 3, 3, 3]] * _PERTURBATION * ERROR_SCALE
        sensed_before = self._as_sensed(state, noise[:, 0]) if self._has_sensor_errors else np.empty((n, 0))
        load, voltage, soc = np.empty((3, n))
        cells = Cells(
            trajectory=trajectory,
            sample=sample,
            last_sample=dataset.samples[trajectory] - 1,
            last_decision=dataset.stop[trajectory] - 2,
            load_start=load_start,
            decisions=np.zeros(n, dtype=np.int64),
            state=state,
            next_state=np.empty_like(state),
            model_state=model_state,
            sensed_before=sensed_before,
            sensed=np.empty_like(sensed_before),
            load=load,
            voltage=voltage,
            soc=soc,
            q_mobile=q_mobile,
            r_o=r_o,
            q_mobile_hat=q_mobile_hat,
            r_o_hat=r_o_hat,
            new_q_mobile=new_q_mobile,
            new_r_o=new_r_o,
            last_action=np.repeat(self._first_action[None], n, axis=0),
            constants=dataset.packed(trajectory).constants if self._has_own_constants else np.empty((n, 0)),
            noise=noise,
        )
        self._look_ahead(cells)
        if self._is_disturbed:
            self._disturb(cells)
        return cells

    def _look_ahead(self, cells: Cells) -> None:
        """The load of the step from t to t + 1, and where it takes the cells."""
        packed = self._model_packed
        look_ahead(
            cells.sample,
            cells.last_sample,
            cells.load_start,
            self.dataset.load_values,
            *self._of_step,
            cells.state,
            cells.q_mobile,
            cells.r_o,
            cells.constants if self._has_own_constants else packed.constants,
            packed.polynomial_n,
            packed.polynomial_p,
            cells.load,
            cells.next_state,
            cells.voltage,
            cells.soc,
        )

    def _disturb(self, cells: Cells) -> None:
        """The noise of the process on x_{t+1}, then the errors of the sensors."""
        draw = 1 + np.minimum(cells.decisions, self.episode_steps)
        noise = cells.noise[np.arange(len(draw)), draw]
        if self.process_noise_V > 0.0:
            cells.next_state[:, VO:QNB] += self.process_noise_V * np.sqrt(self.dataset.dt_s) * noise[:, :3]
        if self._has_sensor_errors:
            cells.sensed[:] = self._as_sensed(cells.next_state, noise)

    def _as_sensed(self, state: FloatArray, noise: FloatArray) -> FloatArray:
        error = np.full((len(state), OBSERVED_SIZE), self.sensor_offset)
        if self.sensor_noise > 0.0:
            error += self.sensor_noise * noise[:, -OBSERVED_SIZE:]
        sensed = state.copy()
        sensed[:, OBSERVED] = self.sensor_gain * state[:, OBSERVED] + error * ERROR_SCALE
        return sensed

    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """
        Take the actions, step the model, and move on to the next sample.

        :param action: in [-1, 1] (beyond, it is clipped), mapped to the parameters' ranges, shape (cells, len(parameters))
        :return: cost, shape (cells,)
        :raises ValueError: for another shape, NaN, or what is no number
        """
        now = self.now
        chosen = checked_action(action, now.last_action.shape)
        cost = np.empty(self.cells)
        measured = now.measured
        decide(
            chosen,
            *self._of_decision,
            measured,
            now.load,
            *self._model_packed,
            now.last_action,
            now.model_state,
            now.q_mobile_hat,
            now.r_o_hat,
            now.decisions,
            now.sample,
            cost,
        )
        if self.resync is not None:
            due = now.decisions % self.resync == 0
            now.model_state[due] = measured[due]
        now.state, now.next_state = now.next_state, now.state
        now.sensed_before, now.sensed = now.sensed, now.sensed_before
        self._look_ahead(now)
        if self._is_disturbed:
            self._disturb(now)
        return cost

    @classmethod
    def follow(cls, records: Sequence[Trajectory], every: int, **options: Any) -> FullStateTask:
        """
        Go through whole discharges, each with a cell of its own, with the model's state running free from the first sample.

        :param records: simulated discharges; no recording has the full state
        :param every: 1
        :param options: of the task, but for those of its data
        :return: the task, at its first observations
        """
        dataset = records if isinstance(records, TrajectoryDataset) else TrajectoryDataset.from_trajectories(records)
        samples = dataset.stop - dataset.first
        task = cls(len(dataset), **{**options, "dataset": dataset, "episode_steps": int(samples.max())})
        # the longest first, so that those that go on are always the first rows
        for row, n in enumerate(np.argsort(-samples, kind="stable")):
            point = {"trajectory": n, "sample": dataset.first[n]}
            task.start(np.array([row]), [np.random.default_rng(n)], point)
        return task

    def steps_between(self, decision_s: float) -> int:
        """
        How many samples arrive between two decisions on a whole record: the policy decides at each of them.

        :param decision_s: ignored
        :return: 1
        """
        return 1

    def seen(self) -> tuple[IntArray, FloatArray]:
        """
        Which data the next decision knows, x_{t+1} among them.

        :return: each cell's discharge, and the time of its last sample on the clock of the data set, s, shape (cells,)
        """
        return self.now.trajectory.copy(), np.asarray((self.now.sample + 1) * self.dataset.dt_s, dtype=np.float64)

    @property
    def estimate(self) -> FloatArray:
        """(q_mobile, r_o) of the model, C and ohm, shape (cells, 2)."""
        return np.stack([self.now.q_mobile_hat, self.now.r_o_hat], axis=1)

    @staticmethod
    def conclude(estimates: FloatArray) -> float:
        """
        What is left of the estimates over a record: their mean, for each is made of its own sample.

        :param estimates: of one parameter, shape (K,)
        :return: one estimate
        """
        return float(estimates.mean())

    def drop_ended(self) -> None:
        """Go on without the cells whose episodes are over."""
        over = self.truncated()
        if over.any():
            self.keep(~over)

    def truncated(self) -> NDArray[np.bool_]:
        """
        Whose episode is over, as its steps or its data have come to an end.

        :return: shape (cells,)
        """
        now = self.now
        return (now.decisions >= self.episode_steps) | (now.sample >= now.last_decision)

    def observation(self) -> NDArray[np.float32]:
        """
        s_t = [x̂_t, x_{t+1}, u_{t+1}] and, with innovations, asinh of x_{t+1} - f(x̂_t, u_{t+1}; new cell) and of
        x_{t+1} - f(x_t, u_{t+1}; new cell), all scaled; with a price on changes of the action, the action before.

        :return: shape (cells, observation_size)
        """
        out = np.empty((self.cells, self.observation_size), dtype=np.float32)
        now = self.now
        observe(
            now.model_state,
            now.measured_before,
            now.measured,
            now.load,
            now.last_action,
            *self._of_observation,
            now.new_q_mobile,
            now.new_r_o,
            *self._model_packed,
            out,
        )
        return out

    def parameters_of(self, action: NDArray[np.floating]) -> FloatArray:
        """
        The parameters that actions stand for.

        :param action: in [-1, 1], shape (..., len(parameters))
        :return: C and ohm, same shape
        """
        share = 0.5 * (np.asarray(action, dtype=np.float64) + 1.0)
        lowest, highest = self._action_range
        return lowest + share * (highest - lowest)

    def action_of(self, values: Mapping[str, ArrayLike]) -> FloatArray:
        """
        The actions that stand for parameters.

        :param values: at least those to be found, by name, C and ohm, shape (...)
        :return: shape (..., len(parameters)), beyond [-1, 1] for parameters out of the actions' range
        """
        wanted = np.stack([np.asarray(values[name], dtype=np.float64) for name in self.parameters], axis=-1)
        lowest, highest = self._action_range
        return 2.0 * (wanted - lowest) / (highest - lowest) - 1.0

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """
        Go on with some of the cells only.

        :param rows: which cells to keep, shape (cells,)
        """
        self.now = self.now.take(rows)
        self.cells = len(self.now.sample)

    def report(self) -> dict[str, FloatArray]:
        """
        Where each cell stands after its last decision; for ``info``, rendering and evaluation, never for the policy.

        :return: arrays of shape (cells,): true and inferred parameters, C and ohm; voltages of cell and model, V; the state
            of charge of the cell
        """
        now, voltage_hat = self.now, np.empty(self.cells)
        voltage_into(voltage_hat, now.model_state, now.q_mobile_hat, self._model_packed, extended=True)
        return {
            "q_mobile": now.q_mobile.copy(),
            "r_o": now.r_o.copy(),
            "q_mobile_hat": now.q_mobile_hat.copy(),
            "r_o_hat": now.r_o_hat.copy(),
            "voltage": now.voltage.copy(),
            "voltage_hat": voltage_hat,
            "soc": now.soc.copy(),
        }


class BatteryQmax(FullStateTask):
    """
    ## Description

    A Li-ion cell of unknown age is discharged at a constant power of 8 to 16 W, and its whole state is measured once a
    second. Find q^max (``q_mobile``), the charge that can move, by making NASA's electrochemistry model follow the measured
    state. Source: Unagar et al. 2020; no label is used, and the reward does not know the true parameter.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``. States are Vo, Vsn, Vsp (divided by 0.5, 0.1, 0.01 V), qnB, qnS, qpB, qpS (divided by
    6840, 760, 11400, 1266 C).

    | index | content |
    |-------|---------|
    | 0-6   | x̂_t, the model's state |
    | 7-13  | x_{t+1}, the measured state one step ahead |
    | 14    | u_{t+1}, the power over that step, divided by 16 W |
    | 15-21 | asinh of the innovation x_{t+1} minus what the model with a new cell's parameters predicts from x̂_t, in error scales |
    | 22-28 | asinh of the innovation x_{t+1} minus what the model with a new cell's parameters predicts from x_t, the state measured before, in error scales |

    Error scales: Vo 0.01 V, Vsn and Vsp 1e-5 V, charges 20 C. The two innovations make the measurements readable: a parameter
    that is off by 1 % moves the next state by 1e-4 of its value. The second one shows what the parameter did in this second.
    The first one shows besides how far the model has drifted, which is most of the cost. A model that was wrong for a minute
    is off by hundreds of error scales; asinh keeps what a network sees within about 7, and leaves small innovations as they are.

    The observation is Markov for a constant load: cost and next model state depend on it and the action alone, the next
    measured state on the parameter too, which the observation determines. It stays so with ``start``,
    ``initial_perturbation``, ``process_noise_V``, ``sensor_offset``, ``sensor_gain``, ``consistency`` (which appends what is
    needed) and ``resync`` = 1. It is not Markov, though the cost of a decision still depends on observation and action alone,
    with a load that changes (when, is hidden), ``resync`` > 1 (so is the step in the cycle), ``sensor_noise`` (so is the true
    state) or ``mismatch`` (so are constants of the cell).

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to q_mobile = 4000 .. 8000 C. R_o is known.

    ## Reward

    Minus the cost, the Euclidean norm of x̂_{t+1} - x_{t+1} in error scales, at most 5.

    ## Starting state

    A random second of a random discharge of the training part (70 %) of the paper's data: eleven loads times 501 values
    of q_mobile in 4000 .. 7000 C, without the first and last 5 % of each discharge. The model starts in the true state.
    ``reset(options=...)`` takes ``trajectory`` and ``sample`` (counted from the start of the discharge) in place of random ones.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    | argument | default | meaning |
    |----------|---------|---------|
    | ``episode_steps`` | 64 | decisions per episode |
    | ``start`` | ``"true"`` | the model's first state: the cell's; or ``"new_cell"``: that of a cell that was full when the discharge began, is new in what is to be found, and has carried the same load since. No action makes up for the charge that it has too much |
    | ``initial_perturbation`` | 0 | the first state is off by a uniform draw within this many error scales to either side, in Vo, Vsn, Vsp and in charge that has moved between the electrodes |
    | ``resync`` | none | the model is set to the measured state after every so many decisions |
    | ``process_noise_V`` | 0 | standard deviation of white noise on Vo, Vsn and Vsp of the cell, V per root of a second |
    | ``sensor_noise`` | 0 | standard deviation of white noise on measured states, in error scales. Observation, cost and ``resync`` all use the measured state |
    | ``sensor_offset`` | 0 | constant error of measured states, in error scales |
    | ``sensor_gain`` | 1 | measured states are the true ones times this |
    | ``consistency`` | 0 | cost of a change of the action per unit of its Euclidean length (the paper's consistency penalty); above 0 the action before is appended to the observation, at first the one that stands for a new cell |
    | ``cost_limit`` | 5 | largest cost, without that of a change |
    | ``load`` | ``"paper"`` | or ``"constant"``, ``"piecewise"``, ``"random_walk"``, ``"recorded"``: see ``battery_env.calibration.data.standard_dataset``; cells whose parameters no action stands for are left out |
    | ``split`` | ``"train"`` | or ``"test"``, ``"all"`` |
    | ``dt_s`` | 1 | time step, s |
    | ``mismatch`` | 0 | how far kn, tDiffusion, to and tsn of the cell are from the model's (relative standard deviation) |
    | ``dataset`` | none | a ``TrajectoryDataset`` to draw from, in place of the last four |
    | ``render_mode`` | none | ``"rgb_array"`` |

    ``gymnasium.make_vec`` takes ``num_envs`` and ``autoreset_mode`` besides.

    ## Info

    ``cost``; ``q_mobile``, ``r_o`` (true), ``q_mobile_hat``, ``r_o_hat`` (the model's), C and ohm; ``voltage`` and
    ``voltage_hat`` of cell and model, V; ``soc``, the state of charge of the cell.

    ## Version history

    * v0: initial version; since 0.2.0 with the second innovation; since 0.3.0 with asinh of both
    """  # noqa: E501 (rows of a table)

    parameters = ("q_mobile",)


class BatteryRo(FullStateTask):
    """
    ## Description

    As ``BatteryQmax-v0``, but R_o (``r_o``), the ohmic resistance, is to be found, and q_mobile is known.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``, laid out and scaled as in ``BatteryQmax-v0``.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to r_o = 0.08 .. 0.22 ohm.

    ## Reward

    That of ``BatteryQmax-v0``.

    ## Starting state

    As ``BatteryQmax-v0``, with 501 values of r_o in 0.1 .. 0.2 ohm.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("r_o",)


class BatteryQmaxPaper(FullStateTask):
    """
    ## Description

    The q^max task in the literal form of the paper and its code, for comparison with ``BatteryQmax-v0``.

    ## Observation space

    ``Box(-100, 100, (15,), float32)``: x̂_t, x_{t+1} and u_{t+1}, divided by the new cell's charges (6840, 760, 4560, 506.67 C
    for qnB, qnS, qpB, qpS), 1 V and 20 W.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to q_mobile = 4000 .. 8000 C. R_o is known.

    ## Reward

    Minus the cost: 0.5 times the norm of the error of the voltages in V plus 0.5 times that of the charges in C, times 50
    where that exceeds 1e-4; at most 10000.

    ## Starting state

    As ``BatteryQmax-v0``.

    ## Episode end

    Truncated after 16 steps, or where the data end. Never terminated (the authors' code treats the end as terminal; here a
    time limit is one).

    ## Arguments

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16 and ``cost_limit`` 10000; error scales are the same.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile",)
    formulation = LITERAL
    episode_steps = 16


class BatteryRoPaper(FullStateTask):
    """
    ## Description

    The R_o task in the literal form of the paper and its code, for comparison with ``BatteryRo-v0``.

    ## Observation space

    ``Box(-100, 100, (15,), float32)``, laid out and scaled as in ``BatteryQmaxPaper-v0``.

    ## Action space

    ``Box(-1, 1, (1,), float32)``, mapped linearly to r_o = 0.08 .. 0.22 ohm. q_mobile is known.

    ## Reward

    That of ``BatteryQmaxPaper-v0``.

    ## Starting state

    As ``BatteryRo-v0``.

    ## Episode end

    Truncated after 16 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``, with ``episode_steps`` 16 and ``cost_limit`` 10000; error scales are the same.

    ## Version history

    * v0: initial version
    """

    parameters = ("r_o",)
    formulation = LITERAL
    episode_steps = 16


class BatteryJoint(FullStateTask):
    """
    ## Description

    As ``BatteryQmax-v0``, but q^max and R_o (``r_o``), the ohmic resistance, have both aged and are to be found together.

    ## Observation space

    ``Box(-100, 100, (29,), float32)``, laid out and scaled as in ``BatteryQmax-v0``, and Markov under the same conditions. An
    R_o that is off shows in Vo alone (0.8 error scales for 10 %), a q_mobile in all three voltages (0.1, 0.1 and 0.2).

    ## Action space

    ``Box(-1, 1, (2,), float32)``, mapped linearly to q_mobile = 4000 .. 8000 C and r_o = 0.08 .. 0.22 ohm.

    ## Reward

    That of ``BatteryQmax-v0``.

    ## Starting state

    A random second of a random discharge of the training part (700 of 1000 discharges), with q_mobile in 4000 .. 7000 C and
    r_o in 0.1 .. 0.2 ohm drawn independently, eleven loads of 8 to 16 W, without the first and last 5 % of each discharge. The
    model starts in the true state.

    ## Episode end

    Truncated after 64 steps, or where the data end. Never terminated.

    ## Arguments

    Those of ``BatteryQmax-v0``.

    ## Version history

    * v0: initial version
    """

    parameters = ("q_mobile", "r_o")
