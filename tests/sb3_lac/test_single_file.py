"""The algorithm in one file, for readers, takes the steps of ``LAC``."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

EXAMPLE = Path(__file__).parents[2] / "examples" / "lac_single_file.py"


@pytest.fixture(scope="module")
def single_file():
    return runpy.run_path(str(EXAMPLE))


def weights_of(model):
    """Those of a model of Stable-Baselines3, under the names of the single file."""
    weights = {f"actor.{name}": tensor for name, tensor in model.actor.state_dict().items()}
    for name, critic in (("critic", model.critic), ("critic_target", model.critic_target)):
        own = {key: tensor for key, tensor in critic.state_dict().items() if key not in ("offset", "root_degree")}
        parts = {key.replace("lf", "networks.", 1): tensor for key, tensor in own.items()}
        weights |= {f"{name}.{key}": tensor for key, tensor in parts.items()}
    weights |= {"log_lambda": model.log_lambda.detach(), "log_ent_coef": model.log_ent_coef.detach()}
    return {name: tensor.clone() for name, tensor in weights.items()}


@pytest.mark.parametrize("n_critics", [1, 2])
def test_its_steps_are_those_of_lac(make_model_without_env, train_metrics, single_file, n_critics):
    policy_kwargs = {"n_critics": n_critics, "activation_fn": th.nn.ReLU}
    arguments = {"gamma": 0.9, "tau": 0.05, "alpha3": 0.3, "learning_rate": 1e-2}
    model = make_model_without_env(lambda_init=0.5, policy_kwargs=policy_kwargs, **arguments)
    settings = single_file["Settings"](n_critics=n_critics, width=16, **arguments)
    agent = single_file["LAC"](2, 2, settings)
    modules = th.nn.ModuleDict({name: getattr(agent, name) for name in ("actor", "critic", "critic_target")})
    before = weights_of(model)
    modules.load_state_dict({name: tensor for name, tensor in before.items() if not name.startswith("log_")})
    with th.no_grad():
        agent.log_lambda.copy_(before["log_lambda"])

    rng = np.random.default_rng(0)
    for step in range(5):
        batch = {
            name: th.as_tensor(rng.normal(size=(64, 2)), dtype=th.float32) for name in ("observations", "next_observations")
        }
        batch["actions"] = th.as_tensor(rng.uniform(-1, 1, (64, 2)), dtype=th.float32)
        costs = th.as_tensor(rng.exponential(size=(64, 1)), dtype=th.float32)
        terminated = th.as_tensor(rng.random((64, 1)) < 0.2).float()
        sample = ReplayBufferSamples(**batch, dones=terminated, rewards=-costs)
        model.replay_buffer.sample = lambda *args, sample=sample, **kwargs: sample
        metrics = train_metrics(model, seed=step)
        th.manual_seed(step)
        losses = agent.update(single_file["Batch"](**batch, costs=costs, terminated=terminated))
        for name, loss in losses.items():
            assert loss == pytest.approx(metrics[f"{name}_loss"], rel=1e-4, abs=1e-6), (step, name)

    after = weights_of(model)
    assert not any(th.equal(after[name], before[name]) for name in after)
    found = {**modules.state_dict(), "log_lambda": agent.log_lambda.detach(), "log_ent_coef": agent.log_ent_coef.detach()}
    th.testing.assert_close(found, after, rtol=1e-4, atol=1e-6)


@pytest.mark.attacks
def test_it_learns_the_linear_problem(single_file):
    untrained, trained = (single_file["main"](n_steps=n_steps) for n_steps in (1, 1_500))
    assert trained < 0.3 * untrained  # the best controller: 0.2


def test_it_can_be_read_at_once():
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 210
