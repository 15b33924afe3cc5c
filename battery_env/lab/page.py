"""The page for the bench, ``battery-calibrate page``: q_max, resistance, health, life and forecasts from files."""

import os
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import streamlit as st
from plotly.colors import qualitative

from battery_env.lab.batch import attempt, calibrate_recording, with_codes
from battery_env.lab.life import Life, life_before
from battery_env.lab.readers.columns import FileFormat, recognise
from battery_env.lab.readers.tables import open_file
from battery_env.lab.report import Calibration
from battery_env.lab.running import calibrate_running, forecast_end
from battery_env.lab.settings import Settings
from battery_env.lab.sources import Source, find_sources, no_formula, read_source, record_name
from battery_env.loads import constant
from battery_env.records.discharge import Discharge
from battery_env.records.recording import Recording

LAYOUT = {"height": 330, "margin": {"t": 30, "b": 30}, "legend": {"orientation": "h", "y": -0.25}, "showlegend": True}
# The columns of the table, by label.
SHORT = {
    "q_max (Ah)": "q_mobile_C",
    "sd (Ah)": "sd_q_mobile_C",
    "10 s resistance (mohm)": "resistance_10s_ohm",
    "sd (mohm)": "sd_resistance_10s_ohm",
    "measured (mohm)": "measured_resistance_10s_ohm",
    "state of health": "state_of_health",
}
WITHOUT_LIFE = {"q_max": "q_mobile_C", "state of health": "state_of_health"}
# Units of the columns of files; signs of a discharge.
UNITS = {"time": ("s", "ms", "min", "h"), "voltage": ("V", "mV"), "current": ("A", "mA"), "temperature": ("degC", "K")}
RECOGNISED = "told from the voltage"
SIGNS = {RECOGNISED: None, "negative": True, "positive": False}
# The example cell.
EXAMPLE = "B0005"
FULL, RESTED, KNOWN = "with a full cell", "at rest: the voltage tells the charge", "with a known charge"


class CalibratedDischarge(NamedTuple):
    """A discharge of one cell, with its calibration."""

    name: str
    cell: str
    discharge: Discharge
    calibration: Calibration


def ask() -> tuple[list[Any], str, bool, FileFormat, dict[str, Any]]:
    """Show the fields at the left; return their values, and those of the form of :func:`ask_how_to_read`."""
    side, state = st.sidebar, st.session_state
    files: Any = side.file_uploader(
        "Drop the files of your tester, and my_cell.json if you have one", accept_multiple_files=True
    )
    # only somebody who has the secret address of the page may read files of its owner
    place = "or name a folder of this machine, or a bundled cell: B0005"
    if st.get_option("server.baseUrlPath"):
        side.text_input(place, key="folder")
    folder = state.get("folder", "")
    is_one_cell = side.checkbox("all files are of one cell, the oldest first")
    cut_off_V = side.number_input("cut-off (V)", 0.5, value=None, placeholder="2.7, or that of my_cell.json", step=0.1)
    nominal_Ah = side.number_input("nominal capacity (Ah)", 0.001, value=None, placeholder="not known", step=0.1)
    start = side.selectbox("each discharge starts", (FULL, RESTED, KNOWN))
    soc = side.number_input("charge at the start (%)", 20.0, 100.0, 80.0, 5.0) / 100.0 if start == KNOWN else None
    side.caption("Computed on this machine. Its disk holds files only while they are read, its memory until the command ends.")
    columns = {each: name for each in UNITS if (name := state.get(f"column of {each}"))}
    units = {each: unit for each in UNITS if (unit := state.get(f"unit of {each}"))}
    stated = {"cut_off_V": cut_off_V, "nominal_Ah": nominal_Ah, "initial_soc": "rest" if start == RESTED else soc}
    stated = {name: value for name, value in stated.items() if value is not None}
    return files, folder, is_one_cell, FileFormat(columns, units, SIGNS[state.get("sign", RECOGNISED)]), stated


