"""What a Lyapunov function is to an evaluation: values of observations, and the costs that they belong to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from sb3_lac.cost_algorithm import CostAlgorithm

Observations = np.ndarray | dict[str, np.ndarray]
_NUMBER = (float, int, np.number)


class LyapunovFunction:
    """
    A known Lyapunov function, for instance from a Riccati equation. ``evaluate_lyapunov()`` and ``certify()`` judge it like a
    learned function.

    .. code-block:: python

      import gymnasium as gym
      from sb3_lac import LyapunovFunction, evaluate_lyapunov
      from sb3_lac.envs import reference_controller

      env = gym.make("LinearCost-v0")
      squares = LyapunovFunction(lambda states: (states**2).sum(axis=1))
      print(evaluate_lyapunov(reference_controller(env), env, lyapunov=squares, seed=0).summary())

    Costs are ``c = max(reward_bound - reward, 0)``, or ``c = -reward`` if no bound is given and no reward is positive. A
    fitted function has the thresholds of ``certify()``: ``ultimate_bound``, ``level`` and ``window_steps``. For any other
    function, set these attributes.

    :param function: Function of n observations of the policy that returns their values, an array of shape (n,)
    :param alpha3: Share of the cost by which the function is meant to decrease
    :param gamma: Discount factor of the estimated cost
    :param reward_bound: The reward without cost, needed if rewards are positive
    :raises ValueError: If a number is invalid
    """

    #: Whether costs are those of the training, in the units of ``VecNormalize``
    normalized_rewards = False
    #: Whether values depend on actions, and not on observations alone
    of_actions = False
    #: What is subtracted from the cost of each step in the sum that the function estimates, None if nothing is
    average_cost: float | None = None
    #: The cost that no step in the last fifth of an episode exceeds
    ultimate_bound: float | None = None
    #: Value above which the function falls
    level: float | None = None
    #: Number of steps within which it does
    window_steps: int | None = None
    #: Seeds of the environments that the function was fitted on, which no evaluation may use
    seeds: range | None = None

    def __init__(
        self,
        function: Callable[[Observations], np.ndarray],
        alpha3: float = 1.0,
        gamma: float = 1.0,
        reward_bound: float | None = None,
    ):
        if not (isinstance(alpha3, _NUMBER) and 0 < alpha3 < math.inf):
            raise ValueError(f"alpha3={alpha3!r} must be greater than 0, and finite.")
        if not (isinstance(gamma, _NUMBER) and 0 <= gamma <= 1):
            raise ValueError(f"gamma={gamma!r} must lie within 0 .. 1.")
        if reward_bound is not None and not (isinstance(reward_bound, _NUMBER) and 0 <= reward_bound < math.inf):
            raise ValueError(
                f"reward_bound={reward_bound!r} must be finite and at least 0, because nothing is paid after a termination, "
                "or None if no reward is positive."
            )
        self._function = function
        self.alpha3 = alpha3
        self.gamma = gamma
        self.reward_bound = reward_bound

    def values(self, observations: Observations) -> np.ndarray:
        """
        Evaluate the function.

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
        Evaluate the function where an action was taken.

        :param observations: n observations
        :param actions: n actions, which only the critic of LAC looks at
        :return: n values, shape (n,)
        """
        return self.values(observations)

    @contextmanager
    def in_units_of(self, vec_normalize: VecNormalize | None) -> Iterator[float]:
        """Let values and costs have the units of the rewards that are judged, and yield the one that costs nothing."""
        yield self.reward_bound or 0.0


class CriticLyapunov(LyapunovFunction):
    """
    The critic of LAC or PublishedLAC: ``L(s, pi(s))`` with the mean action of the policy.

    :param model: The model
    """

    normalized_rewards = True
    of_actions = True

    def __init__(self, model: CostAlgorithm):
        super().__init__(self._of_the_mean_action, model.alpha3, model.gamma, model.largest_reward.item())
        self.model = model

    def _of_the_mean_action(self, observations: Observations) -> np.ndarray:
        actions, _ = self.model.predict(observations, deterministic=True)
        return self.values_of_actions(observations, actions)

    def values_of_actions(self, observations: Observations, actions: np.ndarray) -> np.ndarray:
        return self.model.policy.predict_lyapunov(observations, actions)

    @contextmanager
    def in_units_of(self, vec_normalize: VecNormalize | None) -> Iterator[float]:
        offset = self.model.critic.offset.clone()
        bound = self.model.bound_in(vec_normalize)
        # The scale of normalized rewards may have changed since the last update
        bound.update_offset()
        try:
            yield bound.value.item()
        finally:
            # A report changes nothing of the model
            for critic in (self.model.critic, self.model.critic_target):
                critic.offset.copy_(offset)
