"""One update of LAC, written out a second time from the equations and compared with ``train()``."""

import math
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_lac import LAC, PublishedLAC, evaluate_lyapunov
from tests.sb3_lac.equations import mlp, policy_sample
from tests.sweeps import sweep

GAMMA, TAU, LEARNING_RATE, LAMBDA_LEARNING_RATE, ALPHA3 = 0.9, 0.05, 1e-2, 2e-2, 0.3
LAMBDA_MIN, LAMBDA_MAX = 0.1, 1.0
SETTINGS = {"gamma": GAMMA, "tau": TAU, "alpha3": ALPHA3, "ent_coef": "auto_0.7", "lambda_init": 0.5}
SETTINGS |= {"learning_rate": LEARNING_RATE, "lambda_learning_rate": LAMBDA_LEARNING_RATE}
SETTINGS |= {"lambda_min": LAMBDA_MIN, "lambda_max": LAMBDA_MAX}


def mean_action(weights, obs):
    return th.tanh(mlp(weights, "latent_pi", obs, 2) @ weights["mu.weight"].T + weights["mu.bias"])


def roots_of(weights, obs, actions, n_critics):
    """What each critic learns, one output of a linear layer."""
    outputs = []
    for i in range(n_critics):
        latent = mlp(weights, f"lf{i}", th.cat([obs, actions], dim=1), 2)
        outputs.append((latent @ weights[f"lf{i}.4.weight"].T + weights[f"lf{i}.4.bias"]).squeeze(1))
    return th.stack(outputs)


def square_root(value):
    return th.sign(value) * abs(value) ** 0.5


def root(value, degree, scale):
    """What critics learn: of the default the positive solution f of f^2 = d (scale + f), d being the square root."""
    if degree is not None:
        return th.sign(value) * abs(value) ** (1 / degree)
    d = abs(value) ** 0.5
    return th.sign(value) * (0.5 * d + (0.25 * d**2 + scale * d) ** 0.5)


def relative(roots, degree, scale):
    """L of the largest of several critics, above its floor."""
    f = roots.amax(dim=0)
    return th.sign(f) * (abs(f) ** degree if degree is not None else (f**2 / (scale + abs(f))) ** 2)


class ScalarAdam:
    """Adam on one number."""

    def __init__(self, value):
        self.value, self.m, self.v, self.t = value, 0.0, 0.0, 0

    def step(self, gradient, learning_rate):
        self.t += 1
        self.m = 0.9 * self.m + 0.1 * gradient
        self.v = 0.999 * self.v + 0.001 * gradient**2
        m_hat, v_hat = self.m / (1 - 0.9**self.t), self.v / (1 - 0.999**self.t)
        self.value -= learning_rate * m_hat / (math.sqrt(v_hat) + 1e-8)


