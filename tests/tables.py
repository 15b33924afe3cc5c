"""A recorded discharge as a table, and what is read of it."""

import warnings

import numpy as np
import pandas as pd
import pytest

from battery_env import load_nasa_discharges, read_discharges

RECORD = load_nasa_discharges("B0006")[99]
TABLE = pd.DataFrame({"time": RECORD.time_s, "voltage": RECORD.voltage_V, "current": -RECORD.current_A})
LOADED = (TABLE["current"] < -1.0).to_numpy()


def read(table, said="", **options):
    """Return the one discharge of a table, and check what is said of it; nothing by default."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (discharge,) = read_discharges(table, **options)
    messages = "; ".join(str(each.message) for each in caught)
    assert (said in messages) if said else not messages, messages
    return discharge


def near(discharge, share=2e-3):
    assert discharge.charge_C == pytest.approx(RECORD.charge_C, rel=share)
    assert (np.diff(discharge.time_s) > 0.0).all()


def same(discharge, temperature=False):
    for name in ("time_s", "voltage_V", "current_A"):
        np.testing.assert_allclose(getattr(discharge, name), getattr(RECORD, name), atol=1e-6)
    if temperature:
        np.testing.assert_allclose(discharge.temperature_C, RECORD.temperature_C, atol=1e-3)
    else:
        assert discharge.temperature_C is None


def clock(seconds):
    return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{seconds % 60:06.3f}"
