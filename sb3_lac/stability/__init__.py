"""Stability of the loop that a policy closes: Lyapunov functions learned, exact statements, estimates on other roll-outs."""

from sb3_lac.stability.certification import CertificationReport, certify
from sb3_lac.stability.fitting import FittedLyapunov, NoCostError, fit_lyapunov
from sb3_lac.stability.functions import CriticLyapunov, LyapunovFunction
from sb3_lac.stability.report import LyapunovReport, evaluate_lyapunov
from sb3_lac.stability.statistics import Interval

__all__ = [
    "CertificationReport",
    "CriticLyapunov",
    "FittedLyapunov",
    "Interval",
    "LyapunovFunction",
    "LyapunovReport",
    "NoCostError",
    "certify",
    "evaluate_lyapunov",
    "fit_lyapunov",
]