@pytest.mark.parametrize("next_value", [2.0, -2.0])
def test_the_value_behind_each_sample_is_discounted_as_it_says_and_not_negative(
    make_model, train_metrics, monkeypatch, next_value
):
    model = make_model(n_steps=3, gamma=0.5, n_collect=50)
    batch = model.replay_buffer.sample(16)._replace(discounts=th.tensor([0.5, 0.25, 0.125, 0.5] * 4)[:, None])
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    monkeypatch.setattr(model.critic_target, "outputs", lambda *args: (th.zeros(16, 1),))
    monkeypatch.setattr(model.critic_target, "value", lambda roots: roots + next_value)
    roots = model.critic.outputs(batch.observations, batch.actions)
    values = (1 - batch.dones) * batch.discounts * max(next_value, 0.0) - batch.rewards
    after = deepcopy(model.critic)
    after.follow(values, model.tau)
    targets = after.root(values)
    expected = 0.5 * sum(((root - targets) ** 2).mean() for root in roots)
    assert train_metrics(model)["critic_loss"] == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize(
    ("n_critics", "bound", "degree"),
    [(1, 0.0, None), (2, 0.0, None), (1, 3.0, None), (2, 3.0, None), (2, 3.0, 2), (2, 3.0, 4)],
)
def test_train_is_the_update_of_the_equations(make_model_without_env, n_critics, bound, degree):
    # With plain gradient descent, a wrong factor in a loss cannot hide (Adam is invariant to scale)
    policy_kwargs = {"optimizer_class": th.optim.SGD, "n_critics": n_critics, "root": degree}
    model = make_model_without_env(reward_bound=bound, policy_kwargs=policy_kwargs, **SETTINGS)
    th.manual_seed(0)
    batch = ReplayBufferSamples(
        observations=th.randn(16, 2),
        actions=2 * th.rand(16, 2) - 1,
        next_observations=th.randn(16, 2),
        dones=(th.arange(16) % 5 == 3).float()[:, None],
        rewards=bound - 5 * th.rand(16, 1),
    )
    model.replay_buffer.sample = lambda *args, **kwargs: batch

    actor, critic, critic_target = (
        {name: tensor.detach().clone().requires_grad_(True) for name, tensor in module.named_parameters()}
        for module in (model.actor, model.critic, model.critic_target)
    )
    log_lambda, log_beta = ScalarAdam(math.log(0.5)), ScalarAdam(math.log(0.7))
    obs, next_obs, actions = batch.observations, batch.next_observations, batch.actions
    costs, dones = bound - batch.rewards.flatten(), batch.dones.flatten()
    # After a termination nothing is paid, which costs the bound in every step
    offset, floor, target_floor, scale = bound / (1 - GAMMA), 0.0, 0.0, 0.0

    for step in range(4):
        th.manual_seed(step)
        model.train(gradient_steps=1, batch_size=16)
        logged = model.logger.name_to_value

        th.manual_seed(step)
        actions_pi, log_prob = policy_sample(actor, obs)
        with th.no_grad():
            next_actions = mean_action(actor, next_obs)
            next_values = relative(roots_of(critic_target, next_obs, next_actions, n_critics), degree, scale) + target_floor
            next_values = th.maximum(next_values, -th.tensor(offset))
            # y - offset, where bound + GAMMA * offset is the offset
            y = costs - bound + GAMMA * (1 - dones) * next_values
            floor = (1 - TAU) * floor + TAU * y.min()
            target_floor = (1 - TAU) * target_floor + TAU * floor
            new_scale = 0.1 * ((y - floor).abs() ** 0.5).mean().item()
            scale = new_scale if step == 0 else (1 - TAU) * scale + TAU * new_scale
        roots = roots_of(critic, obs, actions, n_critics)
        critic_loss = (0.5 * (roots - root(y - floor, degree, scale)) ** 2).mean(dim=1).sum()
        values = (relative(roots, degree, scale) + floor + offset).clamp(min=0).detach()
        next_roots = roots_of(critic, next_obs, next_actions, n_critics)
        allowed = relative(roots.detach(), degree, scale) - ALPHA3 * costs
        difference = square_root(relative(next_roots, degree, scale)) - square_root(allowed)
        # Where the episode goes on
        d = difference[dones == 0].mean()
        objective = square_root(relative(roots_of(critic, obs, actions_pi, n_critics), degree, scale)).mean()
        lambda_, beta = math.exp(log_lambda.value), math.exp(log_beta.value)
        actor_loss = lambda_ * objective + beta * log_prob.mean()
        violation = log_prob.mean().item() - 2.0  # target entropy: minus the number of actions

        assert logged["train/critic_loss"] == pytest.approx(critic_loss.item(), rel=1e-4)
        assert logged["train/actor_loss"] == pytest.approx(actor_loss.item(), rel=1e-4)
        assert logged["train/lyapunov_difference"] == pytest.approx(d.item(), rel=1e-4)
        assert logged["train/lyapunov_mean"] == pytest.approx(values.mean().item(), rel=1e-4)
        assert logged["train/cost"] == pytest.approx(costs.mean().item(), rel=1e-5)
        assert logged["train/lambda"] == pytest.approx(lambda_, rel=1e-4)
        assert logged["train/ent_coef"] == pytest.approx(beta, rel=1e-4)
        assert logged["train/lambda_loss"] == pytest.approx(-log_lambda.value * d.item(), rel=1e-3)
        assert logged["train/ent_coef_loss"] == pytest.approx(-log_beta.value * violation, rel=1e-3)

        for weights, loss in ((critic, critic_loss), (actor, actor_loss)):
            gradients = th.autograd.grad(loss, list(weights.values()), retain_graph=True)
            for name, gradient in zip(list(weights), gradients, strict=True):
                weights[name] = (weights[name] - LEARNING_RATE * gradient).detach().requires_grad_(True)
        log_lambda.step(-d.item(), LAMBDA_LEARNING_RATE)
        log_lambda.value = min(max(log_lambda.value, math.log(LAMBDA_MIN)), math.log(LAMBDA_MAX))
        log_beta.step(-violation, LEARNING_RATE)
        with th.no_grad():
            critic_target = {name: (1 - TAU) * critic_target[name] + TAU * critic[name] for name in critic}

    for module, weights in ((model.actor, actor), (model.critic, critic), (model.critic_target, critic_target)):
        for name, tensor in module.named_parameters():
            th.testing.assert_close(tensor, weights[name].detach(), rtol=1e-4, atol=1e-6)
    assert model.log_lambda.item() == pytest.approx(log_lambda.value, rel=1e-4)
    assert model.log_ent_coef.item() == pytest.approx(log_beta.value, rel=1e-4)


