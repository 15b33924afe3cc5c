import pytest
import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution

from sb3_lac.distributions import SquashedGaussianDistribution


@pytest.fixture
def parameters():
    th.manual_seed(1)
    # From hardly random to saturated
    return 2 * th.randn(50, 3), th.empty(50, 3).uniform_(-4, 1)


def sampled(distribution, parameters):
    """Actions and log probabilities, and the gradients of both with respect to the parameters."""
    mean_actions, log_std = (parameter.clone().requires_grad_(True) for parameter in parameters)
    th.manual_seed(0)
    actions, log_prob = distribution.log_prob_from_params(mean_actions, log_std)
    of_actions = th.autograd.grad(actions.sum(), [mean_actions, log_std], retain_graph=True)
    return [actions, log_prob, *of_actions, *th.autograd.grad(log_prob.sum(), [mean_actions, log_std])]


def test_samples_probabilities_and_gradients_are_those_of_sac(parameters):
    ours, theirs = SquashedGaussianDistribution(3), SquashedDiagGaussianDistribution(3)
    for tensor, expected in zip(sampled(ours, parameters), sampled(theirs, parameters), strict=True):
        assert tensor.shape == expected.shape
        th.testing.assert_close(tensor, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("deterministic", [False, True])
def test_actions_are_those_of_sac(parameters, deterministic):
    actions = []
    for distribution in (SquashedGaussianDistribution(3), SquashedDiagGaussianDistribution(3)):
        th.manual_seed(0)
        actions.append(distribution.actions_from_params(*parameters, deterministic=deterministic))
    th.testing.assert_close(*actions)


def test_mode_is_that_of_the_last_call(parameters, make_model):
    ours, theirs = SquashedGaussianDistribution(3), SquashedDiagGaussianDistribution(3)
    for distribution in (ours, theirs):
        distribution.actions_from_params(*parameters)
    assert th.equal(ours.mode(), theirs.mode())
    assert ours.sample().shape == (50, 3)
    ours.log_prob_from_params(parameters[0] + 1, parameters[1])
    assert th.equal(ours.mode(), th.tanh(parameters[0] + 1))

    actor, obs = make_model(n_collect=0).actor, th.ones(4, 2)
    actor(obs)
    assert th.equal(actor.action_dist.mode(), actor(obs, deterministic=True))


def test_model_uses_it_unless_noise_depends_on_the_state(make_model):
    policy = make_model(n_collect=0).policy
    for actor in (policy.actor, policy.actor_target):
        assert isinstance(actor.action_dist, SquashedGaussianDistribution)
    assert not isinstance(make_model(n_collect=0, use_sde=True).actor.action_dist, SquashedGaussianDistribution)
