"""``python -m battery_env``, see :mod:`battery_env.lab.command_line`."""

import sys

from battery_env.lab.command_line import calibrate, main

__all__ = ["calibrate", "main"]

if __name__ == "__main__":
    sys.exit(main())
