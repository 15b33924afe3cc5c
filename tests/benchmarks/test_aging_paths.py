"""The study of paths judges each cell by the path of the other one, and writes what it finds."""

import pandas as pd

from benchmarks import aging_paths


def test_the_study_writes_its_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(aging_paths, "CELLS", {"B0005": "B0006"})
    aging_paths.main(["--every", "80", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "discharges.csv")
    of_path = rows[rows["method"] == "least squares, path of B0006"]
    assert len(rows) == 3 * (3 * len(aging_paths.SHARES) - 2) and set(rows["cell"]) == {"B0005"}
    assert of_path["error_percent"].abs().max() < 8.0 and of_path["q_error_percent"].abs().max() < 8.0
    assert not of_path[of_path["share"] < 1.0]["settled"].any()
    assert "| B0005" in capsys.readouterr().out and (tmp_path / "ends.png").stat().st_size > 0
