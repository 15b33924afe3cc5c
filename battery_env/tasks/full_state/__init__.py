"""Tasks whose agent sees the whole state of a cell, as the paper has it."""
