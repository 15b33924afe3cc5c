"""LAC, the Lyapunov Actor-Critic, for Stable-Baselines3, and the evaluation of what it learned."""

from pathlib import Path

import sb3_lac.envs  # noqa: F401  (registers the ids of the cost environments)
from sb3_lac.callbacks import CertificateCallback, LyapunovCallback
from sb3_lac.dashboard import DashboardCallback
from sb3_lac.lac import LAC
from sb3_lac.policies import CnnPolicy, LyapunovPolicy, MlpPolicy, MultiInputPolicy
from sb3_lac.published_lac import PublishedLAC, PublishedPolicy
from sb3_lac.stability import FittedLyapunov, LyapunovFunction, LyapunovReport, certify, evaluate_lyapunov, fit_lyapunov
from sb3_lac.vec_env import GymnasiumVecEnv

# Gymnasium does not import third-party environments by itself:
# importing battery_env here makes ``LAC("MlpPolicy", "BatteryQmax-v0")`` work when it is installed
try:
    import battery_env  # noqa: F401
except ModuleNotFoundError as error:
    # Only its own absence is fine, a broken installation must be seen
    if error.name != "battery_env":
        raise

__version__ = Path(__file__).with_name("version.txt").read_text(encoding="utf-8").strip()

__all__ = [
    "LAC",
    "CertificateCallback",
    "CnnPolicy",
    "DashboardCallback",
    "FittedLyapunov",
    "GymnasiumVecEnv",
    "LyapunovCallback",
    "LyapunovFunction",
    "LyapunovPolicy",
    "LyapunovReport",
    "MlpPolicy",
    "MultiInputPolicy",
    "PublishedLAC",
    "PublishedPolicy",
    "__version__",
    "certify",
    "evaluate_lyapunov",
    "fit_lyapunov",
]
