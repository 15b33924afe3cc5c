"""Networks written out from their weights, for updates that are written out a second time."""

import math

import torch as th


def mlp(weights, prefix, x, n_layers, slope=0.01):
    """Layers ``prefix.0``, ``prefix.2``, ... with LeakyReLU after each; ReLU is that of slope 0."""
    for i in range(n_layers):
        x = x @ weights[f"{prefix}.{2 * i}.weight"].T + weights[f"{prefix}.{2 * i}.bias"]
        x = th.where(x > 0, x, slope * x)
    return x


def policy_sample(weights, obs, slope=0.01):
    """Sampled action of the squashed Gaussian, and its log probability summed over action dimensions."""
    latent = mlp(weights, "latent_pi", obs, 2, slope)
    mean = latent @ weights["mu.weight"].T + weights["mu.bias"]
    log_std = (latent @ weights["log_std.weight"].T + weights["log_std.bias"]).clamp(-20, 2)
    noise = th.normal(th.zeros_like(mean), th.ones_like(mean))
    action = th.tanh(mean + log_std.exp() * noise)
    log_prob = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi) - th.log(1 - action**2 + 1e-6)
    return action, log_prob.sum(dim=1)
