from collections.abc import Sequence
from functools import reduce
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    NatureCNN,
    create_mlp,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

# Where the root passes from a fourth to a square one, in parts of the mean distance
_SCALE = 0.1


def largest_value(values: Sequence[th.Tensor]) -> th.Tensor:
    """The conservative one of several critics."""
    return reduce(th.maximum, values)


def signed_power(values: th.Tensor, exponent: int) -> th.Tensor:
    """A power that keeps the sign."""
    return values * values.abs().pow(exponent - 1)


class LyapunovCritic(BaseModel):
    """
    Lyapunov critic network(s): each maps state and action to a value ``L(s, a) >= 0``, the discounted cost. Subclasses define
    the output of a network, for example a root of ``L``. The arguments are those of ``ContinuousCritic`` of Stable-Baselines3.
    """

    action_space: spaces.Box
    features_extractor: BaseFeaturesExtractor
    #: Outputs of a linear layer at the end of each network; -1 for none, the last hidden layer is the end then
    n_outputs: ClassVar[int]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
    ):
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
        )

        if n_critics < 1:
            raise ValueError(f"n_critics={n_critics} must be at least 1.")

        action_dim = get_action_dim(self.action_space)

        self.share_features_extractor = share_features_extractor
        self.n_critics = n_critics
        self.lyapunov_networks: list[nn.Sequential] = []
        # The value where nothing is ever paid. Set by the algorithm, saved with the weights
        self.offset: th.Tensor
        self.register_buffer("offset", th.zeros(1))
        for idx in range(n_critics):
            lyapunov_net = nn.Sequential(*create_mlp(features_dim + action_dim, self.n_outputs, net_arch, activation_fn))
            self.add_module(f"lf{idx}", lyapunov_net)
            self.lyapunov_networks.append(lyapunov_net)

    def __getattr__(self, name: str) -> Any:
        if name == "q_networks":
            raise AttributeError(
                "A critic of costs has lyapunov_networks and no q_networks: the largest of their values counts."
            )
        return super().__getattr__(name)

    def forward(self, obs: PyTorchObs, actions: th.Tensor, as_values: bool = True) -> tuple[th.Tensor, ...]:
        """
        Get the values ``L(s, a)``, none of them negative, or what the networks give. An update of LAC asks for the latter:
        forward hooks see that.

        :param obs: Observations, preprocessed by ``extract_features()``
        :param actions: As many flat actions in [-1, 1]
        :param as_values: Whether to get values, of shape (n, 1), or what the networks learn of them
        :return: One tensor of as many rows per critic
        """
        # Learn the features extractor using the policy loss only
        # when the features_extractor is shared with the actor
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            features = self.extract_features(obs, self.features_extractor)
        lyapunov_input = th.cat([features, actions], dim=1)
        outputs = tuple(lyapunov_net(lyapunov_input) for lyapunov_net in self.lyapunov_networks)
        return tuple(map(self.lyapunov_of, outputs)) if as_values else outputs

    def outputs(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """Get what the networks give, see ``forward()``."""
        return self(obs, actions, as_values=False)

    def lyapunov_of(self, output: th.Tensor) -> th.Tensor:
        """Get the values of ``L`` that outputs of a network belong to, shape (n, 1): offset included, and none negative."""
        raise NotImplementedError

    def lyapunov(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Get the conservative values ``L(s, a)``, the largest of the critics', shape (n, 1); see ``forward()``."""
        return largest_value(self(obs, actions))


class RootCritic(LyapunovCritic):
    """
    Lyapunov critic of ``LAC``: each network learns a root ``f(s, a)`` of the difference between ``L`` and its floor, about the
    value of the settled loop. The default is a square root for large ``L`` and a fourth root near the floor:
    ``L = offset + floor + sign(f) d^2`` with the distance ``d = f^2 / (scale + |f|)``.

    Costs of a settling loop fall over orders of magnitude. At a thousand times the cost, the same relative error is a thousand
    times larger in ``L``, 32 times in the square root, and less than six times in the fourth root. Noise biases ``L`` low,
    because the root of a mean is larger than the mean of the roots. For large costs, as of crashes, the mixed root has the
    smaller bias of the square root. Where the loop rests it has the resolution of the fourth root. The scale between the two
    follows the values, so that the unit of the costs is only a factor of ``f``.

    The floor follows the lowest value. If the discount is near 1, the offset of all values falls slowly while the loop
    improves, and a root without a floor would be flat where the loop rests. The critic learns a relative value, as in relative
    value iteration. The signed root is from https://arxiv.org/abs/1805.11593, without its linear part.
    """

    n_outputs = 1

    def __init__(self, *args: Any, root: int | str = "mixed", **kwargs: Any):
        if root not in ("mixed", 2, 4):
            raise ValueError(f"root={root!r} must be 'mixed', 2 (the square root everywhere) or 4 (the fourth root).")
        super().__init__(*args, **kwargs)
        self.degree = None if root == "mixed" else int(root)
        self._degree_of_old_weights = self.degree or 4
        # What all values have in common, and where roots pass from the fourth to the square one. Set by the algorithm, saved
        # with the weights
        self.floor: th.Tensor
        self.scale: th.Tensor
        self.register_buffer("floor", th.zeros(1))
        self.register_buffer("scale", th.zeros(1))
        # Weights are of one root, which goes with them into files; 0 stands for the mixed one
        self.register_buffer("root_degree", th.tensor([float(self.degree or 0)]))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # Weights of before sb3_lac 0.7 go with no root: that of the arguments, which came later, or else the fourth
        degree = state_dict.pop(f"{prefix}_extra_state", self._degree_of_old_weights)
        state_dict.setdefault(f"{prefix}root_degree", th.tensor([float(degree)]))
        # One root everywhere has no scale
        state_dict.setdefault(f"{prefix}scale", th.zeros(1))
        super()._load_from_state_dict(state_dict, prefix, *args)
        self.degree = int(state_dict[f"{prefix}root_degree"]) or None

    def follow(self, values: th.Tensor, rate: float) -> None:
        """Move the floor to the lowest value, and the scale to a tenth of the mean distance, by a share of the way."""
        self.floor.lerp_(values.min(), rate)
        if self.degree is None:
            scale = _SCALE * (values - self.floor).abs().sqrt().mean()
            # The first one is taken as it is
            self.scale.copy_(th.where(self.scale == 0, scale, self.scale.lerp(scale, rate)))

    def root(self, values: th.Tensor) -> th.Tensor:
        """Get what the networks learn: roots of what values relative to the offset are above the floor, negative below it."""
        above = values - self.floor
        if self.degree is not None:
            return above.sign() * above.abs().pow(1 / self.degree)
        distances = above.abs().sqrt()
        return above.sign() * (distances + (distances * (distances + 4 * self.scale)).sqrt()) / 2

    def value(self, roots: th.Tensor) -> th.Tensor:
        """Get the values that roots belong to, relative to the offset: the inverse of ``root()``."""
        return signed_power(self.distance(roots), 2) + self.floor

    def distance(self, roots: th.Tensor) -> th.Tensor:
        """Get signed square roots of what values are above the floor: like a norm, where values are like its square."""
        if self.degree is not None:
            return signed_power(roots, self.degree // 2)
        return signed_power(roots, 2) / (self.scale + roots.abs()).clamp(min=th.finfo(roots.dtype).tiny)

    def lyapunov_of(self, output: th.Tensor) -> th.Tensor:
        return (self.value(output) + self.offset).clamp(min=0.0)


class LyapunovPolicy(SACPolicy):
    """
    Policy class (with both actor and critic) for LAC: SAC's with a ``RootCritic``. ``MlpPolicy`` is an alias.
    ``LAC(policy_kwargs=...)`` takes the arguments from ``net_arch`` on:

    .. code-block:: python

      from sb3_lac import LAC

      model = LAC("MlpPolicy", "LinearCost-v0", policy_kwargs=dict(net_arch=[64, 64], n_critics=1))

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the policy and Lyapunov networks.
    :param root: Root of ``L`` that the critics learn. 'mixed' (the default) is the square root for large ``L`` and the fourth
        root near its floor; 2 or 4 is one of them everywhere.
    :param kwargs: The other arguments of ``SACPolicy``: ``activation_fn``, ``use_sde``, ``log_std_init``, ``use_expln``,
        ``clip_mean``, ``features_extractor_class``, ``features_extractor_kwargs``, ``normalize_images``, ``optimizer_class``,
        ``optimizer_kwargs`` (Adam is the fused one, unless they have ``fused``, ``foreach`` or ``differentiable``),
        ``n_critics`` (the largest of their values is used) and ``share_features_extractor``
    """

    critic: LyapunovCritic  # type: ignore[assignment]
    critic_target: LyapunovCritic  # type: ignore[assignment]
    action_space: spaces.Box
    reward_bound: th.Tensor
    critic_class: ClassVar[type[LyapunovCritic]] = RootCritic

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        root: int | str | None = None,
        **kwargs: Any,
    ):
        self.root = root
        super().__init__(observation_space, action_space, lr_schedule, net_arch, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        # Other implementations of Adam exclude the fused one
        if self.optimizer_class is th.optim.Adam and not {"fused", "foreach", "differentiable"} & self.optimizer_kwargs.keys():
            # One kernel per step instead of several per tensor
            self.optimizer_kwargs = {"fused": True, **self.optimizer_kwargs}
        # The reward that costs nothing, which the critics' offset belongs to. Set by the algorithm, saved with the weights
        self.register_buffer("reward_bound", th.zeros(1))
        if self.root is not None:
            self.critic_kwargs["root"] = self.root
        super()._build(lr_schedule)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # What SACPolicy leaves out
        arguments = {"share_features_extractor": self.share_features_extractor, "root": self.root}
        return super()._get_constructor_parameters() | arguments

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> LyapunovCritic:  # type: ignore[override]
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(**critic_kwargs).to(self.device)

    def predict_lyapunov(self, observation: np.ndarray | dict[str, np.ndarray], action: np.ndarray) -> np.ndarray:
        """
        Get the Lyapunov values ``L(s, a)`` (largest over the critics, offset included) of observations and actions.
        The observations are preprocessed as in ``predict()``.

        :param observation: n observations (or a single one), normalized with ``VecNormalize`` if the model was trained with it
        :param action: As many actions, in the units of the action space
        :return: The n values, an array of shape ``(n,)``
        """
        shape = self.action_space.shape
        action = np.asarray(action, dtype=np.float32)
        if action.shape != shape and action.shape[1:] != shape:
            raise ValueError(f"The actions of shape {action.shape} must have the shape {shape}, or (n, ...) for n actions.")
        # Switch to eval mode (this affects batch norm / dropout)
        self.set_training_mode(False)
        obs_tensor, _ = self.obs_to_tensor(observation)
        n_observations = len(next(iter(obs_tensor.values()))) if isinstance(obs_tensor, dict) else len(obs_tensor)
        # The critic was trained with flat actions in [-1, 1]
        scaled_actions = self.scale_action(action.reshape((-1, *shape))).reshape((-1, get_action_dim(self.action_space)))
        if n_observations != len(scaled_actions):
            raise ValueError(f"There are {n_observations} observations and {len(scaled_actions)} actions, one each is needed.")
        with th.no_grad():
            values = self.critic.lyapunov(obs_tensor, th.as_tensor(scaled_actions, dtype=th.float32, device=self.device))
        return values.flatten().cpu().numpy()


MlpPolicy = LyapunovPolicy


class CnnPolicy(LyapunovPolicy):
    """``LyapunovPolicy`` for image observations, by default with ``NatureCNN``."""

    def __init__(self, *args: Any, features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN, **kwargs: Any):
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


class MultiInputPolicy(LyapunovPolicy):
    """``LyapunovPolicy`` for dictionary observations, by default with ``CombinedExtractor``."""

    def __init__(self, *args: Any, features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor, **kwargs: Any):
        super().__init__(*args, features_extractor_class=features_extractor_class, **kwargs)


def __getattr__(name: str) -> Any:
    """Find what files of earlier models name here."""
    if name not in ("PublishedCnnPolicy", "PublishedMultiInputPolicy", "PublishedPolicy", "SumOfSquaresCritic"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sb3_lac import published_lac  # which imports this module

    return getattr(published_lac, name)
