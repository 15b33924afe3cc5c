"""The study of cells of other equations, on cells of our own, and the lives that PyBaMM simulates."""

import numpy as np
import pandas as pd
import pytest

from battery_env import NEW_CELL, simulate
from benchmarks import pybamm_cells
from benchmarks.pybamm_cells import FIT, LIFE, SHARES, SimulatedLife, varies
from tests.records import recorded


def life(name, seed, numbers=range(12), surroundings_C=25.0):
    rng, made = np.random.default_rng(seed), []
    for n in numbers:
        load = 2.0 if not varies(n) else np.repeat(rng.uniform(0.7, 3.0, 300), 60)
        made.append(simulate(load, 7000.0 - 60.0 * n, 0.1 + 0.003 * n, load_unit="current", cell=NEW_CELL.replace(VEOD=2.4)))
    return SimulatedLife([recorded(each, slice(None, None, 5)) for each in made], 2.7, 2.0)


@pytest.mark.attacks
def test_what_is_known_of_a_cell_brings_its_end_nearer(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(pybamm_cells, "simulated", life)
    monkeypatch.setattr(pybamm_cells, "FITTED", (0, 7, 10))
    monkeypatch.setattr(pybamm_cells, "MOVED", 8)
    asked = ["--cells", "Ai2020", "--seeds", "1", "--jobs", "1", "--out", str(tmp_path)]
    pybamm_cells.main(asked)
    rows = pd.read_csv(tmp_path / "pybamm_cells.csv")
    # discharges 6, 8, 9 and 11 are tested
    assert len(rows) == 4 * (1 + 4 * len(SHARES)) and rows["varies"].sum() == 1 + 4 * len(SHARES)
    ends = rows[rows["share"] < 1.0]
    assert ends["inside"].all() and rows["settled"].dropna().all()
    narrow, wide = (ends[ends["knows"] == each] for each in (LIFE, FIT))
    assert (narrow["high_percent"] - narrow["low_percent"]).max() < 0.5 * (wide["high_percent"] - wide["low_percent"]).max()
    assert narrow["error_percent"].abs().max() < 2.0
    # cells here are the same at all temperatures
    surroundings = pd.read_csv(tmp_path / "surroundings.csv")
    assert len(surroundings) == 4 and surroundings["q_mobile_percent"].abs().max() < 0.1
    text = (tmp_path / "pybamm_cells.md").read_text()
    assert "| Enertech, LCO, 2.3 Ah | the fit " in text and text in capsys.readouterr().out
    pybamm_cells.main([*asked, "--redraw"])
    assert (tmp_path / "pybamm_cells.md").read_text() == text


def test_lives_wear_out_and_are_drawn_from_their_seed():
    pytest.importorskip("pybamm")
    lives = [pybamm_cells.simulated("Ai2020", seed, range(5)) for seed in (0, 0, 1)]
    charges_C = [each.charge_C for each in lives[0].discharges if not np.ptp(each.current_A[each.current_A > 0.0]) > 0.5]
    assert len(charges_C) == 4 and (np.diff(charges_C) < 0.0).all()
    cold, warm = (pybamm_cells.simulated("Marquis2019", 0, [0], other_C).discharges[0] for other_C in (5.0, 35.0))
    assert cold.temperature_C[0] == pytest.approx(5.0) and cold.charge_C < warm.charge_C
    again, other = (np.array_equal(each.discharges[3].voltage_V, lives[0].discharges[3].voltage_V) for each in lives[1:])
    assert again and not other
