import io
import math
import warnings
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, polyak_update, update_learning_rate
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer
from stable_baselines3.sac.policies import Actor
from torch.nn import functional as F

from sb3_lac.buffers import HorizonReplayBuffer, HorizonReplayBufferSamples
from sb3_lac.compiled import CompiledUpdate, Metrics, check_compiler, set_gradient, set_gradients, step
from sb3_lac.discounts import DEFAULT_DISCOUNT, stated_discount, sum_of_discounts, weight_of_return
from sb3_lac.env_ids import check_env_id
from sb3_lac.policies import CnnPolicy, LyapunovCritic, LyapunovPolicy, MlpPolicy, MultiInputPolicy, largest_value
from sb3_lac.vec_env import time_limits

SelfLAC = TypeVar("SelfLAC", bound="LAC")


def update_multiplier(log_multiplier: th.Tensor, optimizer: th.optim.Optimizer, violation: th.Tensor) -> th.Tensor:
    """
    Step of a Lagrange multiplier in log space, which grows while its constraint is violated:
    ``lambda`` with the decrease condition, ``ent_coef`` with the entropy constraint
    (see https://github.com/rail-berkeley/softlearning/issues/37 for the logarithm).
    """
    violation = violation.detach()
    loss = -log_multiplier.detach() * violation
    # The loss is linear in the logarithm: autograd would only find the same number again
    set_gradient(log_multiplier, -violation.reshape(1))
    step(optimizer)
    return loss


def reward_scale(vec_normalize: VecNormalize | None) -> float:
    """What a reward of the environment is divided by before the agent sees it."""
    if vec_normalize is None or not vec_normalize.norm_reward:
        return 1.0
    return math.sqrt(vec_normalize.ret_rms.var + vec_normalize.epsilon)


class Weights(NamedTuple):
    """What an update changes: the parameters of both optimizers, and all of the critic and of its target."""

    actor_optimized: Sequence[th.Tensor]
    critic_optimized: Sequence[th.Tensor]
    critic: Sequence[th.Tensor]
    critic_target: Sequence[th.Tensor]


