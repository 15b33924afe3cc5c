"""The study of forecasts, on a few discharges."""

from pathlib import Path

import pandas as pd
import pytest

from battery_env.records.discharge import load_nasa_discharges
from benchmarks import forecasts
from benchmarks.study import table_file


@pytest.mark.attacks
def test_the_study_writes_its_tables(monkeypatch, tmp_path, capsys):
    records = load_nasa_discharges("B0005")[:2]
    monkeypatch.setattr(forecasts, "load_nasa_discharges", lambda cell: records)
    for name, value in {"SEEDS": {0: "B0005"}, "SHARES": (0.75,), "FITTED": (0, 1), "BEFORE": 2, "SAMPLES": 50}.items():
        monkeypatch.setattr(forecasts, name, value)
    forecasts.main(["--cells", "B0005", "--simulated", "1", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "discharges.csv")
    assert len(rows) == (1 + len(forecasts.LOADS)) * (len(forecasts.BASELINES) + 5) + len(forecasts.LOADS)
    error = rows.set_index(["load", "method"])["error_percent"].abs()
    # at the load of the last one all that carry something on are right, and at another one a clock is wrong
    assert error["2 A"].drop([forecasts.OF_SIZE, forecasts.NO_LIFE, forecasts.NOTHING]).max() < 5.0
    assert error[:, forecasts.FORECAST].max() < 10.0 < error["1 A, then 4 A", "as long as the last"]
    assert "| B0005" in capsys.readouterr().out and (tmp_path / "summary.md").stat().st_size > 0


def test_published_intervals_of_nine_of_ten_hold_where_life_and_load_are_known():
    rows = pd.read_csv(table_file(Path("docs/results/forecasts"), "discharges")).set_index("method")
    # at another load of most cells by the constants of a new one, and of all by constants that were fitted
    fitted = pd.concat([rows.loc[forecasts.OWN_FIT], rows.loc[forecasts.FORECAST].query("load == '2 A'")])
    covered = fitted.groupby(["data", "load"])["covered"].mean()
    assert len(covered) == 8 and covered.min() > 0.85 < rows.loc[forecasts.FORECAST, "covered"].mean()
    # they are no wider than the end may be off: at the load of a life by little
    assert fitted[fitted["load"] == "2 A"]["width_percent"].max() < 10.0 and fitted["width_percent"].median() < 15.0


@pytest.mark.attacks
def test_the_life_that_remains_is_compared_with_the_measured_one():
    published = pd.read_csv(table_file(Path("docs/results/real_cells"), "discharges"))
    # the second half of its life
    table = published[published["cell"] == "B0005"][84:].reset_index(drop=True).assign(reason="", valid=True, lasted_share=1.0)
    life = forecasts.Life(table, 0.0, 0.0, 0.0, None, None).after(len(table))
    rows = pd.DataFrame(forecasts.life_rows("B0005", life))
    ended = int((table["capacity_Ah"] < forecasts.END_OF_LIFE_Ah).to_numpy().argmax()) + 1
    assert (rows["seen"] + rows["remaining"] == ended).all()
    assert ((rows["low"] <= rows["median"]) & (rows["median"] <= rows["high"])).all()
    summary = forecasts.life_table({"B0005": life}, rows)
    assert list(summary["cell"]) == ["B0005"]
