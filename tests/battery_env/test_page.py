"""The page for the bench, in Streamlit's test of pages."""

import io
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from battery_env import __file__ as package
from battery_env import calibrate, load_nasa_discharges
from battery_env.__main__ import calibrate as command

pytest.importorskip("streamlit")
pytest.importorskip("plotly")
AppTest = pytest.importorskip("streamlit.testing.v1").AppTest

PAGE = Path(package).parent / "lab" / "page.py"
LIFE = load_nasa_discharges("B0005")[96:100]


def csv(discharge):
    columns = {"time_s": discharge.time_s, "voltage_V": discharge.voltage_V, "current_A": discharge.current_A}
    return pd.DataFrame(columns).to_csv(index=False)


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
def page():
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
    page.sidebar.checkbox[0].check()
    page.sidebar.number_input[1].set_value(2.0)
    page.sidebar.text_input[0].set_value(str(folder)).run()
    says = calibrate(folder / "3.csv", nominal_Ah=2.0)[0]
    assert numbers(page) == {
        "q_max": f"{says.q_mobile_C / 3600.0:.3f} Ah",
        "R_o": f"{1e3 * says.r_o_ohm:.1f} mohm",
        "state of health": f"{says.state_of_health:.3f}",
        "settled": "yes",
    }
    assert [each.value.partition(":")[0] for each in page.warning] == ["**notes.csv**"] and not page.error
    assert len(page.get("plotly_chart")) == 3
    assert page.dataframe[0].value["record"].tolist() == ["0", "1", "2", "3"]
    assert page.dataframe[0].value["cell"].nunique() == 1

    # at 60 % of the record the discharges before tell its end to a percent
    true_min = LIFE[3].eod_time_s(2.7) / 60.0
    median, low, high = end_min(page)
    assert low < true_min < high and high - low < 0.03 * true_min and median == pytest.approx(true_min, rel=0.01)
    # a larger load is sooner over
    page.main.number_input[0].set_value(3.0).run()
    assert end_min(page)[0] < 0.95 * median


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


def test_files_are_dropped_and_nothing_is_stored(folder, page, tmp_path_factory, monkeypatch):
    kept = tmp_path_factory.mktemp("temporary")
    monkeypatch.setenv("TMPDIR", str(kept))
    monkeypatch.setattr("tempfile.tempdir", None)
    files = [("a.csv", csv(LIFE[0]).encode(), "text/csv"), ("b.bin", io.BytesIO(b"\0\1").read(), "application/octet-stream")]
    files.append(("a.csv", csv(LIFE[0]).encode(), "text/csv"))
    page.sidebar.file_uploader[0].set_value(files).run()
    assert page.dataframe[0].value["record"].tolist() == ["a"] and "q_max" in numbers(page)
    assert any("b.bin" in each.value and "**a.csv**: only one of this name is used" in each.value for each in page.warning)
    assert list(kept.iterdir()) == []


def test_a_name_that_is_nearly_a_command_is_no_file(capsys):
    assert command(["forcast", "x.csv"]) == 2
    assert "did you mean battery-calibrate forecast?" in capsys.readouterr().err


def test_the_command_opens_the_page_on_this_machine_only(monkeypatch):
    called = []
    monkeypatch.setattr("subprocess.run", lambda words, **_: called.append(words) or type("Done", (), {"returncode": 0}))
    assert command(["page", "--port", "8600"]) == 0
    assert called[0][1:5] == ["-m", "streamlit", "run", str(PAGE)]
    assert called[0][called[0].index("--server.address") + 1] == "localhost" and "8600" in called[0]
    monkeypatch.setattr("battery_env.lab.command_line.find_spec", lambda name: None)
    assert command(["page"]) == 2 and len(called) == 1
