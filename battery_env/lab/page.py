"""The page for the bench, ``battery-calibrate page``: files in, q_max, R_o, health, life and the end of a discharge out."""

import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import streamlit as st

from battery_env.lab.batch import FileFormat, attempt
from battery_env.lab.calibrate import calibrate
from battery_env.lab.life import Life, track_life
from battery_env.lab.report import Calibration
from battery_env.lab.running import forecast_end
from battery_env.lab.settings import Settings
from battery_env.lab.sources import find_sources, no_formula, read_source, record_name
from battery_env.loads import constant
from battery_env.plotting import COLOURS
from battery_env.records.discharge import Discharge

LAYOUT = {"height": 330, "margin": {"t": 30, "b": 30}, "legend": {"orientation": "h", "y": -0.25}, "showlegend": True}


class Found(NamedTuple):
    """A discharge of one cell, and what it says."""

    name: str
    cell: str
    discharge: Discharge
    says: Calibration


def looked_at(name: str, cell: str, recording: Any, settings: Settings) -> Found:
    """What a discharge says."""
    return Found(name, cell, discharge := recording.discharge(), calibrate(discharge, settings))


def calibrated(paths: list[str], settings: Settings, one_cell: bool, troubles: list[str]) -> list[Found]:
    """What all discharges say, while a bar shows how far it is; what cannot be used is named with its reason."""
    bar, recordings, found = st.progress(0.0, "reading the files"), [], []
    sources, notes, _ = attempt(find_sources, paths)
    troubles += notes
    for source in sources:
        (read, notes, error), name = attempt(read_source, source, FileFormat()), Path(source.path).name
        troubles += [f"**{name}**: {each}".replace(f"{source.path}: ", "") for each in (*notes, error) if each]
        recordings += [(source, each) for each in read or ()]
    for number, (source, recording) in enumerate(recordings):
        name = record_name(source.stem, recording.meta.get("cycle"))
        bar.progress(number / len(recordings), f"{name}, {number + 1} of {len(recordings)}; the very first one takes longer")
        cell = no_formula(str(recording.meta.get("cell", "cell" if one_cell else source.cell)))
        seen, notes, error = attempt(looked_at, name, cell, recording, settings)
        troubles += [f"**{name}**: {each}" for each in (*notes, error) if each]
        found += [seen] if seen else []
    bar.empty()
    return found


def over_the_life(table: pd.DataFrame, column: str, label: str, scale: float) -> go.Figure:
    """A number of all cells over their discharges, with its standard deviation; what is not settled is hollow, without."""
    figure = go.Figure(layout={"yaxis_title": label, "xaxis_title": "discharge", **LAYOUT})
    for colour, (cell, rows) in zip(COLOURS * len(table), table.groupby("cell", sort=False), strict=False):
        number = rows["cycle"].fillna(pd.Series(range(1, len(rows) + 1), rows.index))
        settled = rows[f"settled_{column.rpartition('_')[0]}"].astype(bool)
        sd, symbol = rows[f"sd_{column}"].where(settled), np.where(settled, "circle", "circle-open")
        style = {"name": cell, "line_color": colour, "mode": "lines+markers", "error_y_thickness": 0.4, "error_y_width": 0}
        figure.add_scatter(x=number, y=scale * rows[column], error_y_array=scale * sd, marker_symbol=symbol, **style)
    return figure


def ahead(chosen: Found, life: Life | None, settings: Settings) -> None:
    """The end of a discharge of which a part was seen, beside what was measured later."""
    st.subheader("When will it be empty?")
    whole, share = chosen.discharge, st.slider("seen (%)", 10, 100, 100 if chosen.says.in_progress else 60)
    given_A = st.number_input("load to come (A); 0: as so far", 0.0, value=0.0, step=0.1)
    seen = whole.until(float(whole.time_s[0] + share / 100.0 * np.ptp(whole.time_s)))
    load, count = constant(given_A, "current") if given_A else None, life.table["valid"].sum() if life else 0
    end, _, error = attempt(partial(forecast_end, life=life), seen, settings, load)
    if error:
        st.error(error)
        return
    low, median, high = end.eod_quantile_s() / 60.0
    st.markdown(f"**Empty at {median:.1f} min**, nine in ten from {low:.1f} to {high:.1f} min ({count} earlier discharges)")
    figure = go.Figure(layout={"xaxis_title": "time (min)", "yaxis_title": "voltage (V)", **LAYOUT})
    edge: dict[str, Any] = {"x": end.time_s / 60.0, "line_width": 0, "mode": "lines"}
    figure.add_scatter(y=end.voltage_V[0], showlegend=False, **edge)
    figure.add_scatter(y=end.voltage_V[2], fill="tonexty", fillcolor="rgba(0, 114, 178, 0.3)", name="voltage, 90 %", **edge)
    figure.add_scatter(x=edge["x"], y=end.voltage_V[1], line_color=COLOURS[0], mode="lines", name="voltage, median")
    figure.add_scatter(x=whole.time_s / 60.0, y=whole.voltage_V, line={"color": "#777777", "dash": "dot"}, name="measured")
    first, last = np.minimum([low, high], edge["x"][-1])
    figure.add_vrect(first, last, fillcolor=COLOURS[1], opacity=0.3, line_width=0, name="empty, 90 %", showlegend=True)
    figure.add_vline(x=end.now_s / 60.0, line_dash="dash", name="seen until here", showlegend=True)
    st.plotly_chart(figure)
    st.caption(f"Of the part that was seen: {' '.join(end.notes)}" if end.notes else "")


