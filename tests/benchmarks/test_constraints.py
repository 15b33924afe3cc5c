"""Constraints count what they say they count, and every design is trained with LAC's settings and judged alike."""

import json

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

pytest.importorskip("rl_zoo3")

from benchmarks import constraints
from benchmarks.constraints import CertificateLAC, HingeLAC, StateMultiplierLAC
from benchmarks.references import DISTURBANCES


@pytest.fixture(params=[HingeLAC, StateMultiplierLAC, CertificateLAC])
def model(request):
    return make(request.param)


def make(kind):
    return kind(
        "MlpPolicy", "LinearCost-v0", seed=0, device="cpu", buffer_size=10, alpha3=0.1, policy_kwargs={"net_arch": [8]}
    )


def transitions(n=4, reward=-2.0, done=0.0):
    th.manual_seed(0)
    column = th.ones(n, 1)
    return ReplayBufferSamples(th.randn(n, 2), th.zeros(n, 1), th.randn(n, 2), done * column, reward * column)


def test_nothing_is_violated_at_the_end_of_an_episode(model):
    ended = model._violations(transitions(done=1.0), th.zeros(4, 1), th.full((4, 1), 2.0))
    np.testing.assert_array_equal(ended.detach(), np.zeros((4, 1)))


def test_violations_depend_on_the_next_action_and_not_on_the_present_value(model):
    model._violations(transitions(), th.zeros(4, 1), th.full((4, 1), 2.0)).sum().backward()
    assert any(parameter.grad is not None and parameter.grad.any() for parameter in model.actor.parameters())


def test_violations_of_l_are_those_of_the_condition():
    model, values, costs = make(HingeLAC), th.tensor([[0.0], [9.0]]), th.tensor([[1.0], [2.0]])
    data = transitions(2)
    th.manual_seed(1)
    violations = model._violations(data, values, costs)
    th.manual_seed(1)
    (next_values,) = model.critic(data.next_observations, model.actor(data.next_observations))
    th.testing.assert_close(violations, next_values - values + 0.1 * costs)


def test_the_hinge_counts_what_violates_and_nothing_else():
    violations = th.tensor([[3.0], [-5.0]], requires_grad=True)
    penalty = make(HingeLAC)._penalty(transitions(2), violations)
    penalty.backward()
    assert penalty == 1.5 and violations.grad.tolist() == [[0.5], [0.0]]


def test_multipliers_rise_where_the_condition_is_violated():
    model, data = make(StateMultiplierLAC), transitions(2)
    before = model.multiplier(data.observations).detach()
    for _ in range(200):
        model._penalty(data, th.tensor([[1.0], [-1.0]]))
    (rise,), (fall,) = (model.multiplier(data.observations) - before).tolist()
    assert rise > 0.1 and fall < -0.1
    violations = th.tensor([[1.0], [-1.0]], requires_grad=True)
    model._penalty(data, violations).backward()
    assert violations.grad[0] > violations.grad[1] > 0


def test_the_certificate_falls_by_all_of_the_cost_but_the_average():
    model = make(CertificateLAC)
    # two states with costs 3 and 1 that follow each other
    there, back = th.tensor([[1.0, 0.0]]), th.tensor([[0.0, 1.0]])
    data = ReplayBufferSamples(th.cat([there, back]), th.zeros(2, 1), th.cat([back, there]), th.zeros(2, 1), th.zeros(2, 1))
    model.actor.forward = lambda observations, deterministic=False: th.zeros(len(observations), 1)
    costs = th.tensor([[3.0], [1.0]])
    for group in model.certificate_optimizer.param_groups:
        group["lr"] = 3e-3
    for _ in range(3000):
        violations = model._violations(data, th.zeros(2, 1), costs)
    assert model.average_cost.item() == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(violations.detach(), np.zeros((2, 1)), atol=0.1)
    (values,) = model.certificate(data.observations, data.actions)
    assert (values[0] - values[1]).item() == pytest.approx(1.0, abs=0.1)


def test_each_design_has_the_settings_of_lac_but_for_its_own():
    for env_id in DISTURBANCES:
        of_lac = constraints.Recipe.of("lac", env_id, 0)
        for name, design in constraints.DESIGNS.items():
            recipe = constraints.recipe_of(name, env_id, 0, 15_000)
            assert recipe.hyperparameters == {**of_lac.hyperparameters, **design.hyperparameters}
            assert recipe.timesteps == min(of_lac.timesteps, 15_000)


def test_designs_are_judged_alike(tmp_path, capsys):
    command = [
        "--envs",
        "LinearCost-v0",
        "--designs",
        "none",
        "state",
        "certificate",
        "--timesteps",
        "1020",
        "--episodes",
        "20",
    ]
    constraints.main([*command, "--seeds", "0", "--jobs", "1", "--out", str(tmp_path)])
    table = pd.read_csv(tmp_path / "constraints.csv")
    assert table["design"].tolist() == [name for name in ("none", "state", "certificate") for _ in range(6)]
    assert (table["updates"] == 20).all() and set(table["disturbance"]) >= {"none", "impulses", "other parameters"}
    # they had the same start, and learned something else
    assert table.loc[table["disturbance"] == "none", "cost"].is_unique
    assert json.loads((tmp_path / "constraints.json").read_text())["configuration"]["timesteps"] == 1020
    shown = capsys.readouterr().out
    assert "| a multiplier for each state " in shown and (tmp_path / "constraints.md").read_text(encoding="utf-8") in shown
    assert (tmp_path / "constraints.png").stat().st_size > 1000


@pytest.mark.parametrize(
    "command", [["--designs", "sac"], ["--envs", "Pendulum-v1"], ["--timesteps", "0"], ["--timesteps", "900"]]
)
def test_nonsense_on_the_command_line_is_refused(command):
    with pytest.raises(SystemExit):
        constraints.main(command)
