"""The study of what both parameters are, on a few discharges."""

import pandas as pd
import pytest

from benchmarks import parameters


@pytest.mark.attacks
def test_the_study_compares_estimates_with_what_was_measured(tmp_path, capsys):
    parameters.main(["--cells", "B0006", "--every", "167", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "resistances.csv")
    assert list(rows["cycle"]) == [1, 168]
    # worn by a fifth at least, whoever measures it
    new, worn = rows[["Re_ohm", "pulse_ohm", "kalman_r_o_ohm", "least_squares_r_o_ohm"]].to_numpy()
    assert (worn > 1.2 * new).all()
    assert (rows["error_to_3_V_percent"].abs() < 2.0 * rows["sd_to_3_V_percent"]).all()
    assert ((rows["kalman_pulse_ohm"] - rows["pulse_ohm"]).abs() < 0.02).all()
    assert "| B0006" in capsys.readouterr().out
