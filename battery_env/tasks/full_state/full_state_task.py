"""Calibration from the full state of a cell as a Markov decision process (Unagar et al. 2020), for a batch of cells."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import check_not_negative, check_whole_number
from battery_env.electrochemistry import NEW_CELL, Trajectory
from battery_env.electrochemistry.kernels import voltage_batch
from battery_env.parameters import PARAMETER_NAMES
from battery_env.tasks.base import OBSERVATION_LIMIT, CalibrationTask, Generators, Rows
from battery_env.tasks.data import Split, open_dataset, standard_dataset
from battery_env.tasks.full_state.decisions import decide, look_ahead, observe
from battery_env.tasks.full_state.layout import (
    CELL,
    COST_STATES,
    ERROR_SCALE,
    LITERAL,
    OBSERVED,
    OBSERVED_SIZE,
    SCALED,
    SETTINGS,
    Formulation,
    Records,
)
from battery_env.trajectories import TrajectoryDataset

# A wrong model has moved too much or too little charge from one electrode to the other. In both electrodes nine tenths of this
# error are in the bulk.
_PERTURBATION_SHAPE = np.array([1.0, 1.0, 1.0, -0.9, -0.1, 0.9, 0.1])


class FullStateTask(CalibrationTask):
    """
    The paper's task for ``cells`` cells side by side. The state of the cell is measured. The agent estimates one parameter, or
    both; the model takes the estimate, and one step under the load from its own state x̂_t. The cost is the error of a voltage
    of the model's state, or of the whole state, at the measured x_{t+1}. The registered tasks differ in attributes of their
    classes. The page of ``BatteryQmax-v0`` describes the options.

    The task simulates the cell with the parameters and loads of the data set. Where a wrong parameter leaves the domain of the
    model, the task extends the model (:func:`battery_env.electrochemistry.kernels.step_batch`, ``extended``).

    :ivar formulation: scales of observations, and the cost
    :ivar cell_records: the cells at their samples, records of :data:`~battery_env.tasks.full_state.layout.CELL`

    :param cells: size of the batch
    :raises ValueError: for values out of range
    """

    is_averaged = True  # each estimate depends on a single sample
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
        initial_perturbation: float = 0.0,
        split: Split = "train",
        dataset: TrajectoryDataset | str | os.PathLike[str] | None = None,
    ) -> None:
        check_not_negative(
            continue_probability=continue_probability,
            first_sample_probability=first_sample_probability,
            initial_perturbation=initial_perturbation,
        )
        if continue_probability >= 1.0:
            raise ValueError(f"continue_probability must be less than 1, or episodes never end, got {continue_probability!r}")
        if first_sample_probability > 1.0:
            raise ValueError(f"first_sample_probability must be at most 1, got {first_sample_probability!r}")
        self.cells = cells
        if episode_steps is not None:
            self.episode_steps = check_whole_number("episode_steps", episode_steps, 1)
        if dataset is None:
            self.dataset = standard_dataset(self.parameters, "paper", split)
        else:
            self._refuse_with_dataset(split=split)
            self.dataset = open_dataset(dataset)
        self.decision_s = self.dataset.dt_s
        self.continue_probability, self.first_sample_probability = continue_probability, first_sample_probability
        self.initial_perturbation = initial_perturbation
        self.observation_size = (4 if self.formulation.innovations else 2) * OBSERVED_SIZE + 1
        self._settings = self._kernel_settings()
        self._sample_ranges = list(zip(self.dataset.first.tolist(), (self.dataset.stop - 2).tolist(), strict=True))
        if (self.dataset.factors != 1.0).any() or self.dataset.equilibrium_V.any():
            raise ValueError("dataset has cells with constants of their own: take a voltage-only task for them")
        zeros = np.zeros(cells, dtype=np.int64)
        first = zeros + self.dataset.first[0]
        self.cell_records = self._records_at(zeros, first, zeros + self.episode_steps, np.zeros((cells, 4)))

    def _kernel_settings(self) -> Records:
        formulation, dataset = self.formulation, self.dataset
        settings = np.zeros(1, dtype=SETTINGS)
        for name, value in {
            "dt_s": dataset.dt_s,
            "power": dataset.load_unit == "power",
            "thermal": dataset.thermal,
            **dataset.cell.packed._asdict(),
            "new_parameters": (NEW_CELL.q_mobile, NEW_CELL.r_o),
            "is_sought": [name in self.parameters for name in PARAMETER_NAMES],
            "lowest": [formulation.action_ranges[name][0] for name in PARAMETER_NAMES],
            "highest": [formulation.action_ranges[name][1] for name in PARAMETER_NAMES],
            "literal_cost": formulation.literal_cost,
            "cost_limit": formulation.cost_limit,
            "cost_states": [COST_STATES[name] for name in PARAMETER_NAMES],
            "per_state": 1.0 / formulation.state_scale,
            "per_load": 1.0 / formulation.load_scale,
            "per_error": 1.0 / ERROR_SCALE,
            "innovations": formulation.innovations,
        }.items():
            settings[name] = value
        return settings

    def start(self, rows: Rows, generators: Generators, options: Mapping[str, Any] | None = None) -> None:
        """
        Start some cells at random points of random trajectories; as of the base class.

        :param options: ``trajectory`` and ``sample`` (counted from the start of the discharge) choose the point instead
        """
        choices = options or {}
        unknown = set(choices) - {"trajectory", "sample"}
        if unknown:
            raise ValueError(f"options of reset are 'trajectory' and 'sample', got {sorted(unknown)}")
        bound = self.initial_perturbation
        trajectories = len(self.dataset)
        trajectory, sample, steps = np.empty((3, len(rows)), dtype=np.int64)
        perturbation = np.zeros((len(rows), 4))
        for k, generator in enumerate(generators):
            n = int(generator.integers(trajectories))
            if "trajectory" in choices:
                n = int(choices["trajectory"])
                if not 0 <= n < trajectories:
                    raise ValueError(f"options['trajectory'] must lie within 0 .. {trajectories - 1}, got {n}")
            # a decision needs the next two samples
            first, stop = self._sample_ranges[n]
            t = int(generator.integers(first, stop))
            if self.first_sample_probability > 0.0 and generator.random() < self.first_sample_probability:
                t = 0  # of the whole discharge, which may be before the first sample of a trimmed data set
            if "sample" in choices:
                t = int(choices["sample"])
                if not first <= t < stop:
                    raise ValueError(f"options['sample'] must lie within {first} .. {stop - 1} for trajectory {n}, got {t}")
            trajectory[k], sample[k], steps[k] = n, t, self.episode_steps
            if self.continue_probability > 0.0:
                steps[k] *= generator.geometric(1.0 - self.continue_probability)
            if bound > 0.0:
                perturbation[k] = generator.uniform(-bound, bound, size=4)
        self.cell_records[rows] = self._records_at(trajectory, sample, steps, perturbation)

    def _records_at(self, trajectory: IntArray, sample: IntArray, steps: IntArray, perturbation: FloatArray) -> Records:
        """Return cells at samples of discharges."""
        dataset = self.dataset
        cells = np.zeros(len(sample), dtype=CELL)
        cells["trajectory"], cells["sample"], cells["steps"] = trajectory, sample, steps
        cells["last_sample"] = dataset.samples[trajectory] - 1
        cells["last_decision"] = dataset.stop[trajectory] - 2
        cells["load_start"] = dataset.load_start[trajectory]
        cells["q_mobile"], cells["r_o"] = dataset.q_mobile[trajectory], dataset.r_o[trajectory]
        # before the first action the model has the new cell's value of each parameter to estimate, and the true other value
        for name in PARAMETER_NAMES:
            cells[f"{name}_hat"] = getattr(NEW_CELL, name) if name in self.parameters else cells[name]
        cells["state"] = dataset.states_at(trajectory, sample)
        cells["model_state"] = cells["state"]
        if self.initial_perturbation > 0.0:
            cells["model_state"][:, OBSERVED] += perturbation[:, [0, 1, 2, 3, 3, 3, 3]] * _PERTURBATION_SHAPE * ERROR_SCALE
        self._look_ahead(cells)
        return cells

    def _look_ahead(self, cells: Records) -> None:
        """Fill in the load of the step from t to t + 1, and the next state of the cells."""
        look_ahead(self._settings, self.dataset.load_values, self.dataset.cell.packed.constants, cells)

    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """Take the actions, step the model, and move on to the next sample."""
        actions, cost = self._checked_action(action), np.empty(self.cells)
        decide(actions, self._settings, self.cell_records, cost)
        self._look_ahead(self.cell_records)
        return cost

    @classmethod
    def of_records(cls, records: Sequence[Trajectory], decision_s: float, **options: Any) -> FullStateTask:
        """
        Make a task of whole discharges, one a cell; the model's state runs free from the first sample.

        :param records: simulated discharges; no recording has the full state
        :param decision_s: without meaning: the policy decides at each sample
        """
        dataset = records if isinstance(records, TrajectoryDataset) else TrajectoryDataset.from_trajectories(records)
        samples = dataset.stop - dataset.first
        task = cls(len(dataset), **{**options, "dataset": dataset, "episode_steps": int(samples.max())})
        # the longest discharges first, so that the running cells are always the first rows
        for row, n in enumerate(np.argsort(-samples, kind="stable")):
            choices = {"trajectory": n, "sample": dataset.first[n]}
            task.start(np.array([row]), [np.random.default_rng(n)], choices)
        return task

    def available_data(self) -> tuple[IntArray, FloatArray, IntArray]:
        """Return the data of the next decision, up to x_{t+1}; times on the clock of the data set."""
        last = self.cell_records["sample"] + 1
        return self.cell_records["trajectory"].copy(), np.asarray(last * self.dataset.dt_s, dtype=np.float64), last + 1

    @property
    def estimate(self) -> FloatArray:
        """(q_mobile, r_o) of the model, C and ohm, shape (cells, 2)."""
        return np.stack([self.cell_records["q_mobile_hat"], self.cell_records["r_o_hat"]], axis=1)

    def drop_truncated(self) -> None:
        """Drop the cells whose episodes are over."""
        is_truncated = self.truncated()
        if is_truncated.any():
            self.cell_records = self.cell_records[~is_truncated]
            self.cells = len(self.cell_records)

    def truncated(self) -> NDArray[np.bool_]:
        """Return whether the steps or the data of a cell have ended."""
        cells = self.cell_records
        return np.asarray((cells["decisions"] >= cells["steps"]) | (cells["sample"] >= cells["last_decision"]))

    def observation(self) -> NDArray[np.float32]:
        """
        Return s_t = [x̂_t, x_{t+1}, u_{t+1}] and, with innovations, asinh of x_{t+1} - f(x̂_t, u_{t+1}; new cell) and of
        x_{t+1} - f(x_t, u_{t+1}; new cell), all scaled.
        """
        out = np.empty((self.cells, self.observation_size), dtype=np.float32)
        observe(self._settings, self.cell_records, OBSERVATION_LIMIT, out)
        return out

    def report(self) -> dict[str, FloatArray]:
        """Return the state of each cell after its last decision."""
        cells, voltage_hat = self.cell_records, np.empty(self.cells)
        voltage_batch(cells["model_state"], cells["q_mobile_hat"], True, self.dataset.cell.packed, voltage_hat)
        return {name: voltage_hat if name == "voltage_hat" else cells[name].copy() for name in self.REPORT_NAMES}


class BatteryQmax(FullStateTask):
    """Estimate ``q_mobile``: ``BatteryQmax-v0``."""

    parameters = ("q_mobile",)


class BatteryRo(FullStateTask):
    """Estimate ``r_o``: ``BatteryRo-v0``."""

    parameters = ("r_o",)


class BatteryJoint(FullStateTask):
    """Estimate both: ``BatteryJoint-v0``."""

    parameters = ("q_mobile", "r_o")


class BatteryQmaxPaper(BatteryQmax):
    """Estimate ``q_mobile`` in the paper's literal form: ``BatteryQmaxPaper-v0``."""

    formulation = LITERAL
    episode_steps = 16


class BatteryRoPaper(BatteryRo):
    """Estimate ``r_o`` in the paper's literal form: ``BatteryRoPaper-v0``."""

    formulation = LITERAL
    episode_steps = 16
