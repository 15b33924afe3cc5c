"""Cells that age along a path: the joint distribution of their constants, their charge and their resistance."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from battery_env.arrays import FloatArray
from battery_env.checks import check_positive, check_whole_number
from battery_env.electrochemistry.cell import UNCERTAIN_CONSTANTS, CellParameters
from battery_env.electrochemistry.equilibrium import with_equilibrium
from battery_env.electrochemistry.model_error import ERRORS_PER_DISCHARGE
from battery_env.electrochemistry.tangents import RATE_CONSTANTS
from battery_env.files import read_json, write_json
from battery_env.parameters import PARAMETER_NAMES, Q_MOBILE, R_O

#: Number of coefficients of a change of the equilibrium voltage (:func:`with_equilibrium`).
EQUILIBRIUM_SIZE = 8
EQUILIBRIUM_NAMES: tuple[str, ...] = tuple(f"equilibrium {k}" for k in range(EQUILIBRIUM_SIZE))
#: Quantities along a path: logarithms of factors of constants, coefficients that are added to the equilibrium voltage, V, and
#: the logarithms of ``q_mobile`` in C and ``r_o`` in ohm.
PATH_NAMES: tuple[str, ...] = (*UNCERTAIN_CONSTANTS, *EQUILIBRIUM_NAMES, *PARAMETER_NAMES)
#: Standard deviations of the distance of cells from the path; no cell lies more than two of them away. Chosen on B0005 along
#: the path of B0006.
SPREAD_SD: tuple[float, ...] = (*(0.5,) * len(UNCERTAIN_CONSTANTS), *(0.005,) * EQUILIBRIUM_SIZE, 0.03, 0.25)
#: A cell farther from the path than this, in standard deviations, is of another kind.
PATH_DISTANCE_LIMIT_SD = 4.0
#: Cells may be younger and older than those of the path by this share of its length.
PATH_EXTRAPOLATION_SHARE = 0.2

# A path of n lives widens standard deviations 1 + _LIVES_SD_TERM / n times. Chosen on B0006 along the path of B0005.
_LIVES_SD_TERM = 2.0
_FORMAT, _FORMAT_VERSION = "battery_env.AgingPath", 1
_RATES, _EQUILIBRIUM = slice(0, len(UNCERTAIN_CONSTANTS)), slice(len(UNCERTAIN_CONSTANTS), -len(PARAMETER_NAMES))
# A path extrapolates its mean slope over this share of its ages, because single ages scatter.
_END_SLOPE_SHARE = 0.25
# Number of cells that give the moments of the distribution, and the seed of the draw.
_MOMENTS_CELLS, _MOMENTS_SEED = 4000, 0


class DrawnCells(NamedTuple):
    """
    Cells along a path, each of an age of its own.

    :param place: on the path, 0 at its start and 1 at its end, shape (n,)
    :param q_mobile: C, shape (n,)
    :param r_o: ohm, shape (n,)
    :param factors: of ``UNCERTAIN_CONSTANTS``, shape (n, 4)
    :param equilibrium_V: coefficients that are added to the equilibrium voltage, V, shape (n, 8)
    """

    place: FloatArray
    q_mobile: FloatArray
    r_o: FloatArray
    factors: FloatArray
    equilibrium_V: FloatArray


@dataclass(frozen=True)
class AgingPath:
    """
    The path along which cells of one kind age, from :func:`battery_env.fit_life` and the lives of some cells. As a prior,
    another cell of the kind lies somewhere along one of these lives, a little before its start or beyond its end, and off
    the life by ``SPREAD_SD``.

    .. code-block:: python

      path = fit_life(load_nasa_discharges("B0006"))
      path.to_json("b0006_path.json")
      cells = TrajectoryDataset.along(path, n=100, loads=[constant(2.0, "current")], seed=0)
      print(LeastSquares(path=path).estimate(load_nasa_discharges("B0005")[80].loaded_part(2.7)))

    :param cell: the constants that all ages share, and the reference of all other constants
    :param lives: for each cell one row of ``PATH_NAMES`` per age, from the youngest age on
    :param mismatch_V: expected error of the model of a cell at its place, V
    :raises TypeError: for a value of another type
    :raises ValueError: for a life of less than two ages, rows of another length, or values out of range
    """

    cell: CellParameters
    lives: tuple[tuple[tuple[float, ...], ...], ...]
    mismatch_V: float

    def __post_init__(self) -> None:
        if not isinstance(self.cell, CellParameters):
            raise TypeError(f"cell must be CellParameters, got {self.cell!r}")
        check_positive("mismatch_V", self.mismatch_V)
        if not self.lives:
            raise ValueError("a path is of at least one life")
        for life in self.lives:
            if len(life) < 2 or any(len(row) != len(PATH_NAMES) for row in life):
                raise ValueError(f"a life must hold at least two ages of {len(PATH_NAMES)} numbers each")
            if not np.isfinite(np.asarray(life, dtype=np.float64)).all():
                raise ValueError("a life must hold finite numbers")
            Q_MOBILE.check([float(np.exp(row[-2])) for row in life])
            R_O.check([float(np.exp(row[-1])) for row in life])

    def draw(self, n: int, seed: int) -> DrawnCells:
        """
        Draw cells: a life, a uniform place along the life, and a distance from the life.

        :param n: number of cells
        :param seed: seed of the draw
        :return: the cells
        :raises ValueError: for no cells, or a negative seed
        """
        n, seed = check_whole_number("n", n, 1), check_whole_number("seed", seed, 0)
        rng = np.random.default_rng(seed)
        low, high = -PATH_EXTRAPOLATION_SHARE, 1.0 + PATH_EXTRAPOLATION_SHARE
        life, place = rng.integers(len(self.lives), size=n), rng.uniform(low, high, size=n)
        values = np.empty((n, len(PATH_NAMES)))
        for k, rows in enumerate(self.lives):
            values[life == k] = _interpolate(np.array(rows), place[life == k])
        values += np.array(SPREAD_SD) * np.clip(rng.standard_normal(values.shape), -2.0, 2.0)
        q_mobile = np.clip(np.exp(values[:, -2]), *Q_MOBILE.limits)
        r_o = np.clip(np.exp(values[:, -1]), *R_O.limits)
        return DrawnCells(place, q_mobile, r_o, np.exp(values[:, _RATES]), values[:, _EQUILIBRIUM])

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of ``PATH_NAMES`` over the cells of the path, shapes (14,) and (14, 14)."""
        _, q_mobile, r_o, factors, equilibrium_V = self.draw(_MOMENTS_CELLS, _MOMENTS_SEED)
        values = np.column_stack([np.log(factors), equilibrium_V, np.log(q_mobile), np.log(r_o)])
        return values.mean(axis=0), np.cov(values.T)

    @property
    def errors_per_C(self) -> float:
        """Number of independent model errors per coulomb, in addition to a first one."""
        return ERRORS_PER_DISCHARGE["path"] / self.cell.q_mobile

    @property
    def sd_ratio(self) -> float:
        """
        Ratio of the standard deviations that an estimate states, and that decide whether ``q_mobile`` is settled, to the
        standard deviations of a fit along the path: 3 for the path of one life, 2 for the path of two lives.
        """
        return 1.0 + _LIVES_SD_TERM / len(self.lives)

    def distance_sd(self, values: Mapping[str, float]) -> float:
        """
        Return the distance of a cell from the cells of the path, as a normal deviate of the same probability.

        :param values: by ``PATH_NAMES``; parameters, not their logarithms
        :return: standard deviations
        """
        # a resistance may be 0
        smallest = np.finfo(np.float64).tiny
        row = [np.log(max(values[name], smallest)) if name in PARAMETER_NAMES else values[name] for name in PATH_NAMES]
        return float(self.distances_sd(np.array([row]))[0])

    def distances_sd(self, values: FloatArray) -> FloatArray:
        """
        Return :meth:`distance_sd` of many cells.

        :param values: by ``PATH_NAMES``, shape (n, 14)
        :return: standard deviations, shape (n,)
        """
        mean, covariance = self.moments
        x = values - mean
        return _normal_distances(np.sum(x * np.linalg.solve(covariance, x.T).T, axis=1), x.shape[1])

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """
        Save the path.

        :param path: the new file
        :return: the file
        :raises FileExistsError: if the file exists already
        """
        return write_json(path, _FORMAT, _FORMAT_VERSION, self.to_mapping())

    @classmethod
    def from_json(cls, path: str | os.PathLike[str]) -> AgingPath:
        """
        Load a path.

        :param path: a file of :meth:`to_json`
        :return: the path
        :raises ValueError: if the file is damaged, is another file, or has another format version
        """
        content = read_json(path, _FORMAT, _FORMAT_VERSION)
        try:
            return cls.of_mapping(content)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path} is damaged, or no path saved by AgingPath.to_json: {error}") from error

    def to_mapping(self) -> dict[str, Any]:
        """
        Return the path as JSON holds it.

        :return: input of :meth:`of_mapping`
        """
        return {"names": PATH_NAMES, **asdict(self)}

    @classmethod
    def of_mapping(cls, content: Mapping[str, Any]) -> AgingPath:
        """
        Make a path from a mapping, as JSON holds it.

        :param content: output of :meth:`to_mapping`
        :return: the path
        :raises KeyError: for an entry that is missing
        :raises TypeError: for an entry that is unknown, or a value of another type
        :raises ValueError: for values out of range
        """
        arguments = dict(content)
        if tuple(arguments.pop("names")) != PATH_NAMES:
            raise ValueError(f"its names are not {', '.join(PATH_NAMES)}")
        lives = tuple(tuple(tuple(map(float, row)) for row in life) for life in arguments.pop("lives"))
        return cls(CellParameters.of_mapping(arguments.pop("cell")), lives, **arguments)


