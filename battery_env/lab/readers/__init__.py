"""Files of testers, in three steps: names of columns, tables, and the discharges in them."""
