"""Is the learned ``L`` a certificate? Statistics of the decrease condition along roll-outs of a policy."""

from sb3_lac.stability.report import LyapunovReport, evaluate_lyapunov
from sb3_lac.stability.statistics import Interval

__all__ = ["Interval", "LyapunovReport", "evaluate_lyapunov"]
