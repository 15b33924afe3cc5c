"""The paper's tasks, whose agent observes the full state of a cell."""