@pytest.mark.parametrize("algorithm", [LAC, PublishedLAC])
def test_forward_hooks_of_the_critic_see_the_updates(make_model, train_metrics, algorithm):
    model = make_model(algorithm=algorithm)
    batch = model.replay_buffer.sample(16)
    model.replay_buffer.sample = lambda *args, **kwargs: batch
    seen = []
    model.critic.register_forward_hook(lambda critic, inputs, outputs: seen.append((inputs, outputs)))
    train_metrics(model)
    inputs, outputs = next(each for each in seen if each[0][1] is batch.actions)
    assert inputs[0] is batch.observations and [len(output) for output in outputs] == [16] * model.critic.n_critics


def test_lambda_has_its_own_learning_rate(make_model, train_metrics):
    def decay(progress_remaining: float) -> float:
        return 0.5 * progress_remaining

    model = make_model(learning_rate=1e-3, lambda_learning_rate=decay, n_collect=80)
    # The last update is that after step 80 of 80
    assert model.lambda_optimizer.param_groups[0]["lr"] == 0.0
    train_metrics(model)
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer):
        assert optimizer.param_groups[0]["lr"] == 1e-3
    assert make_model(learning_rate=2e-3, n_collect=0).lambda_optimizer.param_groups[0]["lr"] == 2e-3


def changed(model, how, tmp_path, **rates):
    """The model with other rates, changed as users of Stable-Baselines3 do."""
    if how == "attribute":
        for name, rate in rates.items():
            setattr(model, name, rate)
        model._setup_lr_schedule()
        return model
    model.save(tmp_path / "model")
    given = rates if how == "argument" else {"custom_objects": rates}
    loaded = type(model).load(tmp_path / "model", env=model.env, **given)
    loaded.set_parameters(model.get_parameters())
    return loaded


@pytest.mark.parametrize("how", sweep("argument", "attribute", "custom_objects"))
@pytest.mark.parametrize(
    ("algorithm", "rates", "expected"),
    [
        (LAC, {"learning_rate": 1e-5}, (1e-5, 1e-5, 1e-5, 1e-5)),
        (LAC, {"lambda_learning_rate": 1e-5}, (3e-4, 3e-4, 3e-4, 1e-5)),
        (PublishedLAC, {"learning_rate": 1e-5}, (1e-5, 1e-5, 3e-4, 1e-4)),
        (PublishedLAC, {"critic_learning_rate": 1e-5, "lambda_learning_rate": 2e-5}, (1e-4, 1e-4, 1e-5, 2e-5)),
    ],
)
def test_a_rate_that_is_changed_is_the_rate_of_all_that_the_argument_says(
    make_model, tmp_path, algorithm, rates, expected, how
):
    model = changed(make_model(algorithm=algorithm), how, tmp_path, **rates)
    model.learn(45)
    optimizers = (model.actor.optimizer, model.ent_coef_optimizer, model.critic.optimizer, model.lambda_optimizer)
    assert tuple(optimizer.param_groups[0]["lr"] for optimizer in optimizers) == expected


