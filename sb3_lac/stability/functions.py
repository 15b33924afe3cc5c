"""What a Lyapunov function is to an evaluation: values of observations, and the costs that they belong to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac.lac import LAC

if TYPE_CHECKING:
    import pandas as pd

Observations = np.ndarray | dict[str, np.ndarray]


class LyapunovFunction:
    """
    A Lyapunov function of a closed loop, as ``evaluate_lyapunov()`` and ``certify()`` take it. One that is known, for instance
    from a Riccati equation, is judged like one that was learned:

    .. code-block:: python

      quadratic = LyapunovFunction(lambda states: np.einsum("ni,ij,nj->n", states, P, states))
      evaluate_lyapunov(controller, env, lyapunov=quadratic)

    Costs are ``c = max(reward_bound - reward, 0)``, or ``c = -reward`` if no bound is given and no reward is positive.

    :param function: Values, an array of shape (n,), of n observations as the policy sees them
    :param alpha3: Share of the cost by which the function is meant to decrease
    :param gamma: Discount factor of the costs to come that it estimates
    :param horizon: Number of steps whose costs it estimates, None for all to come
    :param average_cost: What is subtracted from the cost of each step in the sum that it estimates, None if it estimates none
    :param reward_bound: The reward that costs nothing, needed where rewards are positive
    :param seeds: Seeds of the environments that it was learned on, if it was: no evaluation may use them
    :raises ValueError: If one of these numbers cannot be meant
    """

    #: Whether costs are those of the training, in the units of ``VecNormalize``
    normalized_rewards = False
    #: Whether values depend on actions, and not on observations alone
    of_actions = False

    def __init__(
        self,
        function: Callable[[Observations], np.ndarray],
        alpha3: float = 1.0,
        gamma: float = 1.0,
        horizon: int | None = None,
        average_cost: float | None = None,
        reward_bound: float | None = None,
        seeds: range | None = None,
    ):
        if not isinstance(alpha3, (float, int, np.number)) or not 0 < alpha3 < math.inf:
            raise ValueError(f"alpha3={alpha3!r} must be greater than 0, and finite.")
        if not isinstance(gamma, (float, int, np.number)) or not 0 <= gamma <= 1:
            raise ValueError(f"gamma={gamma!r} must lie within 0 .. 1.")
        if horizon is not None and (not isinstance(horizon, (int, np.integer)) or horizon < 1):
            raise ValueError(f"horizon={horizon!r} must be a whole number of at least 1, or None for all costs to come.")
        if average_cost is not None and not (
            isinstance(average_cost, (float, int, np.number)) and math.isfinite(average_cost)
        ):
            raise ValueError(
                f"average_cost={average_cost!r} must be finite, or None if the function estimates no sum of costs."
            )
        if reward_bound is not None and not (
            isinstance(reward_bound, (float, int, np.number)) and 0 <= reward_bound < math.inf
        ):
            raise ValueError(
                f"reward_bound={reward_bound!r} must be finite and at least 0, because nothing is paid after a termination, "
                "or None if no reward is positive."
            )
        self._function = function
        self.alpha3 = alpha3
        self.gamma = gamma
        self.horizon = horizon
        self.average_cost = average_cost
        self.reward_bound = reward_bound
        self.seeds = seeds

    def values(self, observations: Observations) -> np.ndarray:
        """
        The values of observations.

        :param observations: n observations as the policy sees them (normalized, if ``VecNormalize`` does so)
        :return: n values, shape (n,)
        :raises ValueError: If there is not one finite value for each observation
        """
        values = np.asarray(self._function(observations), dtype=np.float64)
        first = next(iter(observations.values())) if isinstance(observations, dict) else observations
        if values.shape != (len(first),):
            raise ValueError(f"The values have shape {values.shape}, and must be one for each of {len(first)} observations.")
        if not np.isfinite(values).all():
            raise ValueError(
                f"{np.sum(~np.isfinite(values))} of {len(values)} values of the Lyapunov function are not finite."
            )
        return values

    def values_of_actions(self, observations: Observations, actions: np.ndarray) -> np.ndarray:
        """
        The values of observations in which an action was taken.

        :param observations: n observations
        :param actions: n actions, which only the critic of LAC looks at
        :return: n values, shape (n,)
        """
        return self.values(observations)

    def cost_bound(self, vec_normalize: VecNormalize | None) -> float:
        """
        The reward that costs nothing.

        :param vec_normalize: Wrapper that the rewards come from, if any
        :return: The bound in the units of the rewards that are judged
        """
        return self.reward_bound or 0.0

    @contextmanager
    def in_units_of(self, vec_normalize: VecNormalize | None) -> Iterator[None]:
        """
        Let the values belong to the rewards that are judged.

        :param vec_normalize: Wrapper that these rewards come from, if any
        """
        yield


def check_function(lyapunov: object) -> None:
    """"""
    if not isinstance(lyapunov, LyapunovFunction):
        raise ValueError(
            f"lyapunov={lyapunov!r} must be a LyapunovFunction: that of fit_lyapunov(policy, env), or "
            "LyapunovFunction(function) for a function of observations."
        )


def check_rewards(lyapunov: LyapunovFunction | None, rewards: pd.Series) -> None:
    """"""
    if rewards.max() > 0 and (lyapunov is None or lyapunov.reward_bound is None):
        raise ValueError(
            f"A reward of {rewards.max():g} is positive, and it is not known which reward costs nothing: pass "
            "LyapunovFunction(..., reward_bound=...) or that of fit_lyapunov(policy, env)."
        )


class CriticLyapunov(LyapunovFunction):
    """
    The critic of LAC: ``L(s, pi(s))`` with the mean action of the policy.

    :param model: The LAC model
    """

    normalized_rewards = True
    of_actions = True

    def __init__(self, model: LAC):
        bound = model.reward_bound.item()
        super().__init__(self._of_the_mean_action, model.alpha3, model.gamma, reward_bound=bound)
        self.model = model

    def _of_the_mean_action(self, observations: Observations) -> np.ndarray:
        actions, _ = self.model.predict(observations, deterministic=True)
        return self.values_of_actions(observations, actions)

    def values_of_actions(self, observations: Observations, actions: np.ndarray) -> np.ndarray:
        return self.model.policy.predict_lyapunov(observations, actions)

    def cost_bound(self, vec_normalize: VecNormalize | None) -> float:
        return self.model.cost_bound(vec_normalize).item()

    @contextmanager
    def in_units_of(self, vec_normalize: VecNormalize | None) -> Iterator[None]:
        offset = self.model.critic.offset.clone()
        # The scale of normalized rewards may have changed since the last update
        self.model.update_offset(vec_normalize)
        try:
            yield
        finally:
            # A report changes nothing of the model
            for critic in (self.model.critic, self.model.critic_target):
                critic.offset.copy_(offset)
