"""What programs around an algorithm do: hooks, optimizers, buffers, wrappers and policies of their own act, or are refused."""

import copy
import warnings

import gymnasium as gym
import numpy as np
import onnx
import pytest
import torch as th
from gymnasium import spaces, wrappers
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from torch.optim.optimizer import register_optimizer_step_post_hook

from sb3_lac import LAC, GymnasiumVecEnv, PublishedLAC, certify, evaluate_lyapunov, fit_lyapunov
from sb3_lac.compiled import update as compiled
from sb3_lac.onnx import export_onnx
from sb3_lac.stability import LyapunovFunction
from tests.sweeps import sweep


class Encoder(BaseFeaturesExtractor):
    def __init__(self, space):
        super().__init__(space, 8)
        self.layer = th.nn.Linear(2, 8)

    def forward(self, observations):
        return self.layer(observations).relu()


@pytest.fixture
def make_encoded(make_model, monkeypatch):
    monkeypatch.setattr(compiled, "BACKEND", "eager")

    def make(**kwargs):
        return make_model(policy_kwargs={"net_arch": [8], "features_extractor_class": Encoder}, **kwargs)

    yield make
    th.compiler.reset()


def halve(optimizer, *_):
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            parameter.grad.mul_(0.5)


def halve_gradient(parameter):
    parameter.grad.mul_(0.5)


class Clipping(th.optim.Adam):
    def step(self, closure=None):
        th.nn.utils.clip_grad_norm_(self.param_groups[0]["params"], 1e-3)
        return super().step(closure)


def replaced_step(model):
    optimizer = model.critic.optimizer
    step = optimizer.step
    optimizer.step = lambda: (halve(optimizer), step())


def replaced_forward(model):
    encoder = model.critic.features_extractor
    forward = encoder.forward
    encoder.forward = lambda observations: 0.5 * forward(observations)


def own_optimizer(model):
    model.critic.optimizer = Clipping(model.critic.parameters(), 1e-2)


def taken_out(network):
    """The encoder of a network, which its optimizer no longer holds."""
    encoder = network.features_extractor
    (group,) = network.optimizer.param_groups
    group["params"] = [each for each in group["params"] if not any(each is own for own in encoder.parameters())]
    return encoder


def encoder_stepped_elsewhere(model):
    taken_out(model.critic)


#: What a graph would leave out, and what the warning calls it
ADDITIONS = {
    "hooks of the optimizer Adam": lambda model: model.critic.optimizer.register_step_pre_hook(halve),
    "hooks of all optimizers": lambda model: register_optimizer_step_post_hook(halve),
    "hooks of the network Encoder": lambda model: model.critic_target.features_extractor.register_forward_hook(
        lambda module, inputs, output: 0.5 * output
    ),
    "hooks of the network Linear": lambda model: model.critic.lyapunov_networks[0][0].register_full_backward_hook(
        lambda module, inputs, outputs: tuple(None if each is None else 0.5 * each for each in inputs)
    ),
    "hooks of the gradient of bias": lambda model: model.actor.mu.bias.register_hook(lambda gradient: 0.5 * gradient),
    "hooks of the gradient of weight": lambda model: model.actor.mu.weight.register_post_accumulate_grad_hook(halve_gradient),
    "a step() that is not that of torch.optim (Clipping)": own_optimizer,
    "a step() that is not that of torch.optim (Adam)": replaced_step,
    "a forward() that was replaced (Encoder)": replaced_forward,
    "the gradient of weight (Linear), which is in no optimizer of the model": encoder_stepped_elsewhere,
}


@pytest.mark.parametrize("named", sweep(*ADDITIONS))
def test_what_a_graph_would_leave_out_acts_as_without_compilation_from_the_call_on_in_which_it_is_there(
    make_encoded, train_metrics, named
):
    results = []
    for compile_update in (False, True):
        model = make_encoded(compile_update=compile_update)
        train_metrics(model)
        handle = ADDITIONS[named](model)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(2):
                model.train(2, 16)
        messages = [str(each.message) for each in caught if "not compiled" in str(each.message)]
        assert [named in message for message in messages] == compile_update * [True]
        if hasattr(handle, "remove"):
            handle.remove()
        results.append([each.detach().clone() for each in model.policy.parameters()])
    th.testing.assert_close(*results, rtol=1e-4, atol=1e-6)


@pytest.mark.attacks
def test_an_update_is_compiled_again_when_the_hook_has_gone(make_encoded, capsys):
    model = make_encoded(compile_update=True)
    handle = model.critic.optimizer.register_step_pre_hook(halve)
    model.train(1, 16)
    assert "compiles the update" not in capsys.readouterr().err
    handle.remove()
    model.train(1, 16)
    assert "compiles the update" in capsys.readouterr().err


