"""Tasks whose agent sees measured voltages and currents only."""
