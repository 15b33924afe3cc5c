"""The control has SAC's objectives, in LAC's metric."""

import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.metric_sac import MetricSAC
from sb3_lac.compiled import update as compiled
from tests.sweeps import sweep

ENV_ID = "LinearCost-v0"


def make_model(**arguments):
    sizes = {"buffer_size": 100, "learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    return MetricSAC("MlpPolicy", make_vec_env(ENV_ID, 2), gamma=0.9, seed=0, device="cpu", **sizes, **arguments)


@pytest.mark.parametrize("ent_coef", ["auto_0.3", 0.3])
def test_target_is_that_of_sac_with_negated_values(ent_coef):
    model = make_model(ent_coef=ent_coef).learn(20)
    batch = model.replay_buffer.sample(8)
    batch = batch._replace(dones=(th.arange(8) % 2).float().reshape(-1, 1))
    model.critic_target.floor.fill_(3.0)
    th.manual_seed(3)
    targets = model._target_values(batch, None)
    th.manual_seed(3)
    with th.no_grad():
        actions, log_prob = model.actor.action_log_prob(batch.next_observations)
        q_values = th.cat(
            [-model.critic_target.value(roots) for roots in model.critic_target.outputs(batch.next_observations, actions)],
            dim=1,
        )
    soft = q_values.min(dim=1, keepdim=True).values - 0.3 * log_prob.reshape(-1, 1)
    th.testing.assert_close(targets, -(batch.rewards + (1 - batch.dones) * 0.9 * soft))
    assert not targets.requires_grad


def test_actor_lowers_the_value_itself():
    model = make_model()
    assert model._objective(th.tensor([[2.0], [-1.0]])).item() == pytest.approx((4 - 1) / 2)


@pytest.mark.parametrize("compile_update", sweep(False, True))
def test_multiplier_stays_where_it_is(compile_update, monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    model = make_model(compile_update=compile_update, lambda_init=0.5)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(30)
    assert model.log_lambda.item() == 0.0 and model._n_updates > 0
    assert any((old != new).any() for old, new in zip(before, model.actor.parameters(), strict=True))
    model.save(tmp_path / "model")
    assert MetricSAC.load(tmp_path / "model").num_timesteps == 30
