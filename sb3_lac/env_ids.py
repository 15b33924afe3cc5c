from importlib.util import find_spec

import gymnasium as gym


def check_env_id(env_id: str) -> None:
    """
    Refuse the id of a battery environment where battery_env is not installed: Gymnasium only says that it does not know it.
    """
    of_batteries = env_id.startswith(("Battery", "battery_env:"))
    # Without an origin it is a folder without code: uninstalling leaves compiled kernels behind
    if of_batteries and env_id not in gym.registry and getattr(find_spec("battery_env"), "origin", None) is None:
        raise gym.error.NameNotFound(
            f"There is no environment '{env_id}': those of batteries come with battery_env, which is not installed. "
            "Run pip install ./battery_env in a checkout of sb3_lac."
        )
