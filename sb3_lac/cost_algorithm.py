"""What algorithms for costs share: Lagrange multipliers, the loop of updates, files."""

import math
import os
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, get_parameters_by_name, update_learning_rate
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.sac import SAC

from sb3_lac.buffers import Samples, batches_at_once, split
from sb3_lac.checks import (
    check_arguments,
    form_of,
    refuse_samples,
    refuse_what_spoils_weights,
    spaces_of,
    warn_of_free_terminations,
)
from sb3_lac.compiled import CompiledUpdate, compiled_update
from sb3_lac.discounts import stated_discount
from sb3_lac.files import replacing
from sb3_lac.policies import LyapunovCritic, LyapunovPolicy
from sb3_lac.reward_bound import RewardBound
from sb3_lac.updates import Metrics, backward, same_distributions

SelfCostAlgorithm = TypeVar("SelfCostAlgorithm", bound="CostAlgorithm")


class CostAlgorithm(SAC):
    """
    SAC for the cost ``bound - reward >= 0``, where ``bound`` is the largest reward stated or seen, at least 0. After a
    termination nothing is paid, so that each step costs ``bound``: ``L`` is ``bound / (1 - gamma)`` there. Multipliers hold
    the entropy of the policy and a decrease of ``L``. Subclasses say what an update is, in ``_update()``.
    """

    policy: LyapunovPolicy
    critic: LyapunovCritic  # type: ignore[assignment]
    critic_target: LyapunovCritic  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[LyapunovPolicy],
        env: GymEnv | str,
        *,
        alpha3: float,
        lambda_init: float,
        lambda_min: float,
        lambda_max: float | None,
        lambda_learning_rate: float | Schedule | None,
        reward_bound: float | None,
        compile_update: bool,
        check_observations: bool = True,
        **kwargs: Any,
    ):
        super().__init__(policy, env, _init_setup_model=False, **kwargs)
        self.alpha3 = alpha3
        self.lambda_init = lambda_init
        self.lambda_min = lambda_min
        self.lambda_max = lambda_max
        self.lambda_learning_rate = lambda_learning_rate
        self.reward_bound = reward_bound
        self.compile_update = compile_update
        self.check_observations = check_observations
        self._compiled: CompiledUpdate | None = None

    def _setup_model(self) -> None:
        if self.gamma == "auto":
            self.gamma = stated_discount(self.env)
        # One of numpy would make n-step returns double precision, and YAML takes 1e-3 for a text
        for name in ("gamma", "alpha3", "lambda_init", "lambda_min", "lambda_max", "reward_bound"):
            value = getattr(self, name)
            if value is not None or name not in ("lambda_max", "reward_bound"):
                try:
                    setattr(self, name, float(value))
                except (TypeError, ValueError):
                    raise ValueError(f"{name}={value!r} must be a number.") from None
        self._check_arguments()

        # SAC asks the environment, which a model that is loaded may do without
        if self.target_entropy == "auto":
            self.target_entropy = float(-np.prod(self.action_space.shape))  # type: ignore[arg-type]
        super()._setup_model()
        # SAC has the statistics of the critics alone
        self._create_aliases()
        # A class of somebody else may store something else than the model observes
        self._stored_spaces = spaces_of(self.replay_buffer)
        self._adopt_replay_buffer()

        # The multiplier of the decrease condition is learned like that of the entropy
        self.log_lambda = th.log(th.ones(1, device=self.device) * self.lambda_init).requires_grad_(True)
        self.lambda_optimizer = th.optim.Adam([self.log_lambda], lr=self.lr_schedule(1))
        self._project_lambda()

        if self.compile_update:
            self._compiled = compiled_update(type(self)._update, self.device)

        self.bound_in(self._vec_normalize_env).raise_to(0.0)

    def _create_aliases(self) -> None:
        super()._create_aliases()
        # Running mean and running var
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        # Rates that are not those of ``learning_rate``
        self.critic_lr_schedule: Schedule | None = None
        self.lambda_lr_schedule = None if self.lambda_learning_rate is None else FloatSchedule(self.lambda_learning_rate)

    def _check_arguments(self) -> None:
        """Refuse arguments that make no sense, before anything is made."""
        check_arguments(self)

    def _adopt_replay_buffer(self) -> None:
        """Let the replay buffer sample as the model says, or refuse it."""
        for own, buffer_space in zip(self._stored_spaces, spaces_of(self.replay_buffer), strict=False):
            if form_of(own) != form_of(buffer_space):
                raise ValueError(
                    f"The replay buffer is of another environment: it stores {buffer_space}, and the model needs {own}."
                )
        if isinstance(self.replay_buffer, NStepReplayBuffer):
            if self.gamma == 1:
                raise ValueError(f"gamma={self.gamma} must be smaller than 1 with n-step returns, for instance 0.99.")
            # One discount for returns and values
            self.replay_buffer.gamma = self.gamma

    def _project_lambda(self) -> th.Tensor:
        """Keep ``lambda`` within its limits, and tell whether it is at the upper one."""
        upper = math.log(max(self.lambda_init, 1.0) if self.lambda_max is None else self.lambda_max)
        # A logarithm beyond its limits would need as many steps to come back (wind-up)
        with th.no_grad():
            self.log_lambda.clamp_(math.log(self.lambda_min), upper)
        return self.log_lambda >= upper

    @property
    def n_costs(self) -> float:
        """Return ``L`` of a cost of 1 at each step, infinite without a discount."""
        return 1 / (1 - self.gamma) if self.gamma < 1 else math.inf

    def bound_in(self, vec_normalize: VecNormalize | None = None) -> RewardBound:
        """The bound, in the units that the agent sees through a normalization."""
        return RewardBound(self.policy, self.reward_bound or 0.0, self.n_costs, vec_normalize)

    @property
    def largest_reward(self) -> th.Tensor:
        """The largest reward stated or seen, before any normalization, shape (1,). It is part of the policy, as ``L`` is."""
        return self.policy.reward_bound

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        self._adopt_replay_buffer()
        n_envs = getattr(self.replay_buffer, "n_envs", self.n_envs)
        if n_envs != self.n_envs:
            raise ValueError(f"The replay buffer stores steps of {n_envs} environments, and the model has {self.n_envs}.")
        prepared = super()._setup_learn(*args, **kwargs)
        first = self._last_obs if self._vec_normalize_env is None else self._last_original_obs
        self._refuse_observation("first observation", first)
        return prepared

    def _refuse_observation(self, name: str, value: Any) -> None:
        """Refuse one that is not finite, unless the features extractor is said to handle it."""
        if self.check_observations:
            # VecNormalize learns nothing from the last ones
            vec_normalize = None if name == "last observation" else self._vec_normalize_env
            refuse_what_spoils_weights(f"environment gave the {name}", value, self.num_timesteps, vec_normalize)

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
        # What the environments said, before any normalization
        observation, raw_reward = new_obs, reward
        if vec_normalize is not None:
            observation, raw_reward = vec_normalize.get_original_obs(), vec_normalize.get_original_reward()
        # An environment may pay a list
        raw_reward = np.asarray(raw_reward)
        refuse_what_spoils_weights("policy gave the action", buffer_action, self.num_timesteps)
        refuse_what_spoils_weights("environment gave the reward", raw_reward, self.num_timesteps, vec_normalize)
        self._refuse_observation("observation", observation)
        for index in np.flatnonzero(dones):
            self._refuse_observation("last observation", infos[index].get("terminal_observation"))
        # The largest reward of a step, which n-step returns do not tell
        if raw_reward.max() > 0 and raw_reward.max() > self.largest_reward:
            if self.n_costs == math.inf and self.largest_reward == 0:
                warnings.warn(
                    f"With gamma=1 and rewards up to {raw_reward.max():g}, L is infinite: it is learned up to that constant, "
                    "and shown as infinite. Use for instance gamma=0.99.",
                    stacklevel=2,
                )
            self.bound_in(vec_normalize).raise_to(float(raw_reward.max()))
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def costs(self, replay_data: Samples) -> th.Tensor:
        """
        Get the costs of sampled transitions, of which none is negative. The bound follows rewards that are computed only then
        (HER), or that were stored elsewhere; of the latter, n-step returns only tell their mean.
        """
        # How often a reward of each step counts in a return: 1 + gamma + ... + gamma^(n-1)
        n_rewards = 1.0 if replay_data.discounts is None else (1 - replay_data.discounts) / (1 - self.gamma)
        return self.bound_in(self._vec_normalize_env).costs(replay_data.rewards, n_rewards)

    def _update(self, replay_data: Samples, costs: th.Tensor, update_targets: bool) -> Metrics:
        """One update of all that is learned. It may be compiled: nothing in it may wait for a value on the host."""
        raise NotImplementedError

    def _weights(self) -> tuple[th.Tensor, th.Tensor]:
        """``lambda`` and the entropy coefficient, as weights in the loss of the actor."""
        # Important: detach the multipliers from the graph
        # so we don't change them with other losses
        # see https://github.com/rail-berkeley/softlearning/issues/60
        ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
        return th.exp(self.log_lambda.detach()), ent_coef

    def _parameters_of(self, network: BaseModel) -> list[th.Tensor]:
        """Return what a network learns: parameters of its optimizer, and those of none, as of an encoder stepped elsewhere."""
        critic, actor = (
            [parameter for group in part.optimizer.param_groups for parameter in group["params"]]
            for part in (self.critic, self.actor)
        )
        optimized = {id(parameter) for parameter in (*critic, *actor)}
        unoptimized = [parameter for parameter in network.parameters() if id(parameter) not in optimized]
        return [*(critic if network is self.critic else actor), *unoptimized]

    def _update_multipliers(self, violation: th.Tensor, log_prob: th.Tensor) -> dict[str, th.Tensor]:
        """Optimize the multipliers of the decrease condition and of the entropy, and tell their losses."""
        metrics = {"lambda_loss": update_multiplier(self.log_lambda, self.lambda_optimizer, violation)}
        metrics["lambda_saturation"] = self._project_lambda()
        # Optimize entropy coefficient, also called
        # entropy temperature or beta in the paper
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            assert isinstance(self.target_entropy, float)
            entropy_violation = log_prob.mean() + self.target_entropy
            metrics["ent_coef_loss"] = update_multiplier(self.log_ent_coef, self.ent_coef_optimizer, entropy_violation)
        return metrics

    def _batches(self, number: int, batch_size: int) -> Iterator[tuple[Samples, th.Tensor]]:
        """Sample batches and their costs, many at once where the replay buffer allows it."""
        assert self.replay_buffer is not None
        at_once = batches_at_once(self.replay_buffer, batch_size)
        for first in range(0, number, at_once):
            n_batches = min(at_once, number - first)
            sampled = self.replay_buffer.sample(n_batches * batch_size, env=self._vec_normalize_env)
            replay_data = Samples.of(sampled)
            refuse_samples(replay_data, self.num_timesteps, self.check_observations)
            costs = self.costs(replay_data)
            if n_batches == 1:
                yield replay_data, costs
            else:
                yield from zip(split(replay_data, n_batches), split(costs, n_batches), strict=True)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Where living pays, an end costs the bound for ever
        if self._n_updates == 0 and not self.largest_reward > 0:
            warn_of_free_terminations(self.replay_buffer, self.n_costs)
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rates according to their schedules
        optimizers = [self.actor.optimizer, self.critic.optimizer, self.lambda_optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.insert(2, self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        own = (self.critic.optimizer, self.critic_lr_schedule), (self.lambda_optimizer, self.lambda_lr_schedule)
        for optimizer, schedule in own:
            if schedule is not None:
                update_learning_rate(optimizer, schedule(self._current_progress_remaining))

        # The buffer, or the discount, may have been set by hand
        self._adopt_replay_buffer()

        # Kept on the device until the end: each value that is read waits for all pending work
        names: tuple[str, ...] = ()
        metrics_per_step: list[th.Tensor] = []

        compiled = nullcontext(self._update) if self._compiled is None else self._compiled.traceable(self, optimizers)
        with same_distributions(self), compiled as update:
            for gradient_step, (replay_data, costs) in enumerate(self._batches(gradient_steps, batch_size)):
                update_targets = (self._n_updates + gradient_step) % self.target_update_interval == 0
                names, metrics = update(replay_data, costs, update_targets)
                metrics_per_step.append(metrics)

        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if metrics_per_step:
            # One transfer from the device for all metrics of all gradient steps
            for name, value in zip(names, th.stack(metrics_per_step).mean(dim=0).tolist(), strict=True):
                self.logger.record(f"train/{name}", value)

    def learn(
        self: SelfCostAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCostAlgorithm:
        if self._compiled is not None:
            self._compiled.check()
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=type(self).__name__ if tb_log_name is None else tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def save(self, path: Any, *args: Any, **kwargs: Any) -> None:
        with saved_file(path, ".zip") as part:
            super().save(part, *args, **kwargs)

    def save_replay_buffer(self, path: Any) -> None:
        with saved_file(path, ".pkl") as part:
            super().save_replay_buffer(part)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        # A model may have none, as one that never had an environment
        before = getattr(self, "replay_buffer", None)
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            self._adopt_replay_buffer()
        except Exception:
            self.replay_buffer = before
            raise

    @classmethod
    def load(cls: type[SelfCostAlgorithm], path: Any, *args: Any, **kwargs: Any) -> SelfCostAlgorithm:
        try:
            model = super().load(path, *args, **kwargs)
        # What comes of parameters that are not there, or of another shape
        except (AttributeError, KeyError, RuntimeError) as error:
            # The first of them, which Stable-Baselines3 may have met with an attempt of its own
            raise ValueError(
                f"The model in {path} does not fit this {cls.__name__}: {error.__context__ or error}\n"
                "It is of another version of sb3_lac (see the changelog), of another algorithm, or of other arguments: "
                "whether ent_coef is learned cannot be changed on loading."
            ) from error
        # Its limits may be others than those of the file
        model._project_lambda()
        if model.env is not None and {"gamma", "reward_bound"} & {*kwargs, *(kwargs.get("custom_objects") or ())}:
            model.bound_in(model._vec_normalize_env).raise_to(0.0)
        return model

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "batch_norm_stats", "batch_norm_stats_target", "_compiled"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "lambda_optimizer"], ["log_lambda", *tensors]


def update_multiplier(log_multiplier: th.Tensor, optimizer: th.optim.Optimizer, violation: th.Tensor) -> th.Tensor:
    """
    Step of a Lagrange multiplier in log space, which grows while its constraint is violated
    (see https://github.com/rail-berkeley/softlearning/issues/37 for the logarithm).
    """
    loss = -log_multiplier * violation.detach()
    optimizer.zero_grad()
    backward(loss, [log_multiplier])
    optimizer.step()
    return loss.detach()


def saved_file(path: Any, suffix: str) -> AbstractContextManager[Any]:
    """Open what Stable-Baselines3 writes to: a file that is there stays until the new one is complete."""
    if not isinstance(path, (str, os.PathLike)):
        return nullcontext(path)
    path = Path(path)
    return replacing(path if path.suffix else path.with_name(path.name + suffix))
