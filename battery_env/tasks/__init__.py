"""Calibration as tasks of Gymnasium: what is asked of a task, and its environments for one cell and for many."""
