from contextlib import suppress
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

#: The discount factor of an environment that states none.
DEFAULT_DISCOUNT = 0.99


def stated_discount(env: VecEnv | None) -> float:
    """The discount factor that environments state as ``metadata["discount"]``, for how far to look ahead is part of a task."""
    metadata: list[Any] = []
    # There may be no environment, and a vector environment of somebody else may have no attributes
    with suppress(AttributeError, NotImplementedError):
        metadata = env.get_attr("metadata")  # type: ignore[union-attr]
    stated = [(each or {}).get("discount", DEFAULT_DISCOUNT) for each in metadata] or [DEFAULT_DISCOUNT]
    if any(discount != stated[0] for discount in stated):
        raise ValueError(f"The environments state different discounts, {stated}: set gamma.")
    return stated[0]
