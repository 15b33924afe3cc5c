"""The control differs from LAC in the actions of its targets alone."""

import torch as th
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.sampled_lac import SampledLAC
from sb3_lac import LAC


def test_targets_are_those_of_lac_at_sampled_actions():
    sizes = {"buffer_size": 100, "learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    model = SampledLAC("MlpPolicy", make_vec_env("LinearCost-v0", 2), gamma=0.9, seed=0, device="cpu", **sizes).learn(20)
    batch = model.replay_buffer.sample(8)
    mean_actions = model.actor(batch.next_observations, deterministic=True)
    th.manual_seed(3)
    targets = model._target_values(batch, mean_actions)
    th.manual_seed(3)
    sampled, _ = model.actor.action_log_prob(batch.next_observations)
    th.testing.assert_close(targets, LAC._target_values(model, batch, sampled))
    assert (targets != LAC._target_values(model, batch, mean_actions)).any()
    assert not targets.requires_grad
