"""The study of identifiability: the facts that its page states, and the page against the published tables."""

import json
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import identifiability as measure

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "docs" / "results" / "identifiability"


# without noise, these are the same whenever they are made
@pytest.mark.parametrize("name", ["conservation", "response", "sensitivity", "bounds", "late", "windows", "minima"])
def test_what_is_computed_is_what_is_published(name):
    (found,) = measure.part(name, draws=0).values()
    published = pd.read_csv(PUBLISHED / f"{name}.csv")
    pd.testing.assert_frame_equal(found, published, check_dtype=False, rtol=1e-4, atol=1e-9)


def test_a_filter_that_knows_of_the_offset_is_not_misled_by_it():
    table = measure.offsets_table(measure.discharges()).set_index(["load", "offset_sd_V", "seen_percent"])
    assert abs(table["q_mobile_error_percent"]["varying", 0.0, 25.0]) > 3.0
    assert table.xs(measure.OFFSET_V, level="offset_sd_V").abs().to_numpy().max() < 1.0


@pytest.fixture
def brief(monkeypatch):
    monkeypatch.setattr(measure, "FINE_SHARES", measure.SHARES)
    few = ("voltage read 10 mV too high", "kn of the cell 20 % lower", "R_o held 10 % too low", "q_max held 5 % too high")
    monkeypatch.setattr(measure, "FAULTS", {name: measure.FAULTS[name] for name in few})
    monkeypatch.setattr(measure, "PRIORS", {"none": None, "right, sd 1 %": (1.0, 0.01)})


def test_the_study_writes_tables_and_figures(brief, tmp_path, capsys):
    measure.main(["--draws", "2", "--jobs", "1", "--out", str(tmp_path)])
    names = {path.name for path in PUBLISHED.iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == names | {"parts"}
    assert json.loads((tmp_path / "bounds.json").read_text())["configuration"]["draws"] == 2
    assert (tmp_path / "summary.md").read_text(encoding="utf-8") in capsys.readouterr().out
    least_squares = pd.read_csv(tmp_path / "least_squares.csv")
    assert len(least_squares) == 2 * 2 * 4 and (least_squares["q_mobile_rms_percent"] < 20.0).all()
    faults = pd.read_csv(tmp_path / "faults.csv").set_index(["load", "fault", "seen_percent"]).sort_index()
    held = faults["q_mobile_error_percent"]["constant", "R_o held 10 % too low"]
    assert held[50.0] < -10.0 and abs(held[100.0]) < 1.0
    assert faults["q_mobile_error_percent"]["constant", "q_max held 5 % too high"].isna().all()


def cells(line):
    return tuple(cell.strip() for cell in line.strip().strip("|").split("|"))


def rows(page):
    return [cells(line) for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]


def test_every_row_of_the_page_is_in_the_published_tables():
    shown, published = rows(ROOT / "docs/reports/identifiability.md"), set(rows(PUBLISHED / "summary.md"))
    assert len(shown) >= 6
    assert [row for row in shown if row not in published] == []
