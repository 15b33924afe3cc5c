"""The study of forecasts, on a few discharges."""

import pandas as pd

from battery_env.cells import load_nasa_discharges
from benchmarks import forecasts


def test_the_study_writes_its_tables(monkeypatch, tmp_path, capsys):
    records = load_nasa_discharges("B0005")[:2]
    monkeypatch.setattr(forecasts, "load_nasa_discharges", lambda cell: records)
    monkeypatch.setattr(forecasts, "SEEDS", (0,))
    monkeypatch.setattr(forecasts, "SHARES", (0.75,))
    forecasts.main(["--cells", "B0005", "--simulated", "1", "--samples", "50", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "discharges.csv")
    assert len(rows) == 2 + 2 * 2
    carried = rows[rows["calibrator"] == "least squares, prior carried on"].iloc[0]
    assert abs(carried["error_percent"]) < 5.0 and carried["covered"]
    assert rows[rows["load"] == "known"]["error_percent"].abs().max() < 10.0
    assert "| B0005" in capsys.readouterr().out and (tmp_path / "summary.md").stat().st_size > 0


def test_the_life_that_remains_is_compared_with_the_measured_one(tmp_path):
    published = pd.read_csv("docs/results/real_cells/discharges.csv")
    # the second half of its life
    table = published[published["cell"] == "B0005"][84:].reset_index(drop=True).assign(reason="")
    life = forecasts.Life(table, 0.0, 0.0, 0.0, None, None).after(len(table))
    rows = pd.DataFrame(forecasts.life_rows("B0005", life))
    ended = int((table["capacity_Ah"] < forecasts.END_OF_LIFE_Ah).to_numpy().argmax()) + 1
    assert (rows["seen"] + rows["remaining"] == ended).all()
    assert ((rows["low"] <= rows["median"]) & (rows["median"] <= rows["high"])).all()
    summary = forecasts.life_table({"B0005": life}, rows)
    assert list(summary["cell"]) == ["B0005"]
