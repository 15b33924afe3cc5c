"""Records as a tester writes them, made of simulated ones or of others."""

import numpy as np
import pandas as pd

from battery_env import Discharge


def recorded(record, rows=slice(None), noise_V=0.0, seed=0, **known):
    """Rows of a record, with noise of the voltage, and what is ``known`` of a discharge beside its columns."""
    voltage_V = record.voltage_V + np.random.default_rng(seed).normal(0.0, noise_V, len(record.voltage_V))
    return Discharge(record.time_s[rows], voltage_V[rows], record.current_A[rows], **known)


def table_of(record, **more):
    """A record as a table with the names of this package, and more columns."""
    columns = {"time_s": record.time_s, "voltage_V": record.voltage_V, "current_A": record.current_A}
    return pd.DataFrame(columns | more)
