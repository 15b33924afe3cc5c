"""Calibration as tasks of Gymnasium: the tasks, and their environments for one cell and for many."""
