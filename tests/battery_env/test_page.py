"""The page for the bench, in Streamlit's test of pages."""

import io
import signal
import socket
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from battery_env import NEW_CELL, Settings, calibrate, load_nasa_discharges, read_discharges
from battery_env import __file__ as package
from battery_env.lab.life import life_before
from battery_env.lab.running import forecast_end
from tests.records import table_of

pytest.importorskip("streamlit")
pytest.importorskip("plotly")
AppTest = pytest.importorskip("streamlit.testing.v1").AppTest

PAGE = Path(package).parent / "lab" / "page.py"
LIFE = load_nasa_discharges("B0005")[96:100]


def csv(discharge):
    return table_of(discharge).to_csv(index=False)


def show_one_cell(page, folder):
    """Name a folder whose files are all of one cell, of 2 Ah."""
    page.sidebar.checkbox[0].check()
    page.sidebar.number_input[1].set_value(2.0)
    page.sidebar.text_input[0].set_value(str(folder)).run()


@pytest.fixture
def folder(tmp_path):
    for number, discharge in enumerate(LIFE):
        (tmp_path / f"{number}.csv").write_text(csv(discharge), encoding="utf-8")
    (tmp_path / "notes.csv").write_text("who,what\nme,tea\n", encoding="utf-8")
    return tmp_path


@pytest.fixture(autouse=True)
def _same_program(monkeypatch):
    """Streamlit leaves its page as the program, which workers that other tests start would run."""
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])


@pytest.fixture
def page(monkeypatch):
    monkeypatch.setattr("streamlit.get_option", lambda name: "secret")  # as in an address that has one
    shown = AppTest.from_file(str(PAGE), default_timeout=120).run()
    assert not shown.exception and "Give discharges" in shown.info[0].value
    return shown


def numbers(shown):
    assert not shown.exception
    return {metric.label: metric.value for metric in shown.metric}


def end_min(shown):
    (text,) = (each.value for each in shown.markdown if each.value.startswith("**Empty"))
    return [float(word) for word in text.replace("**", "").split() if word.replace(".", "").isdecimal()][:3]


def test_a_folder_of_one_cell_shows_its_numbers_its_life_and_the_end_of_a_discharge_in_progress(folder, page):
    show_one_cell(page, folder)
    says = calibrate(folder / "3.csv", nominal_Ah=2.0)[0]
    assert numbers(page) == {
        "q_max": f"{says.q_mobile_C / 3600.0:.3f} Ah",
        "10 s resistance": f"{1e3 * says.resistance_10s_ohm:.1f} mohm",
        "state of health": f"{says.state_of_health:.3f}",
        "settled": "yes",
    }
    assert [each.value.partition(":")[0] for each in page.warning] == ["**notes.csv**"] and not page.error
    assert len(page.get("plotly_chart")) == 2
    assert page.dataframe[0].value["record"].tolist() == ["0", "1", "2", "3"]
    assert page.dataframe[0].value["cell"].nunique() == 1

    # at 60 % of the record the discharges before tell its end to a percent
    page.toggle[0].set_value(True).run()
    assert len(page.get("plotly_chart")) == 3
    true_min = LIFE[3].eod_time_s(2.7) / 60.0
    median, low, high = end_min(page)
    assert low < true_min < high and high - low < 0.03 * true_min and median == pytest.approx(true_min, rel=0.01)
    # a larger load is sooner over
    page.main.number_input[0].set_value(3.0).run()
    assert end_min(page)[0] < 0.95 * median


def test_a_discharge_in_progress_has_the_one_health_of_its_life_and_its_own_in_small_print(folder, page):
    (folder / "3.csv").write_text(csv(LIFE[3].until(LIFE[3].time_s[0] + 1500.0)), encoding="utf-8")
    show_one_cell(page, folder)
    settings = Settings(nominal_Ah=2.0)
    running = read_discharges(folder / "3.csv")[0]
    end = forecast_end(running, settings, life=life_before(LIFE[:3], settings))
    health = float(numbers(page)["state of health"])
    assert health == pytest.approx(np.median(end.state_of_health), abs=5e-3)
    (small,) = (each.value for each in page.caption if "This record alone" in each.value)
    assert f"state of health {calibrate(running, settings).shown('state_of_health')}" in small


