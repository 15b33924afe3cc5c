"""What speaks against an estimate: a table of conditions, and the evidence of samples, gaps and the rest before a load."""

from battery_env.estimators.diagnosis.conditions import Condition as Condition
