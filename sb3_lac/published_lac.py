"""The algorithm of Han et al. (2020): its critic, its policies, its replay buffer, and its update."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, polyak_update
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import Actor
from torch.nn import functional as F

from sb3_lac.buffers import SAMPLED_AT_ONCE, Samples
from sb3_lac.checks import check_rate
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.policies import CnnPolicy, LyapunovCritic, LyapunovPolicy, MultiInputPolicy, largest_value
from sb3_lac.updates import Metrics, backward


class SumOfSquaresCritic(LyapunovCritic):
    """
    Lyapunov critic of ``PublishedLAC``: ``L`` is the sum of the squares of the last layer's activations, the end of
    ``net_arch``. The arguments are those of ``LyapunovCritic``.
    """

    n_outputs = -1

    def __init__(
        self, observation_space: spaces.Space, action_space: spaces.Box, net_arch: list[int], *args: Any, **kwargs: Any
    ):
        if not net_arch:
            raise ValueError("net_arch must have a layer for the critic: L is the sum of its squares.")
        super().__init__(observation_space, action_space, net_arch, *args, **kwargs)

    def lyapunov_of(self, output: th.Tensor) -> th.Tensor:
        return output.square().sum(dim=1, keepdim=True)


class PublishedPolicy(LyapunovPolicy):
    """
    Policy class (with both actor and critic) for ``PublishedLAC``: the policy of LAC with a ``SumOfSquaresCritic``, a target
    actor, and the networks of Han et al. (2020). ``LyapunovPolicy`` describes the arguments that are not listed here.

    :param net_arch: Hidden layers of the actor (``pi``) and of the critic (``qf``); the critic squares its last layer
    :param n_critics: Number of Lyapunov critic networks to create, the largest of their values is used.
    """

    critic_class = SumOfSquaresCritic
    actor_target: Actor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        n_critics: int = 1,
        **kwargs: Any,
    ):
        net_arch = {"pi": [64, 64], "qf": [64, 64, 16]} if net_arch is None else net_arch
        super().__init__(observation_space, action_space, lr_schedule, net_arch, n_critics=n_critics, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        # Target networks should always be in eval mode
        self.actor_target.set_training_mode(False)


class PublishedCnnPolicy(CnnPolicy, PublishedPolicy):
    """``PublishedPolicy`` for image observations, with the arguments of ``CnnPolicy``."""


class PublishedMultiInputPolicy(MultiInputPolicy, PublishedPolicy):
    """``PublishedPolicy`` for dictionary observations, with the arguments of ``MultiInputPolicy``."""


class HorizonReplayBuffer(ReplayBuffer):
    """
    Return the sum of the rewards of ``horizon`` steps with each sampled transition, beginning with its own reward. After the
    end of an episode (time limit or termination) the last reward continues, as in the code of Han et al. (2020). The buffer
    does not sample the latest transitions before their horizon is over. If fewer steps than a horizon are stored, the buffer
    samples the oldest transition, and continues the latest reward.

    :param args: Arguments of ``ReplayBuffer``
    :param horizon: Number of steps in the sum of rewards
    :param kwargs: Arguments of ``ReplayBuffer``. ``optimize_memory_usage`` is not supported.
    """

    def __init__(self, *args: Any, horizon: int = 5, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.horizon = horizon
        if self.optimize_memory_usage:
            raise NotImplementedError("HorizonReplayBuffer doesn't support optimize_memory_usage=True")

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
        n_known = max(self.size() - self.horizon + 1, min(self.size(), 1))
        oldest = self.pos if self.full else 0
        return self._get_samples((oldest + np.random.randint(0, n_known, size=batch_size)) % self.buffer_size, env)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
        # Sample randomly the env idx
        env_indices = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        n_stored = min(self.horizon, self.size())
        steps = (batch_inds[:, None] + np.arange(n_stored)) % self.buffer_size
        # The step itself or, behind the end of its episode, the last one
        ends = self.dones[steps, env_indices[:, None]] > 0
        last = np.where(ends.any(axis=1), ends.argmax(axis=1), n_stored - 1)
        steps = (batch_inds[:, None] + np.minimum(np.arange(self.horizon), last[:, None])) % self.buffer_size
        rewards = self._normalize_reward(self.rewards[steps, env_indices[:, None]], env)
        dones = self.dones[batch_inds, env_indices] * (1 - self.timeouts[batch_inds, env_indices])
        return Samples(
            observations=self.to_torch(self._normalize_obs(self.observations[batch_inds, env_indices], env)),  # type: ignore[arg-type]
            actions=self.to_torch(self.actions[batch_inds, env_indices]),
            next_observations=self.to_torch(
                self._normalize_obs(self.next_observations[batch_inds, env_indices], env)  # type: ignore[arg-type]
            ),
            dones=self.to_torch(dones[:, None]),
            rewards=self.to_torch(rewards[:, :1]),
            discounts=None,
            horizon_rewards=self.to_torch(rewards.sum(axis=1, keepdims=True)),
        )


SAMPLED_AT_ONCE.add(HorizonReplayBuffer)


class PublishedLAC(CostAlgorithm):
    """
    Lyapunov Actor-Critic as published (Algorithm 1 of Han et al.)
    Actor-Critic Reinforcement Learning for Control with Stability Guarantee
    Paper: https://arxiv.org/abs/2004.14288, code: https://github.com/hithmh/Actor-critic-with-stability-guarantee

    .. code-block:: python

      from sb3_lac import PublishedLAC

      model = PublishedLAC("MlpPolicy", "CartPoleCost-v0", horizon=5, seed=0)
      model.learn(20_000)

    ``L(s, a)``, the sum of the squares of the critic's last layer, learns the discounted sum of costs or, with a ``horizon``,
    the plain sum of the next costs. The actor minimises ``lambda d + beta log pi``,
    ``d = L(s', pi(s')) - L(s, a) + alpha3 cost``.
    ``lambda`` grows while ``d`` is above zero, and ``beta`` (``ent_coef``) while the entropy is below its target.

    Defaults are those of the paper's table [P] or of the authors' code [C]. The authors' code has four differences: a time
    limit is a termination (``replay_buffer_kwargs=dict(handle_timeout_termination=False)``); all learning rates except that of
    ``lambda`` fall to zero (``LinearSchedule(rate, 0.0, 1.0)``); ``alpha3`` is 0.1; and ``lambda`` is clipped when read, so
    that its logarithm can wind up. With positive rewards, costs are those of ``LAC``.

    ``LAC`` describes the arguments that are not listed here. Their defaults are those of [P] (``batch_size``, ``tau``,
    ``target_entropy``, ``alpha3``) and of [C] (``buffer_size``, ``learning_starts``, ``train_freq``, ``gradient_steps``,
    ``lambda_init``, ``lambda_max``; ``lambda_min`` is 0 in the code, which a logarithm does not reach).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...), see ``PublishedPolicy`` for its networks [P]
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate of the actor and of ``ent_coef`` [P],
        it can be a function of the current progress remaining (from 1 to 0).
        A change of this rate, on a model or on loading, does not affect the rates of critic and ``lambda``.
    :param gamma: the discount factor [P]. 'auto' takes the environment's. Without effect if there is a ``horizon``.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer (not with a ``horizon``)
    :param ent_coef: Entropy regularization coefficient (``beta`` in the paper), 'auto_2' is learned from 2 on [C]
    :param horizon: Number of costs in the plain sum ``L``, 5 in four of the paper's five tasks [P]. ``None`` is the discounted
        sum of all costs. Not with dictionary observations.
    :param critic_learning_rate: learning rate of the critic [P], it can be a function of the current progress remaining
    :param lambda_learning_rate: learning rate of ``lambda`` [C], it can be a function of the current progress remaining
    :param kwargs: The other arguments of ``LAC``; ``n_steps`` is not of the paper, and not with a ``horizon``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": PublishedPolicy,
        "CnnPolicy": PublishedCnnPolicy,
        "MultiInputPolicy": PublishedMultiInputPolicy,
    }
    policy: PublishedPolicy
    actor_target: Actor

    def __init__(
        self,
        policy: str | type[PublishedPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 1000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float | str = 0.995,
        train_freq: int | tuple[int, str] = 100,
        gradient_steps: int = 80,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        ent_coef: str | float = "auto_2",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        alpha3: float = 1.0,
        horizon: int | None = None,
        critic_learning_rate: float | Schedule = 3e-4,
        lambda_learning_rate: float | Schedule = 1e-4,
        lambda_init: float = 1.0,
        lambda_min: float = 1e-4,
        lambda_max: float | None = None,
        reward_bound: float | None = None,
        compile_update: bool = False,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            alpha3=alpha3,
            lambda_init=lambda_init,
            lambda_min=lambda_min,
            lambda_max=lambda_max,
            lambda_learning_rate=lambda_learning_rate,
            reward_bound=reward_bound,
            compile_update=compile_update,
            optimize_memory_usage=optimize_memory_usage,
            **kwargs,
        )
        self.horizon = horizon
        self.critic_learning_rate = critic_learning_rate
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if self.horizon is not None:
            # A model that is loaded may have had no horizon before
            plain = self.replay_buffer_class in (None, ReplayBuffer)
            self.replay_buffer_class = HorizonReplayBuffer if plain else self.replay_buffer_class
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "horizon": self.horizon}
        super()._setup_model()

    def _create_aliases(self) -> None:
        super()._create_aliases()
        self.actor_target = self.policy.actor_target
        self.batch_norm_stats += get_parameters_by_name(self.actor, ["running_"])
        self.batch_norm_stats_target += get_parameters_by_name(self.actor_target, ["running_"])

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self.critic_lr_schedule = FloatSchedule(self.critic_learning_rate)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_rate("critic_learning_rate", self.critic_learning_rate)
        if self.horizon is None:
            if self.gamma == 1:
                raise ValueError("gamma must be smaller than 1 without a horizon: L would be an infinite sum.")
        elif isinstance(self.observation_space, spaces.Dict) or not issubclass(self.replay_buffer_class, HorizonReplayBuffer):  # type: ignore[arg-type]
            raise ValueError(f"horizon={self.horizon} needs a HorizonReplayBuffer, and observations that are no dictionaries.")
        elif not isinstance(self.horizon, (int, np.integer)) or self.horizon < 1:
            raise ValueError(f"horizon={self.horizon} must be a whole number of at least 1, or None.")

    def _adopt_replay_buffer(self) -> None:
        super()._adopt_replay_buffer()
        if self.horizon is not None:
            if not isinstance(self.replay_buffer, HorizonReplayBuffer):
                buffer = type(self.replay_buffer).__name__
                raise ValueError(f"horizon={self.horizon} needs a HorizonReplayBuffer, and this is a {buffer}.")
            self.replay_buffer.horizon = self.horizon

    @property
    def n_costs(self) -> float:
        return super().n_costs if self.horizon is None else self.horizon

    def _candidate(self, replay_data: Any, costs: th.Tensor) -> th.Tensor:
        """The Lyapunov candidate, the target of ``L``."""
        if self.horizon is not None:
            # A cost is the bound less the reward
            return self.horizon * (costs + replay_data.rewards) - replay_data.horizon_rewards
        discounts = self.gamma if replay_data.discounts is None else replay_data.discounts
        with th.no_grad():
            next_actions = self.actor_target(replay_data.next_observations)
            next_values = self.critic_target.lyapunov(replay_data.next_observations, next_actions)
            # After a termination, each step costs the bound
            next_values = (1 - replay_data.dones) * next_values + replay_data.dones * self.critic.offset
            return costs + discounts * next_values

    def _update(self, replay_data: Samples, costs: th.Tensor, update_targets: bool) -> Metrics:
        # We need to sample because `log_std` may have changed between two gradient steps
        if self.use_sde:
            self.actor.reset_noise()
            self.actor_target.reset_noise()

        # a~ for the sampled states
        _, log_prob = self.actor.action_log_prob(replay_data.observations)

        # J(L) = E 1/2 (L(s, a) - candidate)^2
        targets = self._candidate(replay_data, costs)
        current_values = self.critic(replay_data.observations, replay_data.actions)
        critic_loss = 0.5 * sum(F.mse_loss(values, targets) for values in current_values)
        assert isinstance(critic_loss, th.Tensor)  # for type checker

        # d = E[L(s', pi(s')) - L(s, a) + alpha3 cost], with a gradient through the next action
        values = largest_value(current_values).detach()
        next_values = self.critic.lyapunov(replay_data.next_observations, self.actor(replay_data.next_observations))
        violation = (next_values - values + self.alpha3 * costs).mean()

        # J(pi) = lambda d + beta E log pi(a~|s)
        lambda_coef, ent_coef = self._weights()
        actor_loss = lambda_coef * violation + ent_coef * log_prob.mean()

        # Optimize the critic and the actor, both with the gradient at the current parameters
        self.critic.optimizer.zero_grad()
        self.actor.optimizer.zero_grad()
        backward(critic_loss, self._parameters_of(self.critic))
        backward(actor_loss, self._parameters_of(self.actor))
        self.critic.optimizer.step()
        self.actor.optimizer.step()

        metrics = {
            "actor_loss": actor_loss,
            "critic_loss": critic_loss,
            "ent_coef": ent_coef,
            "lambda": lambda_coef,
            "lyapunov_difference": violation,
            "lyapunov_mean": values.mean(),
            "cost": costs.mean(),
            # J(lambda) = -log lambda d, J(beta) = -log beta E[log pi(a~|s) + target entropy]
            **self._update_multipliers(violation, log_prob),
        }

        # Update target networks
        if update_targets:
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
            # Copy running stats, see GH issue #996
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        with th.no_grad():
            return tuple(metrics), th.hstack(tuple(metrics.values()))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor_target"]
