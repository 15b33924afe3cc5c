"""The study of real cells of other kinds, on the cell with the fewest discharges."""

import pandas as pd
import pytest

from benchmarks import other_cells
from benchmarks.other_cells import CELLS, full_discharges


def test_each_later_discharge_is_asked_at_each_share_and_what_is_refused_counts(tmp_path, capsys):
    asked = ["--cells", "lg_hg2_nmc_18650_3Ah", "--jobs", "1", "--out", str(tmp_path)]
    other_cells.main(asked)
    rows, text = pd.read_csv(tmp_path / "other_cells.csv"), (tmp_path / "other_cells.md").read_text(encoding="utf-8")
    assert rows["share"].tolist() == [0.25, 0.5, 0.75] and rows["discharge"].unique() == [2]
    # both discharges are at 3 A, so that the charge and the duration of the first one say the same
    assert rows["count_error_percent"].to_numpy() == pytest.approx(rows["as_long_error_percent"].to_numpy(), abs=0.3)
    assert "| LG HG2, NMC, 3 Ah | 1 " in text and text in capsys.readouterr().out
    other_cells.main([*asked, "--redraw"])
    assert (tmp_path / "other_cells.md").read_text(encoding="utf-8") == text
    refused = other_cells.summary(rows.assign(error_percent=rows["error_percent"].where(rows["share"] > 0.3)))
    assert refused["refused"].tolist() == ["1"]


def test_cells_start_full_and_reach_their_cut_off():
    for name, cell in CELLS.items():
        records = full_discharges(name)
        rest_V = [each.voltage_V[0] for each in records]
        assert len(records) > 1 and max(rest_V) - min(rest_V) < 0.1, name
        assert all(each.eod_time_s(cell.cut_off_V) > each.load_on_time_s for each in records), name