def ask_how_to_read(file: str, columns: list[str], recognised: str, is_wrong: bool) -> None:
    """Show a form for columns, units and sign of files, with the columns recognised in one file."""
    with st.expander(f"Is a file read wrongly? This is recognised of {file}", is_wrong), st.form("reading", border=False):
        st.code(recognised, None)
        for place, (quantity, units) in zip(st.columns(len(UNITS)), UNITS.items(), strict=True):
            options: dict[str, Any] = {"index": None, "accept_new_options": True}
            place.selectbox(f"{quantity}: column", columns, key=f"column of {quantity}", placeholder="as found", **options)
            place.selectbox("unit", units, key=f"unit of {quantity}", placeholder="as its name says", **options)
        st.selectbox("the current of a discharge is", list(SIGNS), key="sign")
        st.form_submit_button("Read again")
        st.caption(
            "This holds for all files. Of what messages name `--columns`, `--units` and `--discharge-is-negative` "
            "stand here, `--cut-off`, `--nominal` and `--initial-soc` at the left; `--cell` is my_cell.json."
        )


def recognised_of(path: Path, file_format: FileFormat) -> tuple[str, list[str], str]:
    """Return the name and the columns of a file, and the recognised columns as text."""
    table = open_file(path, file_format)
    columns = recognise(table.names, FileFormat(), table.rows)
    return path.name, list(dict.fromkeys(filter(None, table.names))), "\n".join(columns.lines())


def read(paths: list[str], file_format: FileFormat, troubles: list[str]) -> list[tuple[Source, Recording]]:
    """Read files, and keep the recognised columns of the first unreadable file, or of the first file."""
    recordings: list[tuple[Source, Recording]] = []
    unread: list[Source] = []
    sources, notes, error = attempt(find_sources, paths)
    troubles += [*notes, error]
    for source in sources or ():
        records, notes, error = attempt(read_source, source, file_format)
        name = Path(source.path).name
        troubles += [in_markdown(name, each.replace(f"{source.path}: ", "")) for each in (*notes, error) if each]
        recordings += [(source, each) for each in records or ()]
        unread += [source] if error else []
    for source in (*unread, *(sources or ())):
        table, *_ = attempt(recognised_of, Path(source.path), file_format)
        if table:  # a picture has no columns
            st.session_state.table = (*table, bool(unread))
            break
    return recordings


def in_markdown(name: str, text: str) -> str:
    """Return a message about a file as Markdown: a sentence, then lines and commands verbatim."""
    sentence, _, lines = text.partition("\n")
    return f"**{name}**: {sentence}" + (f"\n\n```text\n{lines}\n```" if lines else "")


def calibrate_files(files: list[Any], folder: str, is_one_cell: bool, file_format: FileFormat, stated: dict[str, Any]) -> None:
    """Calibrate all discharges with a progress bar; name unusable ones with their reasons."""
    state, bar = st.session_state, st.progress(0.0, "reading the files")
    state.results, state.lives, state.table = [], {}, None
    names = [Path(each.name).name for each in files]
    troubles = [f"**{each}**: only one of this name is used" for each in {*names} if names.count(each) > 1]
    with tempfile.TemporaryDirectory() as uploads:
        for name, each in zip(names, files, strict=True):
            Path(uploads, name).write_bytes(each.getvalue())
        dropped = [Path(uploads, name) for name in dict.fromkeys(names)]
        cells = [path for path in dropped if path.suffix == ".json"]
        state.settings, notes, error = attempt(settings_of, cells, stated)
        troubles += [*notes, error]
        paths = [str(each) for each in dropped if each not in cells] + [folder] * bool(folder)
        recordings = read(paths, file_format, troubles) if state.settings else []
    for number, (source, recording) in enumerate(recordings):
        name = record_name(source.stem, recording.meta.get("cycle"))
        bar.progress(number / len(recordings), f"{name}, {number + 1} of {len(recordings)}; the very first one takes longer")
        cell = no_formula(str(recording.meta.get("cell", "cell" if is_one_cell else source.cell)))
        calibrated, notes, error = attempt(calibrate_uploaded, name, cell, recording, state.settings)
        troubles += [in_markdown(name, each) for each in (*notes, error) if each]
        state.results += [calibrated] if calibrated else []
    if all(each.discharge.meta.get("start_time") for each in state.results):
        state.results.sort(key=lambda each: each.discharge.meta["start_time"])
    bar.empty()
    state.troubles = [each.replace(f"{uploads}{os.sep}", "") for each in dict.fromkeys(troubles) if each]


