import math

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from torch.distributions import Normal


class SquashedGaussianDistribution(SquashedDiagGaussianDistribution):
    """
    The distribution of SAC's actor, with fewer operations: the same samples and probabilities for the same random state.

    The probability of a sample follows from the noise that it was made of. Its parent recovers that noise from the sample, for
    which autograd computes a gradient that is zero, and checks its arguments in each call.
    """

    def log_prob_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        std = self._set_parameters(mean_actions, log_std)
        noise = th.randn_like(mean_actions)
        actions = th.tanh(th.addcmul(mean_actions, noise, std))
        # Gaussian density of the noise, and derivative of the squashing
        log_prob = -0.5 * noise.square() - log_std - th.log(1 - actions * actions + self.epsilon)
        return actions, log_prob.sum(dim=1) - 0.5 * math.log(2 * math.pi) * mean_actions.shape[1]

    def actions_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor, deterministic: bool = False) -> th.Tensor:
        std = self._set_parameters(mean_actions, log_std)
        if deterministic:
            return th.tanh(mean_actions)
        return th.tanh(th.addcmul(mean_actions, th.randn_like(mean_actions), std))

    def _set_parameters(self, mean_actions: th.Tensor, log_std: th.Tensor) -> th.Tensor:
        """
        Keep the distribution, so that ``mode()`` and the other methods of the parent can be called afterwards.

        :param mean_actions: Mean before squashing
        :param log_std: Logarithm of the standard deviation
        :return: The standard deviation
        """
        std = log_std.exp()
        self.distribution = Normal(mean_actions, std, validate_args=False)
        return std
