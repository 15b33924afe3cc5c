"""The end of a discharge in progress, from the earlier life of its cell and the load to come."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from battery_env.checks import LoadUnit
from battery_env.electrochemistry.ends import BAND, quantile
from battery_env.estimates.findings import is_only_imprecise
from battery_env.files import finite_or_none, replacing
from battery_env.lab.calibrate import calibration_of, cut, estimate, predict
from battery_env.lab.forecast import Forecast, decimals
from battery_env.lab.life import Life, life_before
from battery_env.lab.readers.columns import FileFormat
from battery_env.lab.report import Calibration
from battery_env.lab.settings import Settings
from battery_env.lab.sources import Source, find_sources, read_source, record_name
from battery_env.loads import Load, LoadToCome
from battery_env.records.discharge import Discharge

# The unit of a load, by the column of its file.
_LOAD_COLUMNS: dict[str, LoadUnit] = {"current_A": "current", "power_W": "power"}


@dataclass(frozen=True)
class End:
    """
    The end of a discharge in progress, with its calibration.

    :param name: name of the discharge in results
    :param calibration: calibration of the record, with its forecast
    :param life: earlier life of the cell; ``None``: unknown
    """

    name: str
    calibration: Calibration
    life: Life | None = None

    @property
    def forecast(self) -> Forecast:
        """The forecast of the end."""
        assert self.calibration.end is not None
        return self.calibration.end

    @property
    def discharges_after_life(self) -> int:
        """How many discharges after the last one of the life it is, by their numbers."""
        return 1 if self.life is None else self.life.discharges_until(self.calibration.cycle)

    @property
    def contradicted(self) -> bool:
        """Whether the record contradicts the estimate; an estimate that is only imprecise has a wide interval."""
        return not self.calibration.settled and not is_only_imprecise(self.calibration.findings)

    def row(self) -> dict[str, Any]:
        """Return all numbers by name, with units; of uncertain numbers the quantiles ``probability``."""
        forecast, prior_C = self.forecast, self.calibration.settings.prior_q_mobile_C
        samples = {
            "eod_time_s": forecast.eod_time_s,
            "remaining_s": forecast.remaining_s,
            "soc": forecast.soc,
            "q_mobile_C": forecast.q_mobile,
            "resistance_10s_ohm": forecast.resistance_10s_ohm,
            "r_o_ohm": forecast.r_o,
            "capacity_Ah": forecast.capacity_Ah,
            "state_of_health": forecast.state_of_health,
        }
        return {
            "record": self.name,
            "method": self.calibration.method,
            "settled": self.calibration.settled,
            "findings": [asdict(each) for each in self.calibration.findings],
            "reason": self.calibration.reason,
            "load": forecast.load_name,
            "cut_off_V": forecast.cut_off_V,
            "now_s": forecast.now_s,
            "probability": list(BAND),
            **{name: [finite_or_none(value) for value in quantile(values, BAND).tolist()] for name, values in samples.items()},
            "nominal_Ah": finite_or_none(forecast.nominal_Ah),
            "life_discharges": 0 if self.life is None else int(self.life.table["valid"].sum()),
            "discharges_after_life": self.discharges_after_life,
            "prior_q_mobile_C": None if prior_C is None else list(prior_C),
            "notes": list(forecast.notes),
        }

    def text(self) -> str:
        """Return the forecast as text for readers."""
        lines = [self.name]
        if self.life is not None:
            valid = self.life.table["valid"]
            left_out = f"; {(~valid).sum()} left out" if not valid.all() else ""
            plural = "" if valid.sum() == 1 else "s"
            later = self.discharges_after_life
            sparse = f"; the last one is {later} before this one, and the fade in between is not known" if later > 1 else ""
            lines.append(f"life of {valid.sum()} earlier discharge{plural}{left_out}{sparse}")
        if (prior_C := self.calibration.settings.prior_q_mobile_C) is not None:
            mean_Ah, sd_Ah = (each_C / 3600.0 for each_C in prior_C)
            digits = decimals(mean_Ah, 3)
            lines.append(f"q_max before: {mean_Ah:.{digits}f} Ah, sd {sd_Ah:.{digits}f} Ah")
        return "\n".join([*lines, self.forecast.summary()])

    def draw(self, path: Path) -> None:
        """Write the forecast as a new figure."""
        from battery_env.plotting import literal  # here, as matplotlib takes long to import

        figure = self.forecast.plot()
        figure.suptitle(f"{literal(self.name)}, then {self.forecast.load_name}", fontsize=10)
        with replacing(path, new=True) as file:
            figure.savefig(file, dpi="figure")


def forecast_end(
    discharge: Discharge,
    settings: Settings | None = None,
    load: LoadToCome | None = None,
    samples: int = 1000,
    life: Life | None = None,
) -> Forecast:
    """
    Forecast the end of a discharge in progress, from :class:`~battery_env.Settings` and the earlier life of its cell.

    .. code-block:: python

      life = track_life(read_discharges("life.csv"), cut_off_V=2.7)
      end = forecast_end(read_discharges("running.csv")[0], load=1.5, life=life)
      print(end.eod_quantile_s([0.05, 0.5, 0.95]), end.summary())

    :param discharge: the record so far
    :param settings: how to calibrate the record; ``None``: the defaults
    :param load: load from the last sample under load on, as for :func:`battery_env.forecast`; ``None``: as so far
    :param samples: number of samples of the forecast
    :param life: earlier life of the cell, which gives the prior for this load, and what the model misses at this load;
        ``None``: the prior of the settings, if any. With a life, or with a prior and a load, the constants are fixed: they and
        ``r_o`` carry over together
    :raises ValueError: if the discharge cannot be used, or the load is out of range
    """
    end = calibrate_running(discharge, Settings() if settings is None else settings, load, samples, life).end
    assert end is not None
    return end


def calibrate_running(
    discharge: Discharge, settings: Settings, load: LoadToCome | None = None, samples: int = 1000, life: Life | None = None
) -> Calibration:
    """Calibrate a discharge in progress, with the prior and the usual start of its earlier life, and forecast its end."""
    model_error = None
    if life is not None:
        model_error = life.model_error_for(discharge, load)
        start = life.usual_start or settings.usual_start
        settings = replace(settings, prior_q_mobile_C=life.prior_for(discharge, load), usual_start=start)
    # constants without a stated uncertainty carry over from a life, or to another load
    carries_over = settings.prior_q_mobile_C is not None and (life is not None or load is not None)
    loaded = cut(discharge, settings)
    fit = estimate(loaded, fixes_constants=carries_over and not settings.cell_rates_sd)
    return calibration_of(loaded, fit, predict(loaded, fit, load, samples, model_error))


def read_load(path: str | Path) -> Load:
    """
    Read a load to come: text, with commas, semicolons or tabs, of the columns ``time_s``, from 0 on, and ``current_A`` or
    ``power_W``, positive in discharge. Each value holds until the next time, and the last one for ever. A ``ValueError`` if a
    file holds none.
    """
    try:
        table = pd.read_csv(path, sep=None, engine="python", encoding="utf-8-sig", compression=None)
    except OSError:
        raise
    except Exception as error:  # pandas raises any kind of error
        raise ValueError(f"{path}: no table: {error}") from error
    table.columns = table.columns.str.strip()
    columns = [name for name in _LOAD_COLUMNS if name in table.columns]
    if "time_s" not in table.columns or len(columns) != 1:
        names = ", ".join(table.columns)
        raise ValueError(f"{path}: a load has the columns time_s and either current_A or power_W, got {names}")
    try:
        load = Load(table["time_s"].to_numpy(), table[columns[0]].to_numpy(), _LOAD_COLUMNS[columns[0]])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    if load.value.max() <= 0.0:
        raise ValueError(f"{path}: {columns[0]} is nowhere above 0, so that nothing is drawn: a discharge is positive")
    return load


def figure_of(argument: str, folder: Path) -> Path:
    """The file of the figure, for a record as the command line names it."""
    source = find_sources([argument])[0]
    return folder / f"{record_name(source.stem, source.cycle)}_forecast.png"


def read_life(arguments: Sequence[str], running: Source, file_format: FileFormat) -> list[Discharge]:
    """Read the discharges of a cell before the one in progress: by their dates if all have dates, otherwise by their names."""
    before: list[Discharge] = []
    after: list[Discharge] = []
    group, running_start = before, ""
    sources = find_sources(arguments)
    folders = sorted({str(Path(source.path).parent) for source in sources})
    if len(folders) > 1:
        warnings.warn(f"--life: the records of {', '.join(folders)} are taken for one cell's", stacklevel=2)
    for source in sources:
        is_its_file = Path(source.path).resolve() == Path(running.path).resolve()
        try:
            recordings = read_source(source, file_format)
        except Exception as error:  # readers of files raise any kind of error
            warnings.warn(f"{source.argument} is left out: {' '.join(str(error).split())}", stacklevel=2)
            continue
        for recording in recordings:
            number = recording.meta.get("cycle", "")
            if is_its_file and running.cycle in (None, number):
                group, running_start = after, recording.meta.get("start_time", "")
                continue
            try:
                group.append(recording.discharge())
            except (TypeError, ValueError) as error:
                warnings.warn(f"{source.path}:{number} is left out: {error}", stacklevel=2)
    discharges = [*before, *after]
    are_dated = all(each.meta.get("start_time") for each in discharges)
    if len(sources) > 1 and not are_dated:
        order = ", ".join(dict.fromkeys(str(each.meta.get("source")) for each in discharges))
        warnings.warn(f"--life: in the order of names, as not all records have dates: {order}", stacklevel=2)
    if are_dated and (running_start or group is before):
        discharges.sort(key=lambda each: each.meta["start_time"])
        before = [each for each in discharges if not running_start or each.meta["start_time"] < running_start]
    if not before:
        raise ValueError(f"{', '.join(arguments)}: no discharge before {running.argument}")
    return before


def end_of_record(
    argument: str, settings: Settings, file_format: FileFormat, life: Sequence[str] = (), load: Path | None = None
) -> End:
    """Forecast the end of the last discharge in a file, by the arguments of the command line."""
    future_load = None if load is None else read_load(load)
    sources = find_sources([argument])
    if len(sources) > 1:
        raise ValueError(f"{argument} holds {len(sources)} files: name the one in progress, and the others with --life")
    recording = read_source(sources[0], file_format)[-1]
    source, running = sources[0]._replace(cycle=recording.meta.get("cycle")), recording.discharge()
    earlier_life = None
    if life:
        earlier = read_life(life, source, file_format)
        cells = sorted({each.meta["cell"] for each in [*earlier, running] if "cell" in each.meta})
        if len(cells) > 1:
            raise ValueError(f"--life: these are discharges of {' and '.join(cells)}: give those of the cell in progress")
        earlier_life = life_before(earlier, settings)
    calibration = calibrate_running(running, settings, future_load, life=earlier_life)
    if not calibration.in_progress:
        raise ValueError(
            f"{argument} reaches {settings.resolved.cut_off_V:g} V at {calibration.measured_eod_time_s:.0f} s, so that "
            "nothing is left to forecast: calibrate it, or give a lower --cut-off"
        )
    return End(record_name(source.stem, source.cycle), calibration, earlier_life)