def settings_of(cells: list[Path], stated: dict[str, Any]) -> Settings:
    """Return the settings, with the constants of a cell if there is a file of them."""
    if len(cells) > 1:
        raise ValueError(f"{' and '.join(each.name for each in cells)} are constants of cells: drop those of one")
    return Settings.for_file(cells[0] if cells else None, **stated)


def calibrate_uploaded(name: str, cell: str, recording: Recording, settings: Settings) -> CalibratedDischarge:
    """Calibrate an uploaded discharge."""
    discharge = recording.discharge()
    return CalibratedDischarge(name, cell, discharge, calibrate_recording(discharge, recording, settings))


def show_numbers(calibration: Calibration) -> None:
    """Show the numbers of a discharge with their standard deviations."""
    *places, settled = st.columns(4)
    resistance = {"r_o": "R_o", "resistance_10s": "10 s resistance"}[calibration.resistance]
    columns = {"q_max": "q_mobile_C", resistance: f"{calibration.resistance}_ohm", "state of health": "state_of_health"}
    for place, (label, name) in zip(places, columns.items(), strict=True):
        sd = "" if np.isnan(getattr(calibration, name)) else f"sd {calibration.sd_of(name) or 'not stated'}"
        place.metric(label, calibration.shown(name), sd, "off", delta_arrow="off")
    in_part = f"only {calibration.settled_alone}" if calibration.settled_alone else ""
    settled.metric("settled", "yes" if calibration.settled else "no", in_part, "off", delta_arrow="off")
    if calibration.findings:
        st.error(f"Not settled: {calibration.reason}")


def over_the_life(table: pd.DataFrame, column: str, label: str, scale: float) -> go.Figure:
    """Plot a number of all cells over their discharges, with standard deviations; hollow without one if not settled."""
    figure = go.Figure(layout={"yaxis_title": label, "xaxis_title": "discharge", **LAYOUT})
    for colour, (cell, rows) in zip(qualitative.T10 * len(table), table.groupby("cell", sort=False), strict=False):
        number = rows["cycle"].fillna(pd.Series(range(1, len(rows) + 1), rows.index))
        settled = rows[f"settled_{column.rpartition('_')[0]}"].astype(bool)
        sd, symbol = rows[f"sd_{column}"].where(settled), np.where(settled, "circle", "circle-open")
        style = {"name": cell, "line_color": colour, "mode": "lines+markers", "error_y_thickness": 0.4, "error_y_width": 0}
        figure.add_scatter(x=number, y=scale * rows[column], error_y_array=scale * sd, marker_symbol=symbol, **style)
    return figure


def show_example() -> None:
    """Choose the example cell."""
    st.session_state.folder = EXAMPLE


def show_end(chosen: CalibratedDischarge, life: Life | None, settings: Settings) -> None:
    """Show the forecast of a discharge from a part of its record, with the voltage measured later."""
    st.subheader("When will it be empty?")
    left, right = st.columns(2)
    discharge, share = chosen.discharge, left.slider("seen (%)", 10, 100, 100 if chosen.calibration.in_progress else 60)
    load_A = right.number_input("load to come (A)", 0.001, value=None, placeholder="as so far", step=0.1)
    so_far = discharge.until(float(discharge.time_s[0] + share / 100.0 * np.ptp(discharge.time_s)))
    load = constant(load_A, "current") if load_A else None
    end, _, error = attempt(partial(forecast_end, life=life), so_far, settings, load)
    if error:
        st.error(error)
        return
    low, median, high = end.eod_quantile_s() / 60.0
    life_text = f" ({life.table['valid'].sum()} discharges, taken for the ones right before it, were known)" if life else ""
    st.markdown(f"**Empty at {median:.1f} min**, nine in ten from {low:.1f} to {high:.1f} min{life_text}")
    figure = go.Figure(layout={"xaxis_title": "time (min)", "yaxis_title": "voltage (V)", **LAYOUT})
    edge: dict[str, Any] = {"x": end.time_s / 60.0, "line_width": 0, "mode": "lines"}
    figure.add_scatter(y=end.voltage_V[0], showlegend=False, **edge)
    figure.add_scatter(y=end.voltage_V[2], fill="tonexty", fillcolor="rgba(76, 120, 168, 0.3)", name="voltage, 90 %", **edge)
    figure.add_scatter(x=edge["x"], y=end.voltage_V[1], line_color=qualitative.T10[0], mode="lines", name="voltage, median")
    loaded = discharge.loaded_part(settings.resolved.cut_off_V)
    figure.add_scatter(x=loaded.time_s / 60.0, y=loaded.voltage_V, line={"color": "#777777", "dash": "dot"}, name="measured")
    first, last = np.minimum([low, high], edge["x"][-1])
    figure.add_vrect(first, last, fillcolor=qualitative.T10[1], opacity=0.3, line_width=0, name="empty, 90 %", showlegend=True)
    figure.add_vline(x=end.now_s / 60.0, line_dash="dash", name="seen until here", showlegend=True)
    st.plotly_chart(figure)
    st.caption(f"Of the part that was seen: {' '.join(end.notes)}" if end.notes else "")