class LAC(OffPolicyAlgorithm):
    """
    Lyapunov Actor-Critic (LAC)
    Actor-Critic Reinforcement Learning for Control with Stability Guarantee.
    Paper: https://arxiv.org/abs/2004.14288
    This implementation uses the SB3 SAC implementation as base.

    The critic ``L(s, a) >= 0`` learns the discounted sum of costs, and the actor has to make it decrease along
    trajectories by ``alpha3`` times the cost. A Lagrange multiplier ``lambda`` enforces that condition, while
    ``ent_coef`` keeps the entropy of the policy as in SAC.

    Note: LAC minimises the cost ``c = bound - reward``, where ``bound`` is the largest reward (``reward_bound`` or the largest
    one seen, at least 0). For an environment with ``reward = -cost <= 0`` this is exactly its cost. A termination pays 0 for
    ever after, as everywhere in reinforcement learning, and so costs ``bound`` per step: where living pays, LAC lives.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param learning_rate: learning rate for adam optimizer,
        the same learning rate will be used for all networks (Lyapunov critic and actor) and for ``ent_coef``,
        it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor. 'auto' is the one that the environment states as ``metadata["discount"]``, as those of
        battery_env do, and 0.99 for an environment that states none
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
    :param n_steps: When larger than 1, use n-step returns (with the ``NStepReplayBuffer``): the target of the critic
        and the decrease condition then span n steps, whose discounted costs are summed.
        Not supported for Dict observation spaces, and ignored with a custom ``replay_buffer_class``. The discount of the
        returns is always ``gamma``.
    :param ent_coef: Entropy regularization coefficient (``beta`` in the paper).
        Set it to 'auto' to learn it automatically (and 'auto_0.1' for using 0.1 as initial value)
    :param target_update_interval: update the target networks every ``target_update_interval``
        gradient steps.
    :param target_entropy: target entropy when learning ``ent_coef`` (``ent_coef = 'auto'``)
    :param published_update: Whether to update as the paper and its authors' code do. There the actor lowers ``L`` in the
        states that the sampled transitions lead to, so that the first states of episodes teach it nothing, and the action of
        the critic's target is that of a target actor. By default the actor lowers ``L`` in the states that the transitions
        start from, and there is no target actor.
    :param alpha3: Share of the cost by which ``L`` has to decrease in each step. From 1 on the condition cannot hold
        in stationary data: ``lambda`` then stays at ``lambda_max`` and LAC minimises the cost with that fixed weight.
    :param lambda_init: Initial value of ``lambda``
    :param lambda_min: Lower limit of ``lambda`` (with ``lambda`` at zero, the actor would only maximise its entropy)
    :param lambda_max: Upper limit of ``lambda``
    :param lambda_learning_rate: learning rate for ``lambda``, can be a function of the current progress remaining.
        If ``None``, it is ``learning_rate``.
    :param horizon: If given, ``L`` estimates the discounted sum of costs of the next ``horizon`` steps only (finite horizon
        candidate, ``gamma`` may be 1), summed along stored episodes by the ``HorizonReplayBuffer`` without a target network.
        Not supported for Dict observation spaces.
    :param reward_bound: Largest reward that the environment can pay (before ``VecNormalize``), at least 0. Costs and ``L`` are
        then the same from the start. If a larger reward is seen, a warning says so and the bound rises to it.
        If ``None``, the bound is the largest reward seen, at least 0. A rise shifts all values of ``L`` alike and
        changes no gradient. ``gamma`` must be below 1 with a bound above 0, or a ``horizon`` be given.
    :param compile_update: Whether to compile each update to one graph (``torch.compile``), on a GPU a CUDA graph. That takes
        minutes at the first update, and again when one of its constants has changed (``batch_size``, ``tau``, ...;
        not so a scheduled learning rate). It needs torch 2.11, a C++ compiler on a CPU and triton on a GPU, and networks
        that ``torch.compile`` can trace.
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE)
        instead of action noise exploration (default: False)
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE
        Default: -1 (only sample at the beginning of the rollout)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling
        during the warm up phase (before learning starts)
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, those of SAC's policy
        and ``output_dim`` (see ``LyapunovPolicy``)
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
        horizon: int | None = None,
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
        if isinstance(env, str):
            check_env_id(env)
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
        self.horizon = horizon
        self.stated_reward_bound = reward_bound
        self.compile_update = compile_update
        self._compiled: CompiledUpdate | None = None
        self.largest_stored_reward = 0.0
        if replay_buffer_class is ReplayBuffer and n_steps > 1:
            warnings.warn(
                f"n_steps={n_steps} is ignored, because replay_buffer_class=ReplayBuffer was passed, which holds single "
                "steps: leave replay_buffer_class out for n-step returns.",
                stacklevel=2,
            )
            self.n_steps = 1
        if replay_buffer_class is NStepReplayBuffer:
            # An argument of the model, with which a loaded model sets it up anew
            self.n_steps = self.replay_buffer_kwargs.get("n_steps", n_steps if n_steps > 1 else 3)
        if horizon is None and replay_buffer_class is HorizonReplayBuffer:
            raise ValueError("The HorizonReplayBuffer is used with a horizon, and chosen by it: set for instance horizon=5.")

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # ``LAC.load()`` sets an argument under its own name
        self.stated_reward_bound = vars(self).pop("reward_bound", self.stated_reward_bound)
        self._setup_discount()
        self._check_arguments()
        if self.replay_buffer_class in (ReplayBuffer, HorizonReplayBuffer, NStepReplayBuffer):
            # Of a loaded model, whose arguments may be others by now
            self.replay_buffer_class = None
            self.replay_buffer_kwargs = {
                name: value for name, value in self.replay_buffer_kwargs.items() if name not in ("horizon", "n_steps", "gamma")
            }
        if self.horizon is not None:
            self._setup_horizon()
        super()._setup_model()
        if isinstance(self.replay_buffer, NStepReplayBuffer) and self.gamma >= 1:
            raise ValueError(f"gamma={self.gamma} must be smaller than 1 with n-step returns, use for instance gamma=0.99.")
        self._create_aliases()
        # Running mean and running var
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])
        self.critic_has_batch_norm = len(self.batch_norm_stats) > 0
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
                if not init_value > 0.0:
                    raise ValueError(f"The initial value of ent_coef='{self.ent_coef}' must be greater than 0.")

            self.log_ent_coef = th.log(th.ones(1, device=self.device) * init_value).requires_grad_(True)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.lr_schedule(1), fused=True)
        else:
            # Force conversion to float
            # this will throw an error if a malformed string (different from 'auto')
            # is passed
            self.ent_coef_tensor = th.tensor(float(self.ent_coef), device=self.device)

        # The multiplier of the decrease condition is learned in log space too
        if self.lambda_learning_rate is None:
            self.lambda_lr_schedule = self.lr_schedule
        else:
            self.lambda_lr_schedule = FloatSchedule(self.lambda_learning_rate)
        self.log_lambda = th.log(th.ones(1, device=self.device) * self.lambda_init).requires_grad_(True)
        self.lambda_optimizer = th.optim.Adam([self.log_lambda], lr=self.lambda_lr_schedule(1), fused=True)

        if self.compile_update:
            self._compiled = CompiledUpdate(self.device)

        self.reward_bound.fill_(self.stated_reward_bound or 0.0)
        self.update_offset(self._vec_normalize_env)

    def _setup_discount(self) -> None:
        """Ask the environment for its discount factor, if it is to state it."""
        gamma: Any = self.gamma
        if gamma == "auto":
            metadata: list[Any] = []
            # There may be no environment, and a vector environment of somebody else may have no attributes
            with suppress(AttributeError, NotImplementedError):
                try:
                    metadata = self.env.get_attr("metadata")  # type: ignore[union-attr]
                except (EOFError, ConnectionError) as error:
                    raise ValueError(
                        "The environments' metadata cannot be sent between processes, which have ended by that: set gamma, "
                        "for instance gamma=0.99, and nobody asks for it."
                    ) from error
            self.gamma = stated_discount(metadata)
        elif not isinstance(gamma, (float, int, np.number)):
            raise ValueError(f"gamma={gamma!r} must be a number, or 'auto' for the discount that the environment states.")
        elif not 0 <= gamma <= 1:
            raise ValueError(f"gamma={gamma} must lie within 0 .. 1; 'auto' is the discount that the environment states.")
        # One of numpy would make returns of n steps double precision
        self.gamma = float(self.gamma)

    def _check_arguments(self) -> None:
        """Check the arguments that SAC does not have."""
        for name in ("alpha3", "lambda_init", "lambda_min", "lambda_max"):
            if not isinstance(getattr(self, name), (float, int, np.number)):
                raise ValueError(f"{name}={getattr(self, name)!r} must be a number.")
        if not 0 < self.alpha3 < math.inf:
            raise ValueError(
                f"alpha3={self.alpha3} must be greater than 0, and finite: the Lyapunov value has to decrease by alpha3 times "
                "the cost. Use for instance alpha3=0.1, or alpha3=1.0 to minimise the cost."
            )
        if not self.lambda_min > 0:
            raise ValueError(
                f"lambda_min={self.lambda_min} must be greater than 0, because lambda is learned in log space. "
                "Use a small value like lambda_min=1e-4."
            )
        if not self.lambda_min <= self.lambda_max < math.inf:
            raise ValueError(
                f"lambda_max={self.lambda_max} must be finite and not smaller than lambda_min={self.lambda_min}. "
                "Raise lambda_max or lower lambda_min."
            )
        if not self.lambda_min <= self.lambda_init <= self.lambda_max:
            raise ValueError(
                f"lambda_init={self.lambda_init} must lie between lambda_min={self.lambda_min} "
                f"and lambda_max={self.lambda_max}. Change lambda_init or widen the limits."
            )
        bound = self.stated_reward_bound
        if not isinstance(bound, (float, int, np.number, NoneType)):
            raise ValueError(f"reward_bound={bound!r} must be a number, or None for the largest reward seen.")
        if bound is not None and not 0 <= bound < math.inf:
            raise ValueError(
                f"reward_bound={bound} must be finite and at least 0, because nothing is paid after a termination. "
                "Use the largest reward that the environment can pay, or 0 if that is negative."
            )
        if bound:
            self._check_discount(bound)

    def _check_discount(self, bound: float) -> None:
        """Check that ``L`` is finite."""
        if bound > 0 and self.horizon is None and self.gamma >= 1:
            raise ValueError(
                f"gamma={self.gamma} must be smaller than 1 with rewards up to {bound:g}: each step below that reward "
                "has a cost, whose sum over all time is infinite. Use for instance gamma=0.99, a finite horizon, or rewards "
                "that are not positive."
            )

    def _setup_horizon(self) -> None:
        """Choose the replay buffer of the finite horizon candidate."""
        horizon = self.horizon
        if not isinstance(horizon, (int, np.integer)) or isinstance(horizon, bool) or horizon < 1:
            raise ValueError(f"horizon={horizon} must be an integer of at least 1, or None for the infinite horizon.")
        self.horizon = horizon = int(horizon)
        if self.env is not None:
            longest = max(horizon if limit is None else limit for limit in time_limits(self.env))
            if longest < horizon:
                raise ValueError(
                    f"horizon={horizon} is longer than the episodes, which max_episode_steps={longest} cuts: "
                    "what follows a time limit is unknown, and there would be nothing to learn from. "
                    "Use a smaller horizon or longer episodes."
                )
        if self.n_steps > 1:
            raise ValueError(
                f"horizon={horizon} and n_steps={self.n_steps} are two Lyapunov candidates: keep n_steps=1 or horizon=None."
            )
        if isinstance(self.observation_space, spaces.Dict):
            raise ValueError(f"horizon={horizon} is not supported for Dict observation spaces, use horizon=None.")
        if self.replay_buffer_class not in (None, ReplayBuffer):
            raise ValueError(
                f"horizon={horizon} needs the HorizonReplayBuffer and cannot be combined with "
                f"replay_buffer_class={self.replay_buffer_class.__name__}, use horizon=None."
            )
        self.replay_buffer_class = HorizonReplayBuffer
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "horizon": horizon, "gamma": self.gamma}

    @property
    def reward_bound(self) -> th.Tensor:
        """The largest reward stated or seen, before any normalization, shape (1,). It is part of the policy, as ``L`` is."""
        return self.policy.reward_bound

    @reward_bound.setter
    def reward_bound(self, bound: th.Tensor) -> None:
        self.policy.reward_bound.copy_(bound)

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def end_episodes(self) -> None:
        """
        Let the next call of ``learn()`` reset the training environment, which was used for something else: the episodes that
        it was in are stored as if a time limit had ended them. Not for use during ``learn()``.
        """
        self._last_obs = None
        buffer = self.replay_buffer
        if buffer is None or buffer.size() == 0:
            return
        if isinstance(buffer, HerReplayBuffer):
            with warnings.catch_warnings():
                # Its warning is about loading a buffer
                warnings.simplefilter("ignore")
                buffer.truncate_last_trajectory()
            return
        last = (buffer.pos - 1) % buffer.buffer_size
        unfinished = buffer.dones[last] == 0
        buffer.dones[last, unfinished] = 1
        # With ``optimize_memory_usage`` the next state is not stored, and must not be used
        buffer.timeouts[last, unfinished] = not buffer.optimize_memory_usage

    def cost_bound(self, vec_normalize: VecNormalize | None = None) -> th.Tensor:
        """
        The reward that costs nothing: LAC minimises ``c = bound - reward >= 0``, and ``bound`` is the largest of
        ``reward_bound``, of all rewards seen, and of 0. It is kept in the units of the environment, so that it stays valid
        when ``VecNormalize`` changes its scale.

        :param vec_normalize: Wrapper that the rewards come from, if any
        :return: The bound in the units of these rewards
        """
        bound = self.reward_bound.clamp(min=self.stated_reward_bound or 0.0)
        if vec_normalize is None or not vec_normalize.norm_reward:
            # Never clipped
            return bound
        return (bound / reward_scale(vec_normalize)).clamp(max=vec_normalize.clip_reward)

    def update_offset(self, vec_normalize: VecNormalize | None) -> None:
        """
        Let the critics have the offset of the present bound, the value of ``L`` where nothing is ever paid. When the bound
        rises by D, all exact values of ``L`` rise by ``D / (1 - gamma)`` (with a horizon, by D times its sum of discounts),
        and so do those of the critics: there is nothing to learn anew.

        :param vec_normalize: Wrapper that the rewards come from, if any
        """
        # With gamma=1 no reward is positive, and neither is the offset
        if self.horizon is not None or self.gamma < 1:
            offset = self.cost_bound(vec_normalize) * sum_of_discounts(self.gamma, self.horizon)
            self.critic.offset.copy_(offset)
            self.critic_target.offset.copy_(offset)

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        vec_normalize = self._vec_normalize_env
        largest_reward = float(np.max(reward if vec_normalize is None else vec_normalize.get_original_reward()))
        if largest_reward > self.largest_stored_reward:
            self._check_discount(largest_reward)
            stated = self.stated_reward_bound
            # Vector environments hold rewards in single precision, where 0.1 is a little more
            if stated is not None and self.largest_stored_reward <= np.float32(stated) < np.float32(largest_reward):
                warnings.warn(
                    f"A reward of {largest_reward:g} is larger than reward_bound={stated:g}. The bound follows the largest "
                    "reward from here on, and L is shifted with it. A larger reward_bound keeps costs and L comparable.",
                    stacklevel=2,
                )
            self.largest_stored_reward = largest_reward
            self.reward_bound = self.reward_bound.clamp(min=largest_reward)
            self.update_offset(vec_normalize)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _raise_bound(self, rewards: th.Tensor) -> th.Tensor:
        """
        Let the bound rise to the largest of some rewards, and the offset of the critics with it. So it stays valid when
        rewards are computed at sampling (HER) or were stored elsewhere. Of the latter, sums of n steps only tell their mean.
        """
        largest_reward = rewards.max()
        self.reward_bound = th.maximum(self.reward_bound, largest_reward * reward_scale(self._vec_normalize_env))
        # The scale of the rewards may have changed too
        self.update_offset(self._vec_normalize_env)
        # Changes of the units round
        return th.maximum(self.cost_bound(self._vec_normalize_env), largest_reward)

    def _target_values(self, replay_data: ReplayBufferSamples, next_actions: th.Tensor) -> th.Tensor:
        """What the critic learns."""
        if isinstance(replay_data, HorizonReplayBufferSamples):
            return -replay_data.horizon_returns
        # For n-step replay, discount factor is gamma**n_steps (when no early termination)
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        with th.no_grad():
            # Compute the next Lyapunov values: max over all target critics
            next_values = largest_value(self.critic_target(replay_data.next_observations, next_actions))
            # L is never negative
            next_values = th.maximum(next_values, -self.critic_target.offset)
            # No entropy term, unlike in SAC. In terminal states nothing is paid any more, so that L is the offset:
            # y = (bound - reward) + gamma * ((1 - done) * (next_value + offset) + done * offset),
            # where bound + gamma * offset = offset is left out on both sides
            return -replay_data.rewards + (1 - replay_data.dones) * discounts * next_values

    def _violation(
        self, replay_data: ReplayBufferSamples, next_actions: th.Tensor, values: th.Tensor, costs: th.Tensor
    ) -> th.Tensor:
        """Violation of the decrease condition, by the same critic, before its update, for both values."""
        if self.critic_has_batch_norm:
            # Normalized by the statistics of its own batch, neither value would show how much the other one differs
            self.critic.set_training_mode(False)
            with th.no_grad():
                values = largest_value(self.critic(replay_data.observations, replay_data.actions))
        with th.set_grad_enabled(next_actions.requires_grad):
            next_values = largest_value(self.critic(replay_data.next_observations, next_actions))
        if self.critic_has_batch_norm:
            self.critic.set_training_mode(True)
        going_on = 1 - replay_data.dones
        return (going_on * (next_values - values + self.alpha3 * costs)).sum() / going_on.sum().clamp(min=1)

    def _objective(
        self,
        replay_data: ReplayBufferSamples,
        actions: th.Tensor,
        values: th.Tensor,
        costs: th.Tensor,
        difference: th.Tensor,
    ) -> th.Tensor:
        """What the actor lowers, besides its negative entropy."""
        if self.published_update:
            return difference
        return largest_value(self.critic(replay_data.observations, actions)).mean()

    def _update(self, replay_data: ReplayBufferSamples, costs: th.Tensor, weights: Weights, update_targets: bool) -> Metrics:
        """One update of all that is learned."""
        # We need to sample because `log_std` may have changed between two gradient steps
        if self.use_sde:
            self.actor.reset_noise()
            if self.actor_target is not None:
                self.actor_target.reset_noise()

        # Action by the current actor for the sampled states
        actions_pi, log_prob = self.actor.action_log_prob(replay_data.observations)

        with th.no_grad():
            # Next action by the current actor, or by the lagged one
            next_actor = self.actor if self.actor_target is None else self.actor_target
            next_actions = next_actor(replay_data.next_observations)

        target_values = self._target_values(replay_data, next_actions)
        # Get current Lyapunov values for each critic network
        # using action from the replay buffer (all values are relative to the offset)
        current_values = self.critic(replay_data.observations, replay_data.actions)
        critic_loss = 0.5 * sum(F.mse_loss(current_value, target_values) for current_value in current_values)
        assert isinstance(critic_loss, th.Tensor)  # for type checker

        values = largest_value(current_values).detach()
        if self.published_update:
            # A gradient through the next action
            next_actions = self.actor(replay_data.next_observations)
        difference = self._violation(replay_data, next_actions, values, costs)

        objective = self._objective(replay_data, actions_pi, values, costs, difference)

        # Important: detach the multipliers from the graph
        # so we don't change them with other losses
        # see https://github.com/rail-berkeley/softlearning/issues/60
        lambda_coef = th.exp(self.log_lambda.detach())
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
        # Lagrangian of the decrease condition and of the entropy constraint
        actor_loss = lambda_coef * objective + ent_coef * log_prob.mean()

        # Optimize the critic and the actor, both with the gradient at the current parameters
        set_gradients(critic_loss, weights.critic_optimized)
        # Without the gradient of the critic's weights, which the loss of the actor depends on too
        set_gradients(actor_loss, weights.actor_optimized)
        step(self.critic.optimizer)
        step(self.actor.optimizer)

        # Optimize the multiplier of the decrease condition
        lambda_loss = update_multiplier(self.log_lambda, self.lambda_optimizer, difference)
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
            "lyapunov_difference": difference,
            "lyapunov_mean": values.mean() + self.critic.offset,
            "cost": costs.mean(),
        }

        # Optimize entropy coefficient, also called
        # entropy temperature or beta in the paper
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            assert isinstance(self.target_entropy, float)
            ent_coef_loss = update_multiplier(
                self.log_ent_coef, self.ent_coef_optimizer, log_prob.mean() + self.target_entropy
            )
            metrics["ent_coef_loss"] = ent_coef_loss

        # Update target networks
        if update_targets:
            polyak_update(weights.critic, weights.critic_target, self.tau)
            # Copy running stats, see GH issue #996
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
            if self.actor_target is not None:
                polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)

        with th.no_grad():
            return tuple(metrics), th.hstack(tuple(metrics.values()))

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]

        # Update learning rate according to lr schedule
        self._update_learning_rate(optimizers)
        update_learning_rate(self.lambda_optimizer, self.lambda_lr_schedule(self._current_progress_remaining))
        optimizers.append(self.lambda_optimizer)

        if isinstance(self.replay_buffer, (HorizonReplayBuffer, NStepReplayBuffer)):
            # One discount for returns and values, also of a buffer that was loaded
            self.replay_buffer.gamma = self.gamma
        if isinstance(self.replay_buffer, HorizonReplayBuffer) and self.replay_buffer.n_complete == 0:
            warnings.warn(
                f"No stored episode is as long as horizon={self.horizon} steps yet, and nothing is learned until one is. "
                "After loading a model, call load_replay_buffer() before learn().",
                stacklevel=2,
            )
            return

        # Lists, because going through the modules takes as long as a Polyak update of small networks
        actor_parameters, critic_parameters = (
            [parameter for group in optimizer.param_groups for parameter in group["params"]] for optimizer in optimizers[:2]
        )
        critic_weights, critic_target_weights = list(self.critic.parameters()), list(self.critic_target.parameters())
        weights = Weights(actor_parameters, critic_parameters, critic_weights, critic_target_weights)
        # Kept on the device until the end: reading one value would wait for all pending work
        names: tuple[str, ...] = ()
        metrics_per_step: list[th.Tensor] = []

        with nullcontext(self._update) if self._compiled is None else self._compiled.ready(self, optimizers) as update:
            for gradient_step in range(gradient_steps):
                # Sample replay buffer
                replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
                # The largest reward costs nothing, and so no cost is negative
                n_rewards = weight_of_return(replay_data.discounts, self.gamma)
                costs = self._raise_bound(replay_data.rewards / n_rewards) * n_rewards - replay_data.rewards
                update_targets = (self._n_updates + gradient_step) % self.target_update_interval == 0
                names, metrics = update(replay_data, costs, weights, update_targets)
                metrics_per_step.append(metrics)

        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if metrics_per_step:
            # One transfer from the device for all metrics of all gradient steps
            for name, value in zip(names, th.stack(metrics_per_step).mean(dim=0).tolist(), strict=True):
                self.logger.record(f"train/{name}", value)
        if self.gamma >= 1:
            # Positive rewards that were computed at sampling (HER) have not been seen before
            self._check_discount(self.reward_bound.item())

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if isinstance(self.replay_buffer, HorizonReplayBuffer) and (reset_num_timesteps or self._last_obs is None):
            # The environment is about to be reset
            self.replay_buffer.end_episodes()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

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

    @classmethod
    def load(cls: type[SelfLAC], *args: Any, **kwargs: Any) -> SelfLAC:
        """
        Load a model, see ``BaseAlgorithm.load()``. A ``reward_bound`` takes the place of the saved one, and ``L`` is shifted
        with it.

        :param args: Those of ``BaseAlgorithm.load()``
        :param kwargs: Those of ``BaseAlgorithm.load()``, and arguments of the model to change
        :return: The model
        :raises ValueError: If arguments cannot be meant, or ``published_update`` is another one than the saved one
        """
        try:
            model = super().load(*args, **kwargs)
        except (AttributeError, KeyError) as error:
            if "published_update" in kwargs:
                raise ValueError(
                    f"published_update={kwargs['published_update']} is not what the model was saved with: only one of the two "
                    "updates has a target actor, and it cannot be changed on loading."
                ) from error
            if "ent_coef" in kwargs:
                raise ValueError(
                    f"ent_coef={kwargs['ent_coef']!r} is not what the model was saved with: a coefficient that is learned has "
                    "an optimizer and one that is fixed has none, and that cannot be changed on loading."
                ) from error
            raise
        if kwargs.get("gamma") == "auto" and model.env is None:
            raise ValueError(
                "gamma='auto' is the discount that the environment states, and there is none: load with env=..., or set "
                f"gamma, for instance gamma={DEFAULT_DISCOUNT}."
            )
        if isinstance(kwargs.get("ent_coef"), (float, int, np.number)):
            # A parameter of the saved model, too
            model.ent_coef_tensor.fill_(kwargs["ent_coef"])
        if "reward_bound" in kwargs:
            saved = model.reward_bound.item()
            model.reward_bound.fill_(max(model.stated_reward_bound or 0.0, model.largest_stored_reward))
            if model.env is None and saved > 0 and not {"gamma", "horizon"} & kwargs.keys():
                # How rewards were normalized is not known without the environment, but part of the saved offset
                for critic in (model.critic, model.critic_target):
                    critic.offset.mul_(model.reward_bound.to(critic.offset.device) / saved)
            else:
                model.update_offset(model._vec_normalize_env)
        return model

    def load_replay_buffer(self, path: str | Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer, see ``OffPolicyAlgorithm.load_replay_buffer()``.

        :param path: Path to the pickled replay buffer
        :param truncate_last_traj: See ``OffPolicyAlgorithm.load_replay_buffer()``
        :raises ValueError: If it sums rewards over another number of steps than this model
        """
        own = getattr(self, "replay_buffer", None)
        super().load_replay_buffer(path, truncate_last_traj)
        if own is None:
            # Deleted to make room for this one
            return
        for name, none in (("horizon", None), ("n_steps", 1)):
            stored, needed = getattr(self.replay_buffer, name, none), getattr(own, name, none)
            if stored != needed:
                self.replay_buffer = own
                raise ValueError(
                    f"The replay buffer in {path} has {name}={stored} and the model {name}={needed}: load the model with the "
                    "arguments that the buffer was filled with, or continue without it."
                )

    def _excluded_save_params(self) -> list[str]:
        # Exclude aliases, and statistics that are part of the policy
        return super()._excluded_save_params() + [  # noqa: RUF005
            "actor",
            "actor_target",
            "critic",
            "critic_target",
            "batch_norm_stats",
            "batch_norm_stats_target",
            "_compiled",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer", "lambda_optimizer"]
        saved_pytorch_variables = ["log_lambda"]
        if self.ent_coef_optimizer is not None:
            saved_pytorch_variables.append("log_ent_coef")
            state_dicts.append("ent_coef_optimizer")
        else:
            saved_pytorch_variables.append("ent_coef_tensor")
        if self.actor_target is not None:
            state_dicts.append("actor_target")
        return state_dicts, saved_pytorch_variables