@pytest.mark.attacks
def test_momentum_is_compiled_from_its_second_step_on(make_model, train_metrics, monkeypatch):
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    momentum = {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}, "net_arch": [8]}
    models = [make_model(policy_kwargs=momentum, compile_update=compile_update) for compile_update in (False, True)]
    for model in models:
        train_metrics(model, gradient_steps=4)
    th.testing.assert_close(*(list(model.policy.parameters()) for model in models), rtol=1e-4, atol=1e-6)
    th.compiler.reset()


@pytest.mark.parametrize("algorithm", [LAC, PublishedLAC])
@pytest.mark.parametrize("name", ["critic", "actor"])
def test_an_encoder_with_an_optimizer_of_its_own_gets_the_gradient_of_its_networks_loss_alone(
    make_encoded, train_metrics, algorithm, name
):
    gradients = []
    for is_taken_out in (False, True):
        model = make_encoded(algorithm=algorithm)
        network = getattr(model, name)
        encoder = taken_out(network) if is_taken_out else network.features_extractor
        encoder.zero_grad()
        train_metrics(model)
        gradients.append([parameter.grad.clone() for parameter in encoder.parameters()])
    assert all(gradient.abs().max() > 0 for gradient in gradients[0])
    th.testing.assert_close(*gradients, rtol=0, atol=0)
    # It is whoever steps it that sets the gradient back
    model.train(1, 16)
    assert not th.equal(encoder.layer.weight.grad, gradients[1][0])


def test_an_encoder_of_both_that_the_critic_trains_gets_nothing_of_the_actors_loss(make_encoded, train_metrics):
    gradients = []
    for is_shared in (False, True):
        model = make_encoded(ent_coef=0.0)
        held = [*model.actor.optimizer.param_groups[0]["params"]]
        if is_shared:
            taken_out(model.actor)
            model.actor.features_extractor = model.critic.features_extractor
        else:
            model.actor.features_extractor.load_state_dict(model.critic.features_extractor.state_dict())
        assert len(model.actor.optimizer.param_groups[0]["params"]) == len(held) - 2 * is_shared
        train_metrics(model)
        gradients.append(model.critic.features_extractor.layer.weight.grad.clone())
    th.testing.assert_close(*gradients, rtol=0, atol=0)


def test_a_replay_buffer_of_another_environment_is_refused_and_the_model_goes_on(make_model, make_env, tmp_path):
    other = make_model(make_env(n_dim=3))
    other.save_replay_buffer(tmp_path / "buffer")
    model = make_model()
    before, message = (
        model.replay_buffer,
        r"it stores Box\(-10.0, 10.0, \(3,\), float32\), and the model needs .*\(2,\), float32",
    )
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is before
    model.replay_buffer = other.replay_buffer
    for go_on in (lambda: model.learn(50), lambda: model.train(1)):
        with pytest.raises(ValueError, match=message):
            go_on()
    model.replay_buffer = before
    model.learn(50)
    several = make_model(make_vec_env(make_env, 2))
    several.replay_buffer = before
    with pytest.raises(ValueError, match="stores steps of 1 environments, and the model has 2"):
        several.learn(50)


@pytest.mark.parametrize("algorithm", [LAC, PublishedLAC])
def test_a_policy_that_is_put_into_a_model_is_trained_and_all_its_targets_have_the_statistics_of_what_they_follow(
    make_model, algorithm
):
    model = make_model(algorithm=algorithm, policy_kwargs={"features_extractor_class": NormalizedEncoder})
    policy = model.policy = copy.deepcopy(model.policy)
    model._create_aliases()
    followed = [(policy.critic, policy.critic_target)]
    followed += [(policy.actor, policy.actor_target)] if algorithm is PublishedLAC else []
    norms = [[network.features_extractor.norm for network in pair] for pair in followed]
    tensors = [*policy.actor.mu.parameters()]
    tensors += [each for _, target in norms for each in (*target.parameters(), target.running_mean, target.running_var)]
    before = [each.clone() for each in tensors]
    model.train(1)
    assert not any(th.equal(*pair) for pair in zip(before, tensors, strict=True))
    for norm, target in norms:
        assert th.equal(norm.running_mean, target.running_mean) and th.equal(norm.running_var, target.running_var)


class NormalizedEncoder(Encoder):
    def __init__(self, space):
        super().__init__(space)
        self.norm = th.nn.BatchNorm1d(8)

    def forward(self, observations):
        return self.norm(super().forward(observations))


def test_a_critic_of_costs_says_that_it_has_no_q_networks(make_model):
    with pytest.raises(AttributeError, match="has lyapunov_networks and no q_networks"):
        make_model(n_collect=0).critic.q_networks  # noqa: B018