@pytest.mark.parametrize("ent_coef", [0.2, "0.2"])
def test_fixed_entropy_coefficient_stays_and_it_and_the_target_may_be_texts(make_model, train_metrics, ent_coef):
    model = make_model(ent_coef=ent_coef, target_entropy="-1.5")
    assert model.log_ent_coef is None and model.target_entropy == -1.5
    metrics = train_metrics(model, gradient_steps=3)
    assert metrics["ent_coef"] == pytest.approx(0.2)
    assert "ent_coef_loss" not in metrics


def test_log_names_are_those_of_sac_and_unique_when_truncated(make_model, train_metrics):
    metrics = train_metrics(make_model(), gradient_steps=2)
    names = {"actor_loss", "critic_loss", "ent_coef", "ent_coef_loss", "learning_rate", "n_updates"}
    names |= {"lambda", "lambda_saturation", "lambda_loss", "lyapunov_difference", "lyapunov_mean", "cost"}
    assert set(metrics) >= names
    assert all(len(f"train/{name}") < 36 for name in names)
    assert all(np.isfinite(metrics[name]) for name in names)


def test_update_reads_no_value_back_from_the_device(make_model, monkeypatch):
    # But for the first one, before which the costs of terminations are looked at
    model = make_model(n_collect=41)
    reads = []

    def count(method):
        original = getattr(th.Tensor, method)

        def counted(self, *args):
            reads.append(method)
            return original(self, *args)

        return counted

    for method in ("item", "tolist", "__float__", "__bool__", "numpy", "cpu"):
        monkeypatch.setattr(th.Tensor, method, count(method))
    # Samples are looked at where that waits for nothing
    monkeypatch.setattr("sb3_lac.cost_algorithm.refuse_samples", lambda *args: None)
    # Arguments of distributions are checked on the host, by PyTorch and not by the update
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", False)
    model.train(gradient_steps=5, batch_size=16)
    # Adam keeps the number of steps of the two multipliers on the host
    assert reads == 5 * 2 * ["item"] + ["tolist"]


def test_no_gradient_step_changes_nothing(make_model, train_metrics):
    model = make_model()
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    assert train_metrics(model, gradient_steps=0)["n_updates"] == 0
    assert all(th.equal(before[name], tensor) for name, tensor in model.policy.state_dict().items())


@pytest.mark.parametrize(
    ("algorithm", "kwargs"),
    sweep(
        (LAC, {}),
        *((PublishedLAC, {"critic_learning_rate": 1e-2, "horizon": horizon}) for horizon in (None, 5)),
    ),
)
def test_it_learns_to_control(make_model, make_env, algorithm, kwargs):
    def mean_cost():
        return evaluate_lyapunov(model, make_env(n_dim=1), n_episodes=10, seed=1000).metrics["mean_cost"].value

    options = {"learning_rate": 1e-2, "gamma": 0.9, "tau": 0.05, **kwargs}
    model = make_model(make_env(n_dim=1), n_collect=0, algorithm=algorithm, **options)
    before = mean_cost()
    model.learn(300)
    # Doing nothing costs 1.15 per step, the best controller 0.09. Four seeds of LAC reached 0.06 to 0.07
    assert before > 0.6 and mean_cost() < 0.2


def test_target_update_interval_counts_the_updates_of_all_calls(make_model):
    model = make_model(target_update_interval=3, tau=1.0)
    followed = []
    for gradient_steps in (1, 1, 2, 3, 1):
        model.train(gradient_steps=gradient_steps, batch_size=16)
        pairs = [(getattr(model.critic, name), getattr(model.critic_target, name)) for name in ("floor", "scale")]
        pairs += zip(model.critic.parameters(), model.critic_target.parameters(), strict=True)
        followed.append(all(th.equal(*pair) for pair in pairs))
    # After updates 1, 2, 4, 7 and 8: the first, fourth and seventh are followed
    assert followed == [True, False, True, True, False]
