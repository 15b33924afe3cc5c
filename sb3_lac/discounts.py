import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th

#: The discount factor of an environment that states none.
DEFAULT_DISCOUNT = 0.99


def stated_discount(metadata: Sequence[Any]) -> float:
    """The discount factor that environments state as ``metadata["discount"]``, for how far to look ahead is part of a task."""
    known = [of_env if isinstance(of_env, Mapping) else {} for of_env in metadata]
    stated = [of_env.get("discount", DEFAULT_DISCOUNT) for of_env in known]
    for discount in stated:
        if not isinstance(discount, (float, int, np.number)) or not 0 <= discount <= 1:
            raise ValueError(
                f"The environment states metadata['discount']={discount!r}, which must be a number within 0 .. 1: mend it, or "
                f"set gamma, for instance gamma={DEFAULT_DISCOUNT}."
            )
        if discount != stated[0]:
            different = [of_env.get("discount", "none") for of_env in known]
            raise ValueError(f"The environments state different discounts, {different}: set gamma.")
    return float(stated[0]) if stated else DEFAULT_DISCOUNT


def sum_of_discounts(gamma: float, horizon: int | None) -> float:
    """How often a constant cost counts in ``L``."""
    return 1 / (1 - gamma) if horizon is None else math.fsum(gamma**k for k in range(horizon))


def weight_of_return(discounts: th.Tensor | None, gamma: float) -> th.Tensor | float:
    """How often a constant reward counts in the return of k steps: ``1 + gamma + ... + gamma^(k-1)``."""
    return 1.0 if discounts is None else (1 - discounts) / (1 - gamma)