def _normal_distances(squares: FloatArray, count: int) -> FloatArray:
    """Return normal deviates of the probability of these sums of ``count`` squares (Wilson and Hilferty 1931); at least 0."""
    spread = 2.0 / (9.0 * count)
    return np.maximum(((squares / count) ** (1.0 / 3.0) - (1.0 - spread)) / np.sqrt(spread), 0.0)


def cell_with(cell: CellParameters, constants: Mapping[str, float] | None) -> CellParameters:
    """Return a cell with the constants of a fit, which are relative to the cell's; ``None``: the cell as it is."""
    fitted = constants or {}
    rates = {name: getattr(cell, name) * float(np.exp(fitted[name])) for name in RATE_CONSTANTS if name in fitted}
    if EQUILIBRIUM_NAMES[0] in fitted:
        cell = with_equilibrium(cell, [fitted[name] for name in EQUILIBRIUM_NAMES])
    return cell.replace(**rates) if rates else cell


def _interpolate(rows: FloatArray, place: FloatArray) -> FloatArray:
    """Return values at places of a life: linear between two ages, and extrapolated with the slopes at its ends."""
    last = len(rows) - 1
    position = np.clip(place, 0.0, 1.0) * last
    lower = np.minimum(position.astype(np.int64), last - 1)
    share = (position - lower)[:, None]
    values = (1.0 - share) * rows[lower] + share * rows[lower + 1]
    span = max(round(_END_SLOPE_SHARE * last), 1)
    start_slope, end_slope = rows[span] - rows[0], rows[last] - rows[last - span]
    values += np.minimum(place, 0.0)[:, None] * last / span * start_slope
    values += np.maximum(place - 1.0, 0.0)[:, None] * last / span * end_slope
    return np.asarray(values)
