"""
Calibration from the full state of a cell as a Markov decision process, for a batch of cells at once.

The agent picks the aged parameter of the model. The model then takes one step from its own state x̂_t under the load. The cost
is its distance from the measured state x_{t+1} (Unagar et al. 2020).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from battery_env.arrays import IntArray
from battery_env.calibration.batch import Cells
from battery_env.calibration.data import LoadKind, Split, opened, standard_dataset
from battery_env.calibration.formulation import ACTION_RANGES, ERROR_SCALE, OBSERVED, OBSERVED_SIZE, SCALED, Formulation
from battery_env.calibration.full_state_kernels import decide, look_ahead, observe
from battery_env.calibration.task import OBSERVATION_LIMIT, CalibrationTask, check_counts, check_not_negative, checked_action
from battery_env.electrochemistry import (
    NEW_CELL,
    QNB,
    VO,
    FloatArray,
    Trajectory,
    advance_in_place,
    initial_state,
    voltage_into,
)
from battery_env.trajectories import TrajectoryDataset

# A model that was wrong for a while has moved too much or too little charge from one electrode to the other. In both
# electrodes nine tenths of that charge are in the bulk.
_PERTURBATION = np.array([1.0, 1.0, 1.0, -0.9, -0.1, 0.9, 0.1])


@lru_cache(maxsize=4)
def _reachable(parameters: Sequence[str], load: LoadKind, split: Split, dt_s: float, mismatch: float) -> TrajectoryDataset:
    # the discharges of the standard data set whose parameters actions can stand for
    dataset = standard_dataset(parameters, load, split, dt_s, mismatch)
    values = {"q_mobile": dataset.q_mobile, "r_o": dataset.r_o}
    within = np.all([(low <= values[name]) & (values[name] <= high) for name, (low, high) in ACTION_RANGES.items()], axis=0)
    return dataset if within.all() else dataset.subset(np.flatnonzero(within))


class FullStateTask(CalibrationTask):
    """
    The paper's task for ``cells`` cells side by side. The state of the cell is measured. One parameter is to be found and the
    other one is known, or both are to be found. The registered tasks differ in attributes of their classes. The page of
    :class:`~battery_env.calibration.full_state_tasks.BatteryQmax` describes the options.

    The cell is simulated beside the model, from the parameters and loads of the data set. The model is extended where a wrong
    parameter leaves its domain (:func:`battery_env.electrochemistry.step_into`, ``extended``).

    :ivar formulation: how states become observations and costs
    :ivar now: the cells at their samples
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
        continue_probability: float = 0.0,
        first_sample_probability: float = 0.0,
        start: Literal["true", "new_cell"] = "true",
        initial_perturbation: float = 0.0,
        resync: int | None = None,
        process_noise_V: float = 0.0,
        sensor_noise: float = 0.0,
        sensor_offset: float = 0.0,
        sensor_gain: float = 1.0,
        consistency: float = 0.0,
        charge_weight: float = 1.0,
        cost_limit: float | None = None,
        load: LoadKind = "paper",
        split: Split = "train",
        dt_s: float = 1.0,
        mismatch: float = 0.0,
        dataset: TrajectoryDataset | str | os.PathLike[str] | None = None,
    ) -> None:
        if start not in ("true", "new_cell"):
            raise ValueError(f"start must be 'true' or 'new_cell', got {start!r}")
        if resync is not None and resync < 1:
            raise ValueError(f"resync must be None or at least 1, got {resync!r}")
        check_not_negative(
            continue_probability=continue_probability,
            first_sample_probability=first_sample_probability,
            initial_perturbation=initial_perturbation,
            process_noise_V=process_noise_V,
            sensor_noise=sensor_noise,
            consistency=consistency,
            charge_weight=charge_weight,
        )
        if continue_probability >= 1.0:
            raise ValueError(f"continue_probability must be less than 1, or episodes never end, got {continue_probability!r}")
        if first_sample_probability > 1.0:
            raise ValueError(f"first_sample_probability must be at most 1, got {first_sample_probability!r}")
        if continue_probability > 0.0 and (sensor_noise > 0.0 or process_noise_V > 0.0):
            raise ValueError(
                "continue_probability does not go with sensor_noise or process_noise_V, which are drawn for episode_steps: "
                "set it to 0, and episode_steps to the length that episodes shall have"
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
            self.dataset = dataset = _reachable(self.parameters, **data)
        else:
            self._refuse_beside_a_dataset(**data)
            self.dataset = dataset = opened(dataset)
        self.decision_s = dataset.dt_s
        self.starts_new = start == "new_cell"
        self.continue_probability, self.first_sample_probability = continue_probability, first_sample_probability
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
        self._new_parameters = np.full(cells, NEW_CELL.q_mobile), np.full(cells, NEW_CELL.r_o)
        per_error = 1.0 / form.error_scale
        per_error[QNB - VO :] *= charge_weight
        # Arguments of the kernels, in their order. Kernels take arrays one by one: numba spends 13 us a step on NamedTuples of
        # them, half of what a whole step of one cell takes.
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
            per_error,
        )
        scales = (1.0 / form.state_scale, 1.0 / form.load_scale, 1.0 / form.error_scale)
        self._of_observation = (*scales, form.innovations, shows_action, OBSERVATION_LIMIT, *self._of_step)
        nowhere = np.zeros(cells, dtype=np.int64)
        perturbation, noise = np.zeros((cells, 4)), np.zeros((cells, *self._draws))
        self.now = self._begin(nowhere, nowhere + dataset.first[0], nowhere + self.episode_steps, perturbation, noise)

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
        trajectory, sample, steps = np.empty((3, len(rows)), dtype=np.int64)
        perturbation, noise = np.zeros((len(rows), 4)), np.empty((len(rows), *self._draws))
        for k, generator in enumerate(generators):
            n = int(generator.integers(trajectories))
            if "trajectory" in chosen:
                n = int(chosen["trajectory"])
                if not 0 <= n < trajectories:
                    raise ValueError(f"options['trajectory'] must lie within 0 .. {trajectories - 1}, got {n}")
            first, stop = self._starts[n]
            t = int(generator.integers(first, stop))
            if self.first_sample_probability > 0.0 and generator.random() < self.first_sample_probability:
                t = 0  # of the whole discharge, before what the data leave out
            if "sample" in chosen:
                t = int(chosen["sample"])
                if not first <= t < stop:
                    raise ValueError(f"options['sample'] must lie within {first} .. {stop - 1} for trajectory {n}, got {t}")
            trajectory[k], sample[k], steps[k] = n, t, self.episode_steps
            if self.continue_probability > 0.0:
                steps[k] *= generator.geometric(1.0 - self.continue_probability)
            if bound > 0.0:
                perturbation[k] = generator.uniform(-bound, bound, size=4)
            if noise.size > 0:
                generator.standard_normal(out=noise[k])
        self.now.put(rows, self._begin(trajectory, sample, steps, perturbation, noise))

    def _begin(
        self, trajectory: IntArray, sample: IntArray, steps: IntArray, perturbation: FloatArray, noise: FloatArray
    ) -> Cells:
        """Cells at samples of discharges."""
        dataset, n = self.dataset, len(sample)
        load_start, q_mobile, r_o = dataset.load_start[trajectory], dataset.q_mobile[trajectory], dataset.r_o[trajectory]
        # before the first action the model is a new cell in what is to be found; what is known is the true value
        q_mobile_hat = np.full(n, NEW_CELL.q_mobile) if "q_mobile" in self.parameters else q_mobile.copy()
        r_o_hat = np.full(n, NEW_CELL.r_o) if "r_o" in self.parameters else r_o.copy()
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
            steps=steps,
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
        The estimate for a whole record: the mean, for each estimate is made of its own sample.

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
        return (now.decisions >= now.steps) | (now.sample >= now.last_decision)

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
            *self._new_parameters,
            *self._model_packed,
            out,
        )
        return out

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
        new_q_mobile, new_r_o = self._new_parameters
        self._new_parameters = new_q_mobile[: self.cells], new_r_o[: self.cells]

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
