"""
Calibration from the full state of a cell as a Markov decision process (Unagar et al. 2020), for a batch of cells at once.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import IntArray
from battery_env.checks import check_not_negative
from battery_env.electrochemistry import NEW_CELL, FloatArray, Trajectory
from battery_env.electrochemistry.kernels import voltage_batch
from battery_env.parameters import PARAMETER_NAMES
from battery_env.tasks.base import OBSERVATION_LIMIT, CalibrationTask, Generators, Rows, check_counts, checked_action
from battery_env.tasks.data import Split, opened, standard_dataset
from battery_env.tasks.full_state.decisions import decide, look_ahead, observe
from battery_env.tasks.full_state.layout import (
    CELL,
    ERROR_SCALE,
    JUDGED_BY,
    LITERAL,
    OBSERVED,
    OBSERVED_SIZE,
    SCALED,
    SETTINGS,
    Formulation,
    Records,
)
from battery_env.trajectories import TrajectoryDataset

# A model that was wrong for a while has moved too much or too little charge from one electrode to the other. In both
# electrodes nine tenths of that charge are in the bulk.
_PERTURBATION = np.array([1.0, 1.0, 1.0, -0.9, -0.1, 0.9, 0.1])


class FullStateTask(CalibrationTask):
    """
    The paper's task for ``cells`` cells side by side. The state of the cell is measured. One parameter is to be found and the
    other one is known, or both are to be found. The agent picks them for the model, which then takes one step from its own
    state x̂_t under the load. The cost is how far a voltage of its state, or all of it, is from the measured x_{t+1}. The
    registered tasks differ in attributes of their classes. The page of ``BatteryQmax-v0`` describes the options.

    The cell is simulated beside the model, from the parameters and loads of the data set. The model is extended where a wrong
    parameter leaves its domain (:func:`battery_env.electrochemistry.kernels.step_batch`, ``extended``).

    :ivar formulation: how states become observations and costs
    :ivar now: the cells at their samples, records of :data:`~battery_env.tasks.full_state.layout.CELL`
    :param cells: size of the batch
    :raises ValueError: for values out of range
    """

    is_averaged = True  # each estimate is made of its own sample
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
        self.episode_steps = self.episode_steps if episode_steps is None else episode_steps
        check_counts(episode_steps=self.episode_steps)
        if dataset is None:
            self.dataset = standard_dataset(self.parameters, "paper", split)
        else:
            self._refuse_beside_a_dataset(split=split)
            self.dataset = opened(dataset)
        self.decision_s = self.dataset.dt_s
        self.continue_probability, self.first_sample_probability = continue_probability, first_sample_probability
        self.initial_perturbation = initial_perturbation
        self.observation_size = (4 if self.formulation.innovations else 2) * OBSERVED_SIZE + 1
        self._settings = self._kernel_settings()
        self._starts = list(zip(self.dataset.first.tolist(), (self.dataset.stop - 2).tolist(), strict=True))
        if (self.dataset.factors != 1.0).any() or self.dataset.equilibrium_V.any():
            raise ValueError("dataset has cells with constants of their own: take a voltage-only task for them")
        nowhere = np.zeros(cells, dtype=np.int64)
        first = nowhere + self.dataset.first[0]
        self.now = self._begin(nowhere, first, nowhere + self.episode_steps, np.zeros((cells, 4)))

    def _kernel_settings(self) -> Records:
        form, dataset = self.formulation, self.dataset
        settings = np.zeros(1, dtype=SETTINGS)
        for name, value in {
            "dt_s": dataset.dt_s,
            "power": dataset.load_unit == "power",
            "thermal": dataset.thermal,
            **dataset.cell.packed._asdict(),
            "new_parameters": (NEW_CELL.q_mobile, NEW_CELL.r_o),
            "finds": [name in self.parameters for name in PARAMETER_NAMES],
            "lowest": [form.action_ranges[name][0] for name in PARAMETER_NAMES],
            "highest": [form.action_ranges[name][1] for name in PARAMETER_NAMES],
            "literal_cost": form.literal_cost,
            "cost_limit": form.cost_limit,
            "judged_by": [JUDGED_BY[name] for name in PARAMETER_NAMES],
            "per_state": 1.0 / form.state_scale,
            "per_load": 1.0 / form.load_scale,
            "per_error": 1.0 / ERROR_SCALE,
            "innovations": form.innovations,
        }.items():
            settings[name] = value
        return settings

    def start(self, rows: Rows, generators: Generators, options: Mapping[str, Any] | None = None) -> None:
        """
        Start some cells at random points of random trajectories; as of the base class.

        :param options: ``trajectory`` and ``sample`` (counted from the start of the discharge) choose the point instead
        """
        chosen = options or {}
        unknown = set(chosen) - {"trajectory", "sample"}
        if unknown:
            raise ValueError(f"options of reset are 'trajectory' and 'sample', got {sorted(unknown)}")
        bound = self.initial_perturbation
        trajectories = len(self.dataset)
        trajectory, sample, steps = np.empty((3, len(rows)), dtype=np.int64)
        perturbation = np.zeros((len(rows), 4))
        for k, generator in enumerate(generators):
            n = int(generator.integers(trajectories))
            if "trajectory" in chosen:
                n = int(chosen["trajectory"])
                if not 0 <= n < trajectories:
                    raise ValueError(f"options['trajectory'] must lie within 0 .. {trajectories - 1}, got {n}")
            # one decision needs the two samples that follow
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
        self.now[rows] = self._begin(trajectory, sample, steps, perturbation)

    def _begin(self, trajectory: IntArray, sample: IntArray, steps: IntArray, perturbation: FloatArray) -> Records:
        """Cells at samples of discharges."""
        dataset = self.dataset
        cells = np.zeros(len(sample), dtype=CELL)
        cells["trajectory"], cells["sample"], cells["steps"] = trajectory, sample, steps
        cells["last_sample"] = dataset.samples[trajectory] - 1
        cells["last_decision"] = dataset.stop[trajectory] - 2
        cells["load_start"] = dataset.load_start[trajectory]
        cells["q_mobile"], cells["r_o"] = dataset.q_mobile[trajectory], dataset.r_o[trajectory]
        # before the first action the model is a new cell in what is to be found; what is known is the true value
        for name in PARAMETER_NAMES:
            cells[f"{name}_hat"] = getattr(NEW_CELL, name) if name in self.parameters else cells[name]
        cells["state"] = dataset.states_at(trajectory, sample)
        cells["model_state"] = cells["state"]
        if self.initial_perturbation > 0.0:
            cells["model_state"][:, OBSERVED] += perturbation[:, [0, 1, 2, 3, 3, 3, 3]] * _PERTURBATION * ERROR_SCALE
        self._look_ahead(cells)
        return cells

    def _look_ahead(self, cells: Records) -> None:
        """The load of the step from t to t + 1, and where it takes the cells."""
        look_ahead(self._settings, self.dataset.load_values, self.dataset.cell.packed.constants, cells)

    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """Take the actions, step the model, and move on to the next sample."""
        chosen, cost = checked_action(action, (self.cells, len(self.parameters))), np.empty(self.cells)
        decide(chosen, self._settings, self.now, cost)
        self._look_ahead(self.now)
        return cost

    @classmethod
    def follow(cls, records: Sequence[Trajectory], decision_s: float, **options: Any) -> FullStateTask:
        """
        Go through whole discharges, each with a cell of its own, with the model's state running free from the first sample.

        :param records: simulated discharges; no recording has the full state
        :param decision_s: without meaning: the policy decides at each sample
        """
        dataset = records if isinstance(records, TrajectoryDataset) else TrajectoryDataset.from_trajectories(records)
        samples = dataset.stop - dataset.first
        task = cls(len(dataset), **{**options, "dataset": dataset, "episode_steps": int(samples.max())})
        # the longest first, so that those that go on are always the first rows
        for row, n in enumerate(np.argsort(-samples, kind="stable")):
            point = {"trajectory": n, "sample": dataset.first[n]}
            task.start(np.array([row]), [np.random.default_rng(n)], point)
        return task

    def seen(self) -> tuple[IntArray, FloatArray, IntArray]:
        """Which data the next decision knows, x_{t+1} among them; times on the clock of the data set."""
        last = self.now["sample"] + 1
        return self.now["trajectory"].copy(), np.asarray(last * self.dataset.dt_s, dtype=np.float64), last + 1

    @property
    def estimate(self) -> FloatArray:
        """(q_mobile, r_o) of the model, C and ohm, shape (cells, 2)."""
        return np.stack([self.now["q_mobile_hat"], self.now["r_o_hat"]], axis=1)

    def drop_ended(self) -> None:
        """Go on without the cells whose episodes are over."""
        over = self.truncated()
        if over.any():
            self.now = self.now[~over]
            self.cells = len(self.now)

    def truncated(self) -> NDArray[np.bool_]:
        """Whose episode is over, as its steps or its data have come to an end."""
        now = self.now
        return np.asarray((now["decisions"] >= now["steps"]) | (now["sample"] >= now["last_decision"]))

    def observation(self) -> NDArray[np.float32]:
        """
        s_t = [x̂_t, x_{t+1}, u_{t+1}] and, with innovations, asinh of x_{t+1} - f(x̂_t, u_{t+1}; new cell) and of
        x_{t+1} - f(x_t, u_{t+1}; new cell), all scaled.
        """
        out = np.empty((self.cells, self.observation_size), dtype=np.float32)
        observe(self._settings, self.now, OBSERVATION_LIMIT, out)
        return out

    def report(self) -> dict[str, FloatArray]:
        """Where each cell stands after its last decision."""
        voltage_hat = np.empty(self.cells)
        voltage_batch(self.now["model_state"], self.now["q_mobile_hat"], True, self.dataset.cell.packed, voltage_hat)
        return {name: voltage_hat if name == "voltage_hat" else self.now[name].copy() for name in self.REPORTED}


class BatteryQmax(FullStateTask):
    """Find ``q_mobile``: ``BatteryQmax-v0``."""

    parameters = ("q_mobile",)


class BatteryRo(FullStateTask):
    """Find ``r_o``: ``BatteryRo-v0``."""

    parameters = ("r_o",)


class BatteryJoint(FullStateTask):
    """Find both: ``BatteryJoint-v0``."""

    parameters = ("q_mobile", "r_o")


class BatteryQmaxPaper(BatteryQmax):
    """Find ``q_mobile`` in the paper's literal form: ``BatteryQmaxPaper-v0``."""

    formulation = LITERAL
    episode_steps = 16


class BatteryRoPaper(BatteryRo):
    """Find ``r_o`` in the paper's literal form: ``BatteryRoPaper-v0``."""

    formulation = LITERAL
    episode_steps = 16
