from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_lac.buffers import Samples
from sb3_lac.cost_algorithm import CostAlgorithm
from sb3_lac.policies import CnnPolicy, LyapunovPolicy, MlpPolicy, MultiInputPolicy, RootCritic, largest_value
from sb3_lac.updates import Metrics, backward


class LAC(CostAlgorithm):
    """
    Lyapunov Actor-Critic (LAC), a soft actor-critic that minimises a cost
    Actor-Critic Reinforcement Learning for Control with Stability Guarantee,
    This implementation uses the SB3 SAC implementation as base.
    Paper: https://arxiv.org/abs/2004.14288

    LAC differs from the published algorithm, ``PublishedLAC``. Two critics learn a root of the difference between ``L`` and
    its lowest value, so that small costs count next to large costs; the published critic learns ``L`` itself, as a sum of
    squares. The actor minimises the square root of ``L`` in the sampled states; the published actor minimises the condition on
    ``L`` in the next states. Targets use the mean action of the actor; published targets use actions sampled from a target
    actor.

    .. code-block:: python

      from sb3_lac import LAC

      model = LAC("MlpPolicy", "CartPoleCost-v0", seed=0)
      model.learn(20_000)
      model.save("lac_cart_pole")

    Give costs as they are, ``reward = -cost``, and give a failure its price. Choose the discount, the learning rate and the
    number of steps; leave ``alpha3``, the multipliers and ``ent_coef`` at their defaults. LAC underestimates rare, large
    costs: use SAC.

    The critic ``L(s, a) >= 0`` is the discounted sum of costs. ``L`` has to decrease by ``alpha3`` times the cost in each
    step. The Lagrange multiplier ``lambda`` weighs this condition, and ``ent_coef`` keeps the entropy up as in SAC.

    Note: the cost is ``bound - reward`` with the largest reward as ``bound`` (stated or seen, at least 0). After a termination
    all future rewards are 0, so that with positive rewards it costs ``bound`` per step.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate for adam optimizer,
        the same learning rate will be used for all networks (Lyapunov critic and actor) and for ``ent_coef``,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor. 'auto' takes ``metadata["discount"]`` of the environment, or 0.99 if the environment
        states no discount
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``)
        Set to ``-1`` means to do as many gradient steps as steps done in the environment
        during the rollout.
    :param action_noise: the action noise type (None by default), this can help
        for hard exploration problem. Cf common.noise for the different action noise type.
    :param replay_buffer_class: Replay buffer class to use (for instance ``HerReplayBuffer``).
        If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer
        at a cost of more complexity.
        See https://github.com/DLR-RM/stable-baselines3/issues/37#issuecomment-637501195
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) for the critic and the condition.
        Note: it is only used when ``replay_buffer_class`` is ``None``, and is not supported for Dict
        observation spaces yet.
    :param ent_coef: Entropy regularization coefficient (``beta`` in the paper).
        It is learned from 0.1 on; 'auto' starts at 1, as SAC does, 'auto_0.01' at 0.01. A number is kept.
    :param target_update_interval: update the target networks every ``target_update_interval``
        gradient steps.
    :param target_entropy: target entropy when learning ``ent_coef``
    :param alpha3: Share of the cost by which ``L`` has to decrease in each step. From 1 on the condition cannot hold
        in stationary data: ``lambda`` then stays at ``lambda_max``, a fixed weight of the cost. It may fall while ``L`` does.
    :param lambda_init: Initial value of ``lambda``, which is kept within the limits
    :param lambda_min: Lower limit of ``lambda`` (with ``lambda`` at zero, the actor would only maximise its entropy)
    :param lambda_max: Upper limit of ``lambda``. If ``None``, it is 1, or ``lambda_init`` if that is larger.
    :param lambda_learning_rate: learning rate for ``lambda``, can be a function of the current progress remaining.
        If ``None``, it is ``learning_rate``.
    :param reward_bound: Largest reward that the environment can pay (before ``VecNormalize``), at least 0. If a larger
        reward is seen, or if ``None``, it is the largest one seen. ``gamma`` must be below 1 with a bound above 0.
    :param compile_update: Whether to compile each update to one graph (``torch.compile``), on a GPU a CUDA graph. Compiling
        needs torch 2.11, and takes half a minute to minutes at the first update and after a change of a constant like
        ``batch_size``. With hooks, an optimizer with its own ``step()``, or an untested torch (above 2.13), LAC does not
        compile updates, and warns.
    :param check_observations: Whether to refuse an observation that is not finite, or beyond 1.8e19. ``False`` is for a
        features extractor that handles such numbers: NaN as a missing reading, inf as nothing in range.
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling
        during the warm up phase (before learning starts)
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation. See ``LyapunovPolicy``
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    critic: RootCritic
    critic_target: RootCritic

    def __init__(
        self,
        policy: str | type[LyapunovPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float | str = "auto",
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto_0.1",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        alpha3: float = 1.0,
        lambda_init: float = 1.0,
        lambda_min: float = 1e-4,
        lambda_max: float | None = None,
        lambda_learning_rate: float | Schedule | None = None,
        reward_bound: float | None = None,
        compile_update: bool = False,
        check_observations: bool = True,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
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
            check_observations=check_observations,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
        )
        if _init_setup_model:
            self._setup_model()

    def _target_values(self, replay_data: Any, next_actions: th.Tensor) -> th.Tensor:
        """Return the targets whose root the critic learns: values of ``L``, relative to its offset."""
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        with th.no_grad():
            # Compute the next Lyapunov values: max over all critics targets, never negative
            next_roots = largest_value(self.critic_target.outputs(replay_data.next_observations, next_actions))
            next_values = th.maximum(self.critic_target.value(next_roots), -self.critic_target.offset)
            # td error, without entropy term. In terminal states nothing is paid any more, so that L is the offset:
            # y = (bound - reward) + gamma * ((1 - done) * (next_value + offset) + done * offset),
            # where bound + gamma * offset = offset is left out on both sides
            return -replay_data.rewards + (1 - replay_data.dones) * discounts * next_values

    def _objective(self, roots: th.Tensor) -> th.Tensor:
        """Return the loss of the actor, given the roots at its actions."""
        return self.critic.distance(roots).mean()

    def _update(self, replay_data: Samples, costs: th.Tensor, update_targets: bool) -> Metrics:
        # We need to sample because `log_std` may have changed between two gradient steps
        if self.use_sde:
            self.actor.reset_noise()

        # Action by the current actor for the sampled state
        actions_pi, log_prob = self.actor.action_log_prob(replay_data.observations)

        with th.no_grad():
            # Next action of the loop that is to be judged, the mean one. A root resolves differences far below the noise
            # of a sampled one, and takes it for a cost
            next_actions = self.actor(replay_data.next_observations, deterministic=True)

        # Compute critic loss, with the current root of each critic network
        # using action from the replay buffer (all values are relative to the offset)
        target_values = self._target_values(replay_data, next_actions)
        # The metric follows the values as the target critic follows the critic
        self.critic.follow(target_values, self.tau)
        target_roots = self.critic.root(target_values)
        current_roots = self.critic.outputs(replay_data.observations, replay_data.actions)
        critic_loss = 0.5 * sum(F.mse_loss(current_root, target_roots) for current_root in current_roots)
        assert isinstance(critic_loss, th.Tensor)  # for type checker

        # Compute the violation of the decrease condition, where the episode goes on:
        # L(s', a') <= L(s, a) - alpha3 * cost, in the metric of the objective
        roots = largest_value(current_roots).detach()
        with th.no_grad():
            next_roots = largest_value(self.critic.outputs(replay_data.next_observations, next_actions))
            allowed_roots = self.critic.root(self.critic.value(roots) - self.alpha3 * costs)
            difference = self.critic.distance(next_roots) - self.critic.distance(allowed_roots)
            going_on = 1 - replay_data.dones
            violation = (going_on * difference).sum() / going_on.sum().clamp(min=1)

        # Compute actor loss: the Lagrangian of the decrease condition and of the entropy constraint
        lambda_coef, ent_coef = self._weights()
        objective = self._objective(largest_value(self.critic.outputs(replay_data.observations, actions_pi)))
        actor_loss = lambda_coef * objective + ent_coef * log_prob.mean()

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
            "lyapunov_mean": self.critic.lyapunov_of(roots).mean(),
            "cost": costs.mean(),
            **self._update_multipliers(violation, log_prob),
        }

        # Update target networks
        if update_targets:
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            self.critic_target.floor.lerp_(self.critic.floor, self.tau)
            self.critic_target.scale.copy_(self.critic.scale)
            # Copy running stats, see GH issue #996
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        with th.no_grad():
            return tuple(metrics), th.hstack(tuple(metrics.values()))