def main() -> None:
    """Show the page, from top to bottom."""
    st.set_page_config("battery-calibrate", layout="wide")
    st.title("How healthy is the cell, and when will it be empty?")
    answers, state = ask(), st.session_state
    if state.get("answers") != answers:
        calibrate_files(*answers)
        state.answers = answers
    if state.troubles:
        st.warning("\n\n".join(state.troubles))
    if state.table:
        ask_how_to_read(*state.table)
    results: list[CalibratedDischarge] = state.results
    if not results:
        st.info("Give discharges at the left (on a narrow screen behind »). The last one of a cell may be in progress.")
        st.button(f"Or show me a cell: the life of {EXAMPLE}, from NASA", on_click=show_example, type="primary")
        st.caption(
            "168 discharges in a minute or two: q_max and the resistance of each with a standard deviation, how both "
            "change over the life, and the forecast of an end."
        )
        return
    number = st.selectbox("discharge", range(len(results)), len(results) - 1, format_func=lambda n: results[n].name)
    chosen = results[number or 0]
    of_cell = [each for each in results if each.cell == chosen.cell]
    if len(of_cell) > 1 and chosen.cell not in state.lives:
        state.lives[chosen.cell] = attempt(life_before, [each.discharge for each in of_cell], state.settings).result
    life, earlier = state.lives.get(chosen.cell), [each.name for each in of_cell].index(chosen.name)
    life_before_it = attempt(life.after, earlier).result if life and earlier else None
    with_life = None
    if chosen.calibration.in_progress and life_before_it:
        with_life = attempt(partial(calibrate_running, life=life_before_it), chosen.discharge, state.settings).result
    table = pd.DataFrame({"record": each.name, "cell": each.cell} | each.calibration.row() for each in results)
    lives = table[table.groupby("cell")["cell"].transform("size") > 1]
    show_numbers(with_life or chosen.calibration)
    if with_life:
        numbers = [f"{label} {chosen.calibration.shown(name)}" for label, name in WITHOUT_LIFE.items()]
        st.caption(f"With the life of the cell before. This record alone: {', '.join(numbers)}, {chosen.calibration.state}.")
    if chosen.calibration.in_progress or st.toggle("Forecast its end from a part of it"):
        show_end(chosen, life_before_it, state.settings)
    if not lives.empty:
        left, right = st.columns(2)
        left.plotly_chart(over_the_life(lives, "q_mobile_C", "q_max (Ah)", 1.0 / 3600.0))
        right.plotly_chart(over_the_life(lives, "resistance_10s_ohm", "10 s resistance (mohm)", 1e3))
    short = [{label: each.calibration.shown(name, with_unit=False) for label, name in SHORT.items()} for each in results]
    settled = [each.calibration.state for each in results]
    st.dataframe(table[["record", "cell"]].join(pd.DataFrame(short)).assign(settled=settled), hide_index=True)
    st.download_button("the table with all columns as CSV", with_codes(table).to_csv(index=False), "estimate.csv", "text/csv")


if __name__ == "__main__":
    main()
