"""Calibration from current and voltage, without a measured state, for a batch of cells."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from battery_env.arrays import FloatArray, IntArray
from battery_env.checks import check_not_negative, check_whole_number
from battery_env.electrochemistry import CellParameters, check_cell
from battery_env.electrochemistry.aging_path import AgingPath
from battery_env.parameters import PARAMETER_NAMES
from battery_env.records import Record
from battery_env.sensors import RandomSensorErrors
from battery_env.tasks.base import OBSERVATION_LIMIT, CalibrationTask, Generators, Rows
from battery_env.tasks.data import LoadKind, Split, open_dataset, standard_dataset
from battery_env.tasks.voltage.fit import LEAST_NOISE_V, VOLTAGE_SCALE_V, FitPrior, FitResult, NuisanceFit
from battery_env.tasks.voltage.readings import CURRENT, MEASURED, OHMIC, SENSOR_ROWS, Readings, summarise_residuals
from battery_env.trajectories import TrajectoryDataset

#: Limits of estimates, C and ohm.
ESTIMATE_RANGES: dict[str, tuple[float, float]] = {"q_mobile": (3500.0, 8100.0), "r_o": (0.05, 0.35)}
#: Move of the estimate by an action of 1, C and ohm.
LARGEST_STEPS: dict[str, float] = {"q_mobile": 1500.0, "r_o": 0.12}

#: Along a path, distance of the estimate from the fit at an action of 1, in standard deviations of the fit.
FURTHEST_SD = 2.0

#: Number of equal stretches of the data so far; an observation has two means a stretch, of less and of more current.
STRETCHES = 16
#: Sensors of the discharges in episodes.
SENSORS = RandomSensorErrors(noise_V=(LEAST_NOISE_V, 0.030), offset_V=0.010)

#: The cost of a decision: the misfit of the estimate to the readings, or the error of the model's hidden state.
Cost = Literal["misfit", "state"]
_COST_SCALE_V = 0.002
_STATE_COST_SCALE = 0.01
# Scales of an observation
_SLOPE_SCALE_V_PER_C = 5e-5
_CURRENT_SCALE_A = 3.0
_TIME_SCALE_S = 3000.0


@lru_cache(maxsize=4)
def _readings_of_a_dataset(
    dataset: TrajectoryDataset, reading_s: float | tuple[float, float], cell: CellParameters
) -> Readings:
    if dataset.first.any():
        raise ValueError(
            "dataset leaves out the start of discharges (it is trimmed, as with load='paper'), and voltages are judged from "
            "full charge on: take whole discharges, or another load"
        )
    return Readings.of(dataset, reading_s, dataset.dt_s, cell)


class VoltageTask(CalibrationTask):
    """
    Estimate ``q_mobile`` and ``r_o`` from voltage and current, in ``cells`` episodes side by side.

    An action moves the estimate by ``sign(a) * a**2`` times ``LARGEST_STEPS``: far where the misfit is large, finely near the
    optimum. Then new readings arrive, and the cost grows with the misfit to all data so far at the new estimate: the root mean
    square of the mean residuals of equal stretches of the data, without the likely offset of the sensor. A mean residual has
    less noise than a single reading. The misfit needs no true parameter, so that a task can use recorded discharges too. For
    simulated discharges the cost may be the error of the model's hidden state instead, as in the paper. The page of
    ``BatteryVoltageJoint-v0`` explains the options.

    :ivar readings: the readings of the discharges
    :ivar sensors: their sensors
    :ivar path: the prior of the fit in the observation; ``None``: no path
    :param cells: size of the batch
    :raises ValueError: for values out of range
    """

    is_averaged = False
    parameters = PARAMETER_NAMES

    def __init__(
        self,
        cells: int,
        *,
        episode_steps: int = 8,
        reading_s: float | tuple[float, float] = 10.0,
        new_readings: tuple[int, int] = (0, 29),
        process_noise_V: float = 0.0,
        start: Literal["random", "new_cell", "true"] = "random",
        cost: Cost = "misfit",
        load: LoadKind = "piecewise",
        split: Split = "train",
        dt_s: float = 1.0,
        mismatch: float = 0.0,
        nuisance: float = 0.0,
        path: AgingPath | str | os.PathLike[str] | None = None,
        cell: CellParameters | None = None,
        dataset: Sequence[Record] | str | os.PathLike[str] | None = None,
        **sensors: Any,
    ) -> None:
        check_not_negative(process_noise_V=process_noise_V, nuisance=nuisance)
        if not 0 <= new_readings[0] <= new_readings[1]:
            raise ValueError(f"new_readings must be (fewest, most) with 0 <= fewest <= most, got {new_readings!r}")
        if start not in ("random", "new_cell", "true"):
            raise ValueError(f"start must be one of ('random', 'new_cell', 'true'), got {start!r}")
        if cost not in get_args(Cost):
            raise ValueError(f"cost must be one of {get_args(Cost)}, got {cost!r}")
        if path is not None:
            path = path if isinstance(path, AgingPath) else AgingPath.from_json(path)
            if nuisance > 0.0 or mismatch > 0.0:
                raise ValueError("path says how far constants are off: leave nuisance and mismatch out")
        choices = {"load": load, "split": split, "dt_s": dt_s, "mismatch": mismatch}
        self._open(dataset, reading_s, cell, path, choices)
        self.cells, self.new_readings = cells, new_readings
        self.episode_steps = check_whole_number("episode_steps", episode_steps, 1)
        self.sensors = replace(SENSORS, **sensors)
        self.process_noise_V, self.first_estimate = process_noise_V, start
        self.decision_s = self.readings.interval_s * (sum(new_readings) / 2.0)
        self._set_scales()
        self._cost = cost
        is_unknown = np.isnan(self.readings.q_mobile) | np.isnan(self.readings.r_o)
        if cost == "state" and is_unknown.any():
            raise ValueError(
                f"cost='state' is the error of a state that only a simulation knows, and {is_unknown.sum()} of "
                f"{len(is_unknown)} discharges are not simulated: take cost='misfit' for recorded ones"
            )
        self.observation_size = 6 * STRETCHES + 4 + len(self.parameters)
        self.path, self._fit = path, None
        if nuisance > 0.0 or path is not None:
            prior = (
                FitPrior.of_ranges(ESTIMATE_RANGES, self.sensors.offset_V, nuisance)
                if path is None
                else FitPrior.along(path, self.sensors.offset_V)
            )
            self._fit = NuisanceFit(cells, self.readings.model, self.readings.cell, prior)
            self.observation_size += self._fit.observation_size
        self._allocate()

    def _open(
        self,
        dataset: Sequence[Record] | str | os.PathLike[str] | None,
        reading_s: float | tuple[float, float],
        cell: CellParameters | None,
        path: AgingPath | None,
        choices: Mapping[str, Any],
    ) -> None:
        """Read the discharges of ``dataset``, or of a standard data set."""
        dataset = open_dataset(dataset)
        if cell is not None:
            self._check_reach(check_cell(cell))
        elif path is not None:
            cell = path.cell
        elif isinstance(dataset, TrajectoryDataset):
            cell = dataset.cell
        cell = check_cell(cell)
        if dataset is None:
            dataset = standard_dataset(self.parameters, **choices, cell=cell, path=path)
        else:
            self._refuse_with_dataset(**choices)
        self.dataset = dataset
        if isinstance(reading_s, Sequence):
            reading_s = (reading_s[0], reading_s[1])
        if isinstance(dataset, TrajectoryDataset):
            self.readings = _readings_of_a_dataset(dataset, reading_s, cell)
        else:
            self.readings = Readings.of(dataset, reading_s, cell=cell)

    def _set_scales(self) -> None:
        """Set the ranges of actions, and the first estimates."""
        cell, readings = self.readings.cell, self.readings
        self._low, self._high = np.array([ESTIMATE_RANGES[name] for name in self.parameters]).T
        self._step = np.array([LARGEST_STEPS[name] for name in self.parameters])
        self._new_cell: FloatArray = np.clip([cell.q_mobile, cell.r_o], self._low, self._high)
        # the true parameters of the discharges, or the new cell's if they are unknown
        true = np.column_stack([readings.q_mobile, readings.r_o])
        self._reference = np.where(np.isnan(true), self._new_cell, true)

    def _allocate(self) -> None:
        """Make room for the state of all cells."""
        cells, longest = self.cells, int(self.readings.count.max())
        self.discharge: IntArray = np.zeros(cells, dtype=np.int64)
        self.count: IntArray = np.ones(cells, dtype=np.int64)
        self._new_counts: IntArray = np.zeros((cells, self.episode_steps), dtype=np.int64)
        self._step_of_episode: IntArray = np.zeros(cells, dtype=np.int64)
        self._last_step: IntArray = np.zeros(cells, dtype=np.int64)
        self._estimate = np.tile(self._new_cell, (cells, 1))
        self._measurements = np.zeros((SENSOR_ROWS, cells, longest))
        # means of the residual, V, of dV/dq_mobile, V/C, and of the ohmic drop per ohm, A
        self._means = np.zeros((3, cells, STRETCHES, 2))
        self._rms_V, self._last_V, self._offset_V, self._misfit_V = np.zeros((4, cells))

    def _check_reach(self, cell: CellParameters) -> None:
        for name in self.parameters:
            (low, high), value = ESTIMATE_RANGES[name], getattr(cell, name)
            if not low <= value <= high:
                raise ValueError(
                    f"{name} of cell must lie within {low:g} .. {high:g}, where the task looks for it, got {value:g}. "
                    "Take least squares for such cells."
                )

    @classmethod
    def options(cls) -> dict[str, Any]:
        """Return the options of the task, which its page explains, and of its sensors."""
        return {**super().options(), **asdict(SENSORS)}

    def start(self, rows: Rows, generators: Generators, options: Mapping[str, Any] | None = None) -> None:
        """
        Begin new episodes, each at a random reading of a random discharge; as of the base class.

        :param options: ``discharge`` (its number), ``reading`` (initial number of readings), ``q_mobile_hat`` and ``r_o_hat``
            (the first estimate)
        """
        choices = dict(options or {})
        discharge = choices.pop("discharge", None)
        reading = choices.pop("reading", None)
        estimates = {name: choices.pop(f"{name}_hat") for name in self.parameters if f"{name}_hat" in choices}
        if choices:
            raise ValueError(
                f"unknown reset options {tuple(choices)}; known: discharge, reading, "
                + ", ".join(f"{name}_hat" for name in self.parameters)
            )
        if discharge is not None and not 0 <= discharge < len(self.readings):
            raise ValueError(f"options['discharge'] must lie within 0 .. {len(self.readings) - 1}, got {discharge!r}")
        for name in estimates:
            low, high = ESTIMATE_RANGES[name]
            if not low <= estimates[name] <= high:
                raise ValueError(f"options['{name}_hat'] must lie within {low:g} .. {high:g}, got {estimates[name]!r}")
        fewest, most = self.new_readings
        for row, generator in zip(rows, generators, strict=True):
            n = int(generator.integers(len(self.readings))) if discharge is None else int(discharge)
            length = int(self.readings.count[n])
            # an estimate needs more readings than it has parameters
            count = int(generator.integers(len(PARAMETER_NAMES) + 1, length, endpoint=True) if reading is None else reading)
            if not 1 <= count <= length:
                raise ValueError(f"options['reading'] must lie within 1 .. {length} for discharge {n}, got {count}")
            self._new_counts[row] = generator.integers(fewest, most + 1, size=self.episode_steps)
            estimate = self._first_estimate(n, generator)
            for name, value in estimates.items():
                estimate[PARAMETER_NAMES.index(name)] = value
            self._step_of_episode[row] = 0
            self._set_cell(row, n, count, estimate)
            self._measure(row, n, generator)
        self._compare(rows)

    def _due_counts(self, discharge: int, interval_s: float) -> IntArray:
        """Return the number of readings of each decision on a whole record: at least two."""
        time_s = self.readings.time_s[self.readings.rows_of(discharge)]
        first, last = (max(int(np.ceil(at_s / interval_s - 1e-9)), 1) for at_s in time_s[[1, -1]])
        due_s = interval_s * np.arange(first, last + 1) * (1.0 + 1e-9)
        return np.asarray(np.searchsorted(time_s, due_s, side="right"), dtype=np.int64)

    @classmethod
    def of_records(cls, records: Sequence[Record], decision_s: float, **options: Any) -> VoltageTask:
        """
        Make a task of whole records, one a cell, without sensor errors: from the first readings, and from the estimate of a
        new cell. The cost is the misfit, so that a policy of any cost can act on recorded discharges.

        :param records: discharges from full charge, simulated or recorded
        """
        task = cls(len(records), **{"start": "new_cell", **options, "dataset": records, "cost": "misfit"})
        due_counts = [task._due_counts(n, decision_s) for n in range(task.cells)]
        task._new_counts = np.zeros((task.cells, max(map(len, due_counts))), dtype=np.int64)
        for n, counts in enumerate(due_counts):
            task._set_cell(n, n, int(counts[0]), task._first_estimate(n, None))
            task._new_counts[n, : len(counts) - 1] = np.diff(counts)
            task._last_step[n] = len(counts)
        task._compare()
        return task

    def available_data(self) -> tuple[IntArray, FloatArray, IntArray]:
        """Return the data of the next decision."""
        readings = self.readings
        last = readings.sample[readings.start[self.discharge] + self.count - 1]
        return self.discharge.copy(), readings.start_s[self.discharge] + self._time_s, last + 1

    @property
    def _time_s(self) -> FloatArray:
        """Time of the last reading since the start, s."""
        return np.asarray(self.readings.time_s[self.readings.start[self.discharge] + self.count - 1])

    @property
    def estimate(self) -> FloatArray:
        """(q_mobile, r_o), C and ohm, shape (cells, 2)."""
        return self._estimate.copy()

    def fit(self) -> FitResult | None:
        """Return the fit in the observation (options ``nuisance`` and ``path``)."""
        return None if self._fit is None else self._fit.result(self._estimate)

    def _set_cell(self, row: int, discharge: int, count: int, estimate: FloatArray) -> None:
        """Put a cell at a point of a discharge, with exact measurements."""
        length = self.readings.count[discharge]
        self.discharge[row], self.count[row] = discharge, count
        self._measurements[:, row, :length] = self.readings.exact_measurements(discharge)
        self._estimate[row] = estimate
        if self._fit is not None:
            self._fit.start(row)
        self._last_step[row] = self.episode_steps

    def _first_estimate(self, discharge: int, generator: np.random.Generator | None) -> FloatArray:
        if self.first_estimate == "random" and generator is not None:
            return np.asarray(self._low + (self._high - self._low) * generator.random(len(self._low)))
        return (self._reference[discharge] if self.first_estimate == "true" else self._new_cell).copy()

    def _measure(self, row: int, discharge: int, generator: np.random.Generator) -> None:
        """Add the noise of the cell, and the errors of the sensors, to the measurements of one discharge."""
        length = int(self.readings.count[discharge])
        voltage_V = self._measurements[MEASURED, row, :length]
        if self.process_noise_V > 0.0:
            voltage_V += self.readings.process_noise_V(discharge, self.process_noise_V, generator.standard_normal((3, length)))
        noise_V = self.sensors.draw_noise_V(generator)
        noise = generator.standard_normal(length) if noise_V > 0.0 else np.zeros(length)
        errors = self.sensors.draw_biases(generator, noise_V)
        voltage_V[:] = errors.read_voltage_V(voltage_V, noise)
        if (errors.current_gain, errors.current_offset_A) != (1.0, 0.0):
            measured = self.readings.with_sensor(discharge, errors.current_gain, errors.current_offset_A)
            self._measurements[CURRENT : OHMIC + 1, row, :length] = measured

    def _compare(self, rows: Rows | None = None) -> None:
        """Compare cells with their readings; ``rows`` of ``None``: all cells."""
        cells = np.arange(self.cells) if rows is None else np.asarray(rows, dtype=np.int64)
        count, estimate, measurements = self.count, self._estimate, self._measurements
        summarise_residuals(cells, count, estimate, measurements, self.readings.model, self._means, self._rms_V, self._last_V)
        if self._fit is not None:
            self._fit.step(cells, count, estimate, measurements)
        residual_V = self._means[0]
        self._offset_V = np.clip(residual_V.mean(axis=(1, 2)), -self.sensors.offset_V, self.sensors.offset_V)
        self._misfit_V = np.sqrt(np.mean((residual_V - self._offset_V[:, None, None]) ** 2, axis=(1, 2)))

    def restore(self, estimate: FloatArray, constants: FloatArray) -> None:
        """Set the estimates, C and ohm, and the :attr:`constants` of all cells."""
        self._estimate[:] = estimate
        if self._fit is not None:
            self._fit.constants[:] = constants
        self._compare()

    @property
    def constants(self) -> FloatArray:
        """The constants of the fit, as of :class:`~battery_env.tasks.voltage.fit.NuisanceFit`; a new array."""
        return np.zeros((self.cells, 0)) if self._fit is None else self._fit.constants.copy()

    def observation(self) -> NDArray[np.float32]:
        """
        Return residuals over the misfit, sensitivities and ohmic drops per ohm over the data so far; misfit, noise and offset;
        the time since the start of the discharge; and the estimate.
        """
        clipped = np.clip(np.concatenate(self._observation_parts(), axis=1), -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
        return clipped.astype(np.float32)

    def _observation_parts(self) -> list[FloatArray]:
        residual_V, slope_V_per_C, ohmic_A = self._means
        unexplained_V = residual_V - self._offset_V[:, None, None]
        return [
            (unexplained_V / (self._misfit_V + LEAST_NOISE_V)[:, None, None]).reshape(self.cells, -1),
            np.arcsinh(slope_V_per_C / _SLOPE_SCALE_V_PER_C).reshape(self.cells, -1),
            (ohmic_A / _CURRENT_SCALE_A).reshape(self.cells, -1),
            np.log((np.stack([self._misfit_V, self._rms_V], axis=1) + 0.1 * LEAST_NOISE_V) / VOLTAGE_SCALE_V),
            np.arcsinh(residual_V.mean(axis=(1, 2)) / VOLTAGE_SCALE_V)[:, None],
            (self._time_s / _TIME_SCALE_S)[:, None],
            self._scaled(self._estimate),
            *([] if self._fit is None else self._fit.observation_parts(self._step, self._high - self._low)),
        ]

    def _scaled(self, estimate: FloatArray) -> FloatArray:
        return np.asarray((2.0 * estimate - self._low - self._high) / (self._high - self._low))

    def advance(self, action: NDArray[np.floating]) -> FloatArray:
        """Move the estimates, let new readings arrive, and compare all data so far with the model."""
        step = np.clip(self._checked_action(action), -1.0, 1.0)
        if self._fit is not None and self.path is not None:
            estimate = self._fit.estimate_at(self._estimate, FURTHEST_SD * step)
        else:
            estimate = self._estimate + np.sign(step) * step**2 * self._step
        self._estimate[:] = np.clip(estimate, self._low, self._high)
        self._add_readings()
        self._compare()
        error = self._state_error() / _STATE_COST_SCALE if self._cost == "state" else self._misfit_V / _COST_SCALE_V
        return np.asarray(np.arcsinh(error))

    def _state_error(self) -> FloatArray:
        # relative, because at a fixed current the charges are linear in q_mobile, and the ohmic drop is linear in r_o
        return np.asarray(np.linalg.norm(self._estimate / self._reference[self.discharge] - 1.0, axis=1))

    def _add_readings(self) -> None:
        """Add the new readings of this step."""
        step = np.minimum(self._step_of_episode, self._new_counts.shape[1] - 1)
        new_count = self._new_counts[np.arange(self.cells), step]
        self.count = np.minimum(self.count + new_count, self.readings.count[self.discharge])
        self._step_of_episode += 1

    def truncated(self) -> NDArray[np.bool_]:
        """Return whether the steps of a cell have ended; after the last reading the estimate may still move."""
        return np.asarray(self._step_of_episode >= self._last_step)

    def report(self) -> dict[str, FloatArray]:
        """Return the state of each cell; true parameters are NaN for recorded discharges, ``voltage`` is measured."""
        data, last = self.readings, self.count - 1
        true_q_C = data.q_mobile[self.discharge]
        return {
            "q_mobile": true_q_C,
            "r_o": data.r_o[self.discharge],
            "q_mobile_hat": self._estimate[:, 0].copy(),
            "r_o_hat": self._estimate[:, 1].copy(),
            "voltage": self._measurements[MEASURED, np.arange(self.cells), last],
            "voltage_hat": self._last_V.copy(),
            # a full cell holds q_mobile in its negative electrode
            "soc": 1.0 - data.drawn_C[data.start[self.discharge] + last] / true_q_C,
        }
