import math
from contextlib import nullcontext
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, polyak_update, update_learning_rate
from stable_baselines3.sac.policies import Actor
from torch.nn import functional as F

from sb3_lac.compiled import CompiledUpdate, Metrics, check_compiler, set_gradients, step, update_multiplier
from sb3_lac.costs import CostAlgorithm
from sb3_lac.discounts import stated_discount
from sb3_lac.policies import CnnPolicy, LyapunovCritic, LyapunovPolicy, MlpPolicy, MultiInputPolicy, largest_value

SelfLAC = TypeVar("SelfLAC", bound="LAC")


class LAC(CostAlgorithm):
    """
    Lyapunov Actor-Critic (LAC), a soft actor-critic for tasks with a cost
    Actor-Critic Reinforcement Learning for Control with Stability Guarantee,
    This implementation uses the SB3 SAC implementation as base.
    Paper: https://arxiv.org/abs/2004.14288

    .. code-block:: python

      from sb3_lac import LAC

      model = LAC("MlpPolicy", "CartPoleCost-v0", seed=0)
      model.learn(20_000)
      model.save("lac_cart_pole")

    Pay costs as they are, ``reward = -cost``, and let a failure have its price. Choose the discount, the learning rate and the
    number of steps; leave ``alpha3``, the multipliers and ``ent_coef`` at their defaults. Take SAC where chance decides on
    rare events that cost a lot: a mean of roots underrates them.

    The critic ``L(s, a) >= 0`` is the discounted sum of costs. Its networks learn the fourth root of what it is above its
    lowest value, in which small costs count beside large ones, and the actor lowers the square root. ``L`` has to decrease by
    ``alpha3`` times the cost in each step: a Lagrange multiplier ``lambda`` enforces that, while ``ent_coef`` keeps the
    entropy up as in SAC.

    Note: the cost is ``bound - reward``, where ``bound`` is the largest reward (stated or seen, at least 0). A termination
    pays 0 for ever after, and so costs ``bound`` per step where rewards are positive.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate for adam optimizer,
        the same learning rate will be used for all networks (Lyapunov critic and actor) and for ``ent_coef``,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor. 'auto' is the one that the environment states as ``metadata["discount"]``,
        or 0.99 if it states none
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
        Set it to 'auto' to learn it automatically (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target networks every ``target_update_interval``
        gradient steps.
    :param target_entropy: target entropy when learning ``ent_coef`` (``ent_coef = 'auto'``)
    :param published_update: Whether to update as the paper does: the actor lowers ``L`` in the states that follow the
        sampled ones instead of in these, and the critic's target has the action of a target actor.
    :param alpha3: Share of the cost by which ``L`` has to decrease in each step. From 1 on the condition cannot hold
        in stationary data: ``lambda`` then stays at ``lambda_max``, a fixed weight of the cost. It may fall while ``L`` does.
    :param lambda_init: Initial value of ``lambda``
    :param lambda_min: Lower limit of ``lambda`` (with ``lambda`` at zero, the actor would only maximise its entropy)
    :param lambda_max: Upper limit of ``lambda``
    :param lambda_learning_rate: learning rate for ``lambda``, can be a function of the current progress remaining.
        If ``None``, it is ``learning_rate``.
    :param reward_bound: Largest reward that the environment can pay (before ``VecNormalize``), at least 0. If a larger
        reward is seen, or if ``None``, it is the largest one seen. ``gamma`` must be below 1 with a bound above 0.
    :param compile_update: Whether to compile each update to one graph (``torch.compile``), on a GPU a CUDA graph. It
        needs torch 2.11, and takes minutes at the first update and when a constant like ``batch_size`` has changed.
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
    policy: LyapunovPolicy
    actor: Actor
    actor_target: Actor | None
    critic: LyapunovCritic
    critic_target: LyapunovCritic

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
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        published_update: bool = False,
        alpha3: float = 1.0,
        lambda_init: float = 1.0,
        lambda_min: float = 1e-4,
        lambda_max: float = 1.0,
        lambda_learning_rate: float | Schedule | None = None,
        reward_bound: float | None = None,
        compile_update: bool = False,
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
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,  # type: ignore[arg-type]  # a number from _setup_model() on
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
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
            supported_action_spaces=(spaces.Box,),
            support_multi_env=True,
        )

        self.target_entropy = target_entropy
        self.log_ent_coef = None  # type: th.Tensor | None
        # Entropy coefficient / Entropy temperature
        self.ent_coef = ent_coef
        self.target_update_interval = target_update_interval
        self.ent_coef_optimizer: th.optim.Adam | None = None
        self.published_update = published_update
        self.alpha3 = alpha3
        self.lambda_init = lambda_init
        self.lambda_min = lambda_min
        self.lambda_max = lambda_max
        self.lambda_learning_rate = lambda_learning_rate
        self.stated_reward_bound = reward_bound
        self.compile_update = compile_update
        self._compiled: CompiledUpdate | None = None

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # ``LAC.load()`` sets an argument under its own name
        self.stated_reward_bound = vars(self).pop("reward_bound", self.stated_reward_bound)
        if self.gamma == "auto":
            self.gamma = stated_discount(self.env)
        # One of numpy would make n-step returns double precision
        self.gamma = float(self.gamma)
        self._check_arguments()

        super()._setup_model()
        self._create_aliases()
        # Running mean and running var
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])
        self.actor_target = None
        if self.published_update:
            self.actor_target = self.policy.make_actor()
            self.actor_target.load_state_dict(self.actor.state_dict())
            # Target networks should always be in eval mode
            self.actor_target.set_training_mode(False)
            self.batch_norm_stats += get_parameters_by_name(self.actor, ["running_"])
            self.batch_norm_stats_target += get_parameters_by_name(self.actor_target, ["running_"])
        # Target entropy is used when learning the entropy coefficient
        if self.target_entropy == "auto":
            # automatically set target entropy if needed
            self.target_entropy = float(-np.prod(self.action_space.shape))  # type: ignore[arg-type]
        else:
            # Force conversion
            # this will also throw an error for unexpected string
            self.target_entropy = float(self.target_entropy)

        # The entropy coefficient or entropy can be learned automatically
        # see Automating Entropy Adjustment for Maximum Entropy RL section
        # of https://arxiv.org/abs/1812.05905
        if isinstance(self.ent_coef, str) and self.ent_coef.startswith("auto"):
            # Default initial value of ent_coef when learned
            init_value = 1.0
            if "_" in self.ent_coef:
                init_value = float(self.ent_coef.split("_")[1])
                assert init_value > 0.0, "The initial value of ent_coef must be greater than 0"
            self.log_ent_coef, self.ent_coef_optimizer = self._make_multiplier(init_value, self.lr_schedule)
        else:
            # Force conversion to float
            # this will throw an error if a malformed string (different from 'auto')
            # is passed
            self.ent_coef_tensor = th.tensor(float(self.ent_coef), device=self.device)

        # The multiplier of the decrease condition is learned like that of the entropy
        self.lambda_lr_schedule = self.lr_schedule
        if self.lambda_learning_rate is not None:
            self.lambda_lr_schedule = FloatSchedule(self.lambda_learning_rate)
        self.log_lambda, self.lambda_optimizer = self._make_multiplier(self.lambda_init, self.lambda_lr_schedule)

        if self.compile_update:
            self._compiled = CompiledUpdate(type(self)._update, self.device)

        self.reward_bound.fill_(self.stated_reward_bound or 0.0)
        self.update_offset(self._vec_normalize_env)

    def _check_arguments(self) -> None:
        """Check the arguments that SAC does not have."""
        if not 0 <= self.gamma <= 1:
            raise ValueError(f"gamma={self.gamma} must lie within 0 .. 1.")
        if self.gamma == 1 and (self.n_steps > 1 or self.replay_buffer_class is NStepReplayBuffer):
            raise ValueError("gamma must be smaller than 1 with n-step returns.")
        if not 0 < self.alpha3 < math.inf:
            raise ValueError(f"alpha3={self.alpha3} must be greater than 0, and finite.")
        if not 0 < self.lambda_min <= self.lambda_init <= self.lambda_max < math.inf:
            limits = f"lambda_min={self.lambda_min}, lambda_init={self.lambda_init} and lambda_max={self.lambda_max}"
            raise ValueError(f"{limits} must be greater than 0, finite, and in this order.")
        if not 0 <= (self.stated_reward_bound or 0.0) < math.inf:
            raise ValueError(
                f"reward_bound={self.stated_reward_bound} must be finite and at least 0, what a termination pays."
            )

    def _make_multiplier(self, initial: float, lr_schedule: Schedule) -> tuple[th.Tensor, th.optim.Adam]:
        """The logarithm of a Lagrange multiplier, and its optimizer."""
        log_multiplier = th.log(th.ones(1, device=self.device) * initial).requires_grad_(True)
        return log_multiplier, th.optim.Adam([log_multiplier], lr=lr_schedule(1), fused=True)

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        """What the critic learns the root of: values of ``L``, relative to its offset."""
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        with th.no_grad():
            # Compute the next Lyapunov values: max over all critics targets, never negative
            next_roots = largest_value(self.critic_target(replay_data.next_observations, next_actions))
            next_values = th.maximum(self.critic_target.value(next_roots), -self.critic_target.offset)
            # td error, without entropy term. In terminal states nothing is paid any more, so that L is the offset:
            # y = (bound - reward) + gamma * ((1 - done) * (next_value + offset) + done * offset),
            # where bound + gamma * offset = offset is left out on both sides
            return -replay_data.rewards + (1 - replay_data.dones) * discounts * next_values

    def _objective(self, roots: th.Tensor) -> th.Tensor:
        """What the actor lowers, given the roots at its actions."""
        return self.critic.distance(roots).mean()

    def _update(self, replay_data: ReplayBufferSamples, costs: th.Tensor, update_targets: bool) -> Metrics:
        """One update of all that is learned."""
        # We need to sample because `log_std` may have changed between two gradient steps
        if self.use_sde:
            self.actor.reset_noise()
            if self.actor_target is not None:
                self.actor_target.reset_noise()

        # Action by the current actor for the sampled state
        actions_pi, log_prob = self.actor.action_log_prob(replay_data.observations)

        with th.no_grad():
            # Next action by the current actor, or by the target actor
            next_actor = self.actor if self.actor_target is None else self.actor_target
            next_actions = next_actor(replay_data.next_observations)

        # Compute critic loss, with the current root of each critic network
        # using action from the replay buffer (all values are relative to the offset)
        target_values = self._target_values(replay_data, next_actions)
        # The floor follows the lowest value as the target critic follows the critic
        self.critic.floor.lerp_(target_values.min(), self.tau)
        target_roots = self.critic.root(target_values)
        current_roots = self.critic(replay_data.observations, replay_data.actions)
        critic_loss = 0.5 * sum(F.mse_loss(current_root, target_roots) for current_root in current_roots)
        assert isinstance(critic_loss, th.Tensor)  # for type checker

        # Compute the violation of the decrease condition, where the episode goes on
        if self.published_update:
            # A gradient through the next action
            next_actions = self.actor(replay_data.next_observations)
        with th.set_grad_enabled(next_actions.requires_grad):
            next_roots = largest_value(self.critic(replay_data.next_observations, next_actions))
        roots = largest_value(current_roots).detach()
        # L(s', a') <= L(s, a) - alpha3 * cost, in the metric of the objective
        allowed_roots = self.critic.root(self.critic.value(roots) - self.alpha3 * costs)
        difference = self.critic.distance(next_roots) - self.critic.distance(allowed_roots)
        going_on = 1 - replay_data.dones
        violation = (going_on * difference).sum() / going_on.sum().clamp(min=1)

        # Compute actor loss: the Lagrangian of the decrease condition and of the entropy constraint
        # Important: detach the multipliers from the graph
        # so we don't change them with other losses
        # see https://github.com/rail-berkeley/softlearning/issues/60
        lambda_coef = th.exp(self.log_lambda.detach())
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
        objective = violation
        if not self.published_update:
            objective = self._objective(largest_value(self.critic(replay_data.observations, actions_pi)))
        actor_loss = lambda_coef * objective + ent_coef * log_prob.mean()

        # Optimize the critic and the actor, both with the gradient at the current parameters
        set_gradients(critic_loss, self.critic.optimizer)
        set_gradients(actor_loss, self.actor.optimizer)
        step(self.critic.optimizer)
        step(self.actor.optimizer)

        # Optimize the multiplier of the decrease condition
        lambda_loss = update_multiplier(self.log_lambda, self.lambda_optimizer, violation)
        log_lambda_max = math.log(self.lambda_max)
        # Project it: a logarithm beyond its limits would need as many steps to come back (wind-up)
        with th.no_grad():
            self.log_lambda.clamp_(math.log(self.lambda_min), log_lambda_max)

        metrics = {
            "actor_loss": actor_loss,
            "critic_loss": critic_loss,
            "ent_coef": ent_coef,
            "lambda": lambda_coef,
            "lambda_saturation": self.log_lambda >= log_lambda_max,
            "lambda_loss": lambda_loss,
            "lyapunov_difference": violation,
            "lyapunov_mean": self.critic.lyapunov_of(roots).mean(),
            "cost": costs.mean(),
        }

        # Optimize entropy coefficient, also called
        # entropy temperature or beta in the paper
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            assert isinstance(self.target_entropy, float)
            entropy_violation = log_prob.mean() + self.target_entropy
            metrics["ent_coef_loss"] = update_multiplier(self.log_ent_coef, self.ent_coef_optimizer, entropy_violation)

        # Update target networks
        if update_targets:
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            self.critic_target.floor.lerp_(self.critic.floor, self.tau)
            # Copy running stats, see GH issue #996
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
            if self.actor_target is not None:
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)

        with th.no_grad():
            return tuple(metrics), th.hstack(tuple(metrics.values()))

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self._n_updates == 0:
            self.warn_of_free_terminations()
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]

        # Update learning rate according to lr schedule
        self._update_learning_rate(optimizers)
        update_learning_rate(self.lambda_optimizer, self.lambda_lr_schedule(self._current_progress_remaining))
        optimizers += [self.lambda_optimizer]

        if isinstance(self.replay_buffer, NStepReplayBuffer):
            # One discount for returns and values
            self.replay_buffer.gamma = self.gamma

        # Kept on the device until the end: reading one value would wait for all pending work
        names: tuple[str, ...] = ()
        metrics_per_step: list[th.Tensor] = []

        with nullcontext(self._update) if self._compiled is None else self._compiled.ready(self, optimizers) as update:
            for gradient_step in range(gradient_steps):
                # Sample replay buffer
                replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
                update_targets = (self._n_updates + gradient_step) % self.target_update_interval == 0
                names, metrics = update(replay_data, self.costs(replay_data), update_targets)
                metrics_per_step.append(metrics)

        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if metrics_per_step:
            # One transfer from the device for all metrics of all gradient steps
            for name, value in zip(names, th.stack(metrics_per_step).mean(dim=0).tolist(), strict=True):
                self.logger.record(f"train/{name}", value)

    def learn(
        self: SelfLAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "LAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfLAC:
        if self.compile_update:
            check_compiler(self.device)
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _excluded_save_params(self) -> list[str]:
        own = ["actor", "actor_target", "critic", "critic_target", "batch_norm_stats", "batch_norm_stats_target", "_compiled"]
        return super()._excluded_save_params() + own

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer", "lambda_optimizer"]
        if self.actor_target is not None:
            state_dicts.append("actor_target")
        if self.ent_coef_optimizer is None:
            return state_dicts, ["log_lambda", "ent_coef_tensor"]
        return [*state_dicts, "ent_coef_optimizer"], ["log_lambda", "log_ent_coef"]