def main() -> None:
    """The page, from top to bottom."""
    st.set_page_config("battery-calibrate", layout="wide")
    st.title("How worn is the cell, and when is it empty?")
    files: Any = st.sidebar.file_uploader("Drop the files of your tester", accept_multiple_files=True)
    folder = st.sidebar.text_input("or name a folder of this machine, or a bundled cell: B0005")
    one_cell = st.sidebar.checkbox("all files are of one cell, the oldest first")
    cut_off_V = st.sidebar.number_input("cut-off (V)", 0.5, value=2.7, step=0.1)
    nominal_Ah = st.sidebar.number_input("nominal capacity (Ah); 0: not known", 0.0, value=0.0, step=0.1)
    st.sidebar.caption("Computed on this machine, and nothing is stored: closing the page forgets all of it.")
    settings, state = Settings(cut_off_V=cut_off_V, nominal_Ah=nominal_Ah or None), st.session_state
    asked = [each.file_id for each in files], folder, one_cell, settings
    if state.get("asked") != asked:
        names, state.lives = [Path(each.name).name for each in files], {}
        state.troubles = [f"**{each}**: only one of this name is used" for each in {*names} if names.count(each) > 1]
        with tempfile.TemporaryDirectory() as given:
            for name, each in zip(names, files, strict=True):
                Path(given, name).write_bytes(each.getvalue())
            state.found = calibrated([each for each in (files and given, folder) if each], settings, one_cell, state.troubles)
        state.troubles, state.asked = [each.replace(f"{given}/", "") for each in dict.fromkeys(state.troubles)], asked
    if state.troubles:
        st.warning("\n\n".join(state.troubles))
    found: list[Found] = state.found
    if not found:
        st.info("Give discharges at the left. Each starts with a full cell at rest; the last one may be in progress.")
        return
    chosen = found[st.selectbox("discharge", range(len(found)), len(found) - 1, format_func=lambda n: found[n].name) or 0]
    says, (q_max, r_o, health, settled) = chosen.says, st.columns(4)
    q_max.metric("q_max", says.shown("q_mobile_C"), f"sd {says.sd_of('q_mobile_C') or 'not stated'}", "off", delta_arrow="off")
    r_o.metric("R_o", says.shown("r_o_ohm"), f"sd {says.sd_of('r_o_ohm') or 'not stated'}", "off", delta_arrow="off")
    health.metric("state of health", says.shown("state_of_health"), help="give the nominal capacity at the left")
    settled.metric("settled", says.state.removesuffix(" settled").replace("settled", "yes"))
    if says.reason:
        st.error(f"Not settled: {says.reason}")
    table = pd.DataFrame({"record": each.name, "cell": each.cell} | each.says.row() for each in found)
    left, right = st.columns(2)
    left.plotly_chart(over_the_life(table, "q_mobile_C", "q_max (Ah)", 1.0 / 3600.0))
    right.plotly_chart(over_the_life(table, "r_o_ohm", "R_o (mohm)", 1e3))
    of_cell = [each for each in found if each.cell == chosen.cell]
    if len(of_cell) > 1 and chosen.cell not in state.lives:
        state.lives[chosen.cell] = attempt(track_life, [each.discharge for each in of_cell], cut_off_V).result
    life, earlier = state.lives.get(chosen.cell), [each.name for each in of_cell].index(chosen.name)
    ahead(chosen, attempt(life.after, earlier).result if life and earlier else None, settings)
    st.dataframe(table)
    st.download_button("the table as CSV", table.to_csv(index=False), "estimate.csv", "text/csv")


if __name__ == "__main__":
    main()