@pytest.mark.parametrize("name", ["picture", "charge", "milliamperes"])
def test_a_file_is_answered_as_the_command_answers_it(name, page, terminal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    time_s = np.arange(0.0, 5000.0, 10.0)
    charge = pd.DataFrame({"time": time_s, "voltage": 3.2 + time_s / 5e3, "current": -1.5})
    whole = pd.DataFrame({"time": LIFE[0].time_s, "voltage": LIFE[0].voltage_V, "current": 1e3 * LIFE[0].current_A})
    content = {
        "picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
        "charge": charge.to_csv(index=False).encode(),
        "milliamperes": whole.to_csv(index=False).encode(),
    }[name]
    Path("a.csv").write_bytes(content)
    said = terminal.refuses("a.csv").partition(": ")[2].partition(": ")[2]
    page.sidebar.file_uploader[0].set_value([("a.csv", content, "text/csv")]).run()
    assert not page.exception
    shown = page.warning[0].value.replace("```text", "").replace("```", "")
    assert " ".join(shown.split()) == f"**a.csv**: {said}" or " ".join(shown.split()) == f"**a**: {said}"


def test_the_first_screen_has_a_cell_to_press_for(page, monkeypatch):
    asked = []
    monkeypatch.setattr("battery_env.lab.sources.load_nasa_discharges", lambda name: asked.append(name) or LIFE)
    (button,) = page.main.button
    button.click().run()
    assert asked == ["B0005"] and len(page.dataframe[0].value) == len(LIFE) and page.sidebar.text_input[0].value == "B0005"


def test_without_a_settled_number_the_page_says_why(folder, page):
    short = LIFE[3].until(LIFE[3].time_s[0] + 1200.0)
    for path in folder.glob("*.csv"):
        path.unlink()
    (folder / "running.csv").write_text(csv(short), encoding="utf-8")
    page.sidebar.text_input[0].set_value(str(folder)).run()
    assert numbers(page)["settled"] != "yes" and numbers(page)["state of health"] == "not known"
    assert page.error[0].value.startswith("Not settled: ") and page.slider[0].value == 100
    _, low, high = end_min(page)
    assert np.isfinite([low, high]).all() and low > 20.0


def test_files_are_dropped_and_nothing_is_stored(page, tmp_path_factory, monkeypatch):
    kept = tmp_path_factory.mktemp("temporary")
    monkeypatch.setenv("TMPDIR", str(kept))
    monkeypatch.setattr("tempfile.tempdir", None)
    files = [("a.csv", csv(LIFE[0]).encode(), "text/csv"), ("b.bin", io.BytesIO(b"\0\1").read(), "application/octet-stream")]
    files.append(("a.csv", csv(LIFE[0]).encode(), "text/csv"))
    page.sidebar.file_uploader[0].set_value(files).run()
    assert page.dataframe[0].value["record"].tolist() == ["a"] and "q_max" in numbers(page)
    assert any("b.bin" in each.value and "**a.csv**: only one of this name is used" in each.value for each in page.warning)
    assert list(kept.iterdir()) == []


def test_columns_units_sign_start_and_constants_are_stated_where_a_file_does_not_tell_them(page, tmp_path):
    discharge = LIFE[0]
    columns = {"alpha": discharge.time_s / 60.0, "beta": discharge.voltage_V, "gamma": -1e3 * discharge.current_A}
    odd = ("odd.csv", pd.DataFrame(columns).to_csv(index=False).encode(), "text/csv")
    page.sidebar.file_uploader[0].set_value([odd]).run()
    assert page.warning[0].value.startswith("**odd.csv**: no column for the time, the voltage, the current")
    assert "alpha, beta, gamma" in page.code[0].value and page.expander[0].proto.expanded
    for quantity, column, unit in (("time", "alpha", "min"), ("voltage", "beta", "V"), ("current", "gamma", "mA")):
        page.selectbox(key=f"column of {quantity}").set_value(column)
        page.selectbox(key=f"unit of {quantity}").set_value(unit)
    page.selectbox(key="sign").set_value("negative")
    next(each for each in page.button if each.label == "Read again").click().run()
    said_Ah = float(numbers(page)["q_max"].split()[0])
    assert said_Ah == pytest.approx(calibrate(discharge).q_mobile_C / 3600.0, abs=2e-3) and not page.warning
    # one discharge that is over has no life, and its end only on asking
    assert not page.subheader and not page.get("plotly_chart")
    page.toggle[0].set_value(True).run()
    assert [each.value for each in page.subheader] == ["When will it be empty?"] and len(page.get("plotly_chart")) == 1

    cell = replace(NEW_CELL, r_o=0.2).to_json(tmp_path / "my_cell.json").read_bytes()
    page.sidebar.file_uploader[0].set_value([odd, ("my_cell.json", cell, "application/json")])
    page.sidebar.selectbox[0].set_value("with a known charge").run()
    says = calibrate(discharge, cell=replace(NEW_CELL, r_o=0.2), initial_soc=0.8)
    assert numbers(page)["q_max"] == says.shown("q_mobile_C") and not page.warning
    assert float(numbers(page)["state of health"]) == pytest.approx(says.state_of_health, abs=2e-3)
    (health,) = (each for each in page.metric if each.label == "state of health")
    assert health.delta == f"sd {says.sd_of('state_of_health')}"
    page.sidebar.file_uploader[0].set_value([odd, ("my_cell.json", b"{}", "application/json")]).run()
    assert page.warning[0].value.startswith("my_cell.json") and page.info


def test_whoever_starts_the_page_without_a_secret_address_offers_no_folder():
    shown = AppTest.from_file(str(PAGE), default_timeout=120).run()
    assert shown.info and not shown.sidebar.text_input


def test_without_streamlit_the_command_says_what_to_install(monkeypatch, terminal):
    monkeypatch.setattr("battery_env.lab.command_line.find_spec", lambda name: None)
    assert "pip install './battery_env[page]'" in terminal.refuses("page")


def test_the_page_opens_without_a_question_and_answers_nobody_without_its_address(start_page):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        page = start_page(taken.getsockname()[1])
        assert page.port > taken.getsockname()[1]
    assert page.opened() == page.address.rstrip("/")
    assert page.answer("/_stcore/health", page.token) == 200
    for path in ("/", "/_stcore/health", "/_stcore/stream", "/_stcore/upload_file/a/b"):
        assert page.answer(path) == 404
    own = f"127.0.0.1:{page.port}"
    stream = {
        (own, f"http://{own}"): 101,
        ("evil.example", f"http://{own}"): 403,
        (own, "http://evil.example"): 403,
        ("evil.example", "http://evil.example"): 403,  # of a name that leads here
    }
    for (host, origin), status in stream.items():
        upgrade = {"Host": host, "Origin": origin, "Connection": "Upgrade", "Upgrade": "websocket"}
        key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version": "13"}
        assert page.answer("/_stcore/stream", page.token, upgrade | key) == status, (host, origin)
    page.leave_a_file()
    page.ends_by(signal.SIGKILL)
    assert page.left() == []