def test_a_time_limit_that_is_returned_as_a_termination_is_named_in_certificate_and_report(make_env):
    class Controller:
        def predict(self, observation, deterministic=True, **kwargs):
            return -np.clip(observation, -1, 1), None

    lyapunov = LyapunovFunction(lambda states: (states**2).sum(axis=1))
    for lengths, is_limit in (((20, 20), True), ((20, 15), False)):
        each = iter(lengths)
        env = make_vec_env(lambda each=each: make_env(episode_length=next(each), terminate=True), 2)
        report = evaluate_lyapunov(Controller(), env, n_episodes=4, seed=0, lyapunov=lyapunov)
        for text in (report.summary(), certify(Controller(), env, n_episodes=4, seed=0, ultimate_bound=9.0).summary()):
            assert ("(4) have 20 steps, as with a time limit. If it is one, return truncated=True" in text) == is_limit
    env = make_vec_env(make_env, 1)
    assert "time limit" not in certify(Controller(), env, n_episodes=4, seed=0, ultimate_bound=9.0).summary()


def test_a_controller_without_deterministic_is_told_how(make_env):
    class Controller:
        def predict(self, observation):
            return np.zeros((len(observation), 2)), None

    with pytest.raises(
        ValueError, match=r"predict\(\) of Controller must take deterministic.* def predict\(self, observation, det"
    ):
        fit_lyapunov(Controller(), make_env(), n_episodes=4)


class Tensors(gym.vector.VectorEnv):
    """Two environments on torch."""

    def __init__(self, as_dict):
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs, self.as_dict = 2, as_dict
        box = spaces.Box(-1, 1, (2,))
        self.single_observation_space, self.single_action_space = spaces.Dict({"x": box}) if as_dict else box, box

    def reset(self, *, seed=None, options=None):
        return {"x": th.zeros(2, 2)} if self.as_dict else th.zeros(2, 2), {}


@pytest.mark.parametrize("as_dict", [False, True])
def test_tensors_are_refused_with_the_wrapper_that_converts_them(as_dict):
    with pytest.raises(ValueError, match=r"returns tensors of torch.*ArrayConversion\(env, env_xp=torch, target_xp=numpy\)"):
        GymnasiumVecEnv(Tensors(as_dict)).reset()


class Doubled(gym.Wrapper):
    """Neither base class says what it changes."""

    def step(self, action):
        observation, *others = self.env.step(action)
        return 2 * observation, *others


class Scaled(gym.RewardWrapper):
    def reward(self, reward):
        return reward / 10


def pendulum(wrapper=None, *args, **kwargs):
    env = gym.make("Pendulum-v1")
    return env if wrapper is None else wrapper(env, *args, **kwargs)


@pytest.mark.parametrize(
    ("make_env", "observation", "action"),
    sweep(
        (lambda: pendulum(wrappers.NormalizeObservation), "NormalizeObservation", None),
        (lambda: pendulum(wrappers.RescaleAction, -1, 1), None, "RescaleAction"),
        (lambda: wrappers.RescaleAction(pendulum(Doubled), -1, 1), "Doubled", "RescaleAction"),
        (lambda: VecFrameStack(make_vec_env("Pendulum-v1"), 2), "VecFrameStack", "VecFrameStack"),
        (
            lambda: VecNormalize(make_vec_env("Pendulum-v1", wrapper_class=wrappers.TimeAwareObservation)),
            "TimeAwareObservation",
            "TimeAwareObservation",
        ),
        (lambda: wrappers.RecordEpisodeStatistics(wrappers.NormalizeReward(pendulum(Scaled))), None, None),
    ),
)
def test_a_file_names_the_wrappers_that_it_leaves_out_or_its_environment(tmp_path, make_env, observation, action):
    model = PPO("MlpPolicy", make_env(), n_steps=8, batch_size=8, policy_kwargs={"net_arch": [4]}, device="cpu")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        path = export_onnx(model, tmp_path / "policy")
    messages = [str(each.message) for each in caught if "leaves out" in str(each.message)]
    graph = onnx.load(path)
    described = {entry.key: entry.value for entry in graph.metadata_props}
    names = ["observation" + (f"_of_{observation}" if observation else ""), "action" + (f"_of_{action}" if action else "")]
    assert [graph.graph.input[0].name, graph.graph.output[0].name] == names
    assert graph.ir_version == 8  # of operator set 18, which onnxruntime 1.14 knows
    left_out = dict.fromkeys(each for each in (action, observation) if each)
    assert described.get("wrappers") == (", ".join(left_out) or None)
    assert described.get("env_id") == (None if left_out else "Pendulum-v1")
    assert [all(each in message for each in left_out) for message in messages] == bool(left_out) * [True]
    # The next best policy takes its place
    assert export_onnx(model, path) == path
