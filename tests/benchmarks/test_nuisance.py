"""The comparison with and without nuisance constants runs end to end."""

import json

import pandas as pd
import pytest

from benchmarks import nuisance


def test_it_writes_a_table(tmp_path, capsys):
    nuisance.main(["--discharges", "2", "--every", "900", "--jobs", "1", "--out", str(tmp_path)])
    scores = pd.read_csv(tmp_path / "nuisance.csv")
    assert len(scores) == 2 * 2 * 3
    noisy = scores[scores["sensor"] == "5 mV noise"].groupby("calibrator")["q_mobile_second_half_mape_percent"].mean()
    assert noisy["with nuisance constants"] < 0.5 * noisy["two parameters"]
    assert json.loads((tmp_path / "nuisance.json").read_text())["configuration"]["mismatch"] == [0.2]
    assert "| 0.2 " in capsys.readouterr().out


@pytest.mark.parametrize("extra", [["--discharges", "301"], ["--every", "0"], ["--mismatch", "0.6"]])
def test_bad_numbers_are_refused(extra, tmp_path, capsys):
    with pytest.raises(SystemExit):
        nuisance.main([*extra, "--out", str(tmp_path)])
    assert "--discharges must lie within 1 .. 300" in capsys.readouterr().err
