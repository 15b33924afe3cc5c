"""``python -m battery_env`` is ``battery-calibrate``, see :mod:`battery_env.lab.command_line`."""

import sys

from battery_env.lab.command_line import calibrate

__all__ = ["calibrate"]

if __name__ == "__main__":
    sys.exit(calibrate())
