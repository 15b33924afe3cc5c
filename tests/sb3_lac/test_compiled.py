"""An update as one compiled graph makes the numbers of the update that it was compiled from."""

import pickle
import shutil

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn
from torch.torch_version import TorchVersion

from sb3_lac import LAC, PublishedLAC
from sb3_lac.compiled import update as compiled
from tests.sweeps import sweep


@pytest.fixture(autouse=True)
def _quick_backend(monkeypatch):
    """The graph as it was traced, without minutes for making code of it."""
    monkeypatch.setattr(compiled, "BACKEND", "eager")
    yield
    th.compiler.reset()


@pytest.fixture
def make_model(make_model):
    """Of one small layer, whose graph is soon traced, unless asked otherwise."""

    def _make_model(*args, policy_kwargs=None, **kwargs):
        return make_model(*args, policy_kwargs={"net_arch": [8], **(policy_kwargs or {})}, **kwargs)

    return _make_model


def trained(model, calls=3, gradient_steps=3):
    """The model after updates on the same batches whatever the model, and what it logged."""
    np.random.seed(0)
    th.manual_seed(0)
    logged = []
    names = ("lr_schedule", "critic_lr_schedule", "lambda_lr_schedule")
    schedules = [getattr(model, name) for name in names]
    for call in range(calls + 1):
        # As far as the training is, for the schedules
        for name, schedule in zip(names, schedules, strict=True):
            if schedule is not None:
                setattr(model, name, ConstantSchedule(schedule(1.0 - call / calls)) if call < calls else schedule)
        if call < calls:
            model.train(gradient_steps, model.batch_size)
            logged.append(dict(model.logger.name_to_value))
    return model, logged


def tensors_of(model):
    """Everything that is learned but the moments of the optimizers."""
    tensors = {"log_lambda": model.log_lambda.detach(), "log_ent_coef": model.log_ent_coef}
    for name, state in model.get_parameters().items():
        if "optimizer" not in name:
            tensors |= {f"{name}.{key}": tensor for key, tensor in state.items()}
    return {name: tensor.detach() for name, tensor in tensors.items() if tensor is not None}


def assert_close(model, other):
    th.testing.assert_close(tensors_of(model), tensors_of(other), rtol=1e-4, atol=1e-6)


SCHEDULES = {"learning_rate": LinearSchedule(1e-2, 1e-4, 1.0), "lambda_learning_rate": LinearSchedule(1e-3, 1e-2, 1.0)}


def seen(env):
    """Its states as an image of bytes and as discrete numbers."""
    parts = {
        "image": spaces.Box(0, 255, (36, 36, 1), np.uint8),
        "digit": spaces.Discrete(3),
        "pair": spaces.MultiDiscrete([2, 3]),
    }

    def see(obs):
        digit = int(abs(obs[0])) % 3
        return {
            "image": np.full((36, 36, 1), 10 * abs(obs[1]), np.uint8),
            "digit": digit,
            "pair": np.array([digit % 2, digit]),
        }

    return gym.wrappers.TransformObservation(env, see, spaces.Dict(parts))


#: Soon compiled: code for layers, and for the moments of Adam, takes as long again
SMALLEST = {"policy_kwargs": {"net_arch": [], "optimizer_class": th.optim.SGD}}
NEEDS_COMPILER = pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
NEEDS_GPU = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize(
    ("backend", "kwargs"),
    [
        pytest.param("inductor", SCHEDULES | SMALLEST | {"device": "cuda"}, marks=NEEDS_GPU),
        *sweep(
            pytest.param("inductor", SCHEDULES | SMALLEST, marks=NEEDS_COMPILER),
            ("eager", SCHEDULES),
            ("eager", {"algorithm": PublishedLAC, "critic_learning_rate": LinearSchedule(1e-2, 1e-3, 1.0)}),
            ("eager", {"algorithm": PublishedLAC, "horizon": 4, "ent_coef": 0.2, "reward_bound": 3.0}),
            ("eager", {"ent_coef": 0.2, "reward_bound": 3.0, "n_steps": 3}),
            ("eager", {"policy_kwargs": {"n_critics": 2, "root": 4, "net_arch": [16, 16], "share_features_extractor": True}}),
            ("eager", {"policy": "MultiInputPolicy", "wrapper": seen}),
        ),
    ],
    ids=["cuda", "cpu", "schedules", "published", "horizon", "n_steps", "two_critics", "images_and_discrete"],
)
def test_compiled_and_eager_updates_are_the_same(make_model, make_env, monkeypatch, backend, kwargs):
    from torch._inductor import config

    monkeypatch.setattr(compiled, "BACKEND", backend)
    monkeypatch.setattr(compiled.CompiledUpdate, "check", lambda self: None)  # other code to wait for
    kwargs = kwargs.copy()
    kwargs["env"] = kwargs.pop("wrapper", lambda env: env)(make_env())
    eager, eager_logged = trained(make_model(**kwargs))
    model = make_model(compile_update=True, **kwargs)
    th._dynamo.utils.counters.clear()
    # Neither a schedule nor the next call of ``train()`` is a reason to compile again; and random numbers are those of PyTorch
    with th._dynamo.config.patch(error_on_recompile=True), config.patch(fallback_random=True):
        _, logged = trained(model)
    assert th._dynamo.utils.counters["stats"]["unique_graphs"] == 1
    for values, eager_values in zip(logged, eager_logged, strict=True):
        assert values == pytest.approx(eager_values, rel=1e-4, abs=1e-5)
    assert_close(model, eager)


def test_a_rate_that_has_fallen_to_zero_changes_nothing(make_model):
    """Weights of a dead unit included, whose gradients have always been zero."""
    falls = LinearSchedule(1e-2, 0.0, 1.0)
    rates = {"learning_rate": falls, "critic_learning_rate": falls}
    model = make_model(compile_update=True, algorithm=PublishedLAC, policy_kwargs={"activation_fn": nn.ReLU}, **rates)
    with th.no_grad():
        model.actor.latent_pi[0].bias[0] = -100.0
    trained(model)
    networks = (model.actor, model.critic)
    before = [parameter.clone() for network in networks for parameter in network.parameters()]
    model._current_progress_remaining = 0.0
    model.train(1, model.batch_size)
    after = [parameter for network in networks for parameter in network.parameters()]
    assert all(th.equal(*parameters) for parameters in zip(before, after, strict=True))


@pytest.mark.attacks
def test_constants_may_change(make_model):
    models = [make_model(compile_update=compile_update, target_update_interval=2) for compile_update in (False, True)]
    for model in models:
        trained(model, calls=1, gradient_steps=1)
        model.alpha3, model.lambda_min = 0.2, 0.5
        model.actor.latent_pi[0].requires_grad_(False)
        frozen = model.actor.latent_pi[0].weight.clone()
        trained(model, calls=1)
        assert th.equal(model.actor.latent_pi[0].weight, frozen)
    assert_close(*models)


@pytest.mark.attacks
def test_graph_is_one_that_a_gpu_can_replay(make_model, monkeypatch):
    """CUDA graphs change tensors where they are, but no samples, need no value on the CPU, and have one output."""
    from torch._dynamo.backends.common import aot_autograd  # seconds, which others that are tested here do without
    from torch._functorch.aot_autograd import make_boxed_func

    graphs = []

    def compiler(graph, inputs):
        graphs.append(graph.graph)
        return make_boxed_func(graph.forward)

    backend = aot_autograd(fw_compiler=compiler, keep_inference_input_mutations=True)
    monkeypatch.setattr(compiled, "BACKEND", backend)
    model = make_model(compile_update=True, use_sde=True, algorithm=PublishedLAC)
    graphs.clear()
    trained(model, calls=2)
    (graph,) = graphs
    inputs = graph.find_nodes(op="placeholder")
    copies = graph.find_nodes(op="call_function", target=th.ops.aten.copy_.default)
    changed = {inputs.index(node.args[0]) for node in copies}
    n_learned = sum(len(list(module.parameters())) for module in (model.actor, model.critic)) + 2
    n_targets = sum(len(list(module.parameters())) for module in (model.actor_target, model.critic_target))
    # Weight, gradient, both moments and number of steps
    assert len(changed) == 5 * n_learned + n_targets
    # Sampled: observations, actions, next observations and ends; and their costs
    sampled = {at for at, node in enumerate(inputs) if node.meta["val"].shape[:1] == (model.batch_size,)}
    assert len(sampled) == 5 and not changed & sampled
    assert len(graph.find_nodes(op="output")[0].args[0]) == 1
    assert not any("local_scalar_dense" in str(node.target) for node in graph.nodes)


@pytest.mark.attacks
def test_saved_models_go_on_compiled_or_not(make_model, tmp_path):
    model, _ = trained(make_model(compile_update=True, **SCHEDULES), calls=1)
    model.save(tmp_path / "compiled")
    going_on = [model, pickle.loads(pickle.dumps(model))]
    for compile_update in (False, True):
        loaded = LAC.load(tmp_path / "compiled", device="cpu", compile_update=compile_update)
        assert loaded.critic.optimizer.param_groups[0]["fused"] is True
        loaded.set_logger(model.logger)
        loaded.replay_buffer = model.replay_buffer
        going_on.append(loaded)
    for each in going_on:
        trained(each)
        assert_close(each, model)
    assert LAC.load(tmp_path / "compiled").compile_update


@pytest.mark.attacks
def test_any_replay_buffer_and_vec_normalize(make_model, n_updates):
    env = VecNormalize(DummyVecEnv([lambda: BitFlippingEnv(n_bits=3, continuous=True)]), norm_obs=False)
    model = make_model(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, n_collect=39, compile_update=True)
    model.learn(7, reset_num_timesteps=False)
    assert n_updates(model) == 6 and th.isfinite(model.log_lambda).all()


@pytest.mark.attacks
def test_what_is_constant_is_looked_at_once_a_call_and_compilation_is_said(make_model, monkeypatch, capsys):
    looks = []
    again = compiled.Graph.again
    monkeypatch.setattr(compiled.Graph, "again", lambda self, sampled: looks.append("code") or again(self, sampled))
    call = compiled.Graph.__call__
    monkeypatch.setattr(compiled.Graph, "__call__", lambda self, *inputs: looks.append("PyTorch") or call(self, *inputs))
    model = make_model(compile_update=True, n_collect=40)
    capsys.readouterr()
    trained(model, calls=2)
    assert looks == 2 * ["PyTorch", "code", "code"]
    # Another form of samples is another graph
    model.train(2, batch_size=8)
    assert looks[6:] == ["PyTorch", "code"]
    assert capsys.readouterr().err.count("compiles the update of LAC") == 2


def test_old_torch_is_refused(make_model, monkeypatch):
    monkeypatch.setattr(th, "__version__", TorchVersion("2.10.1+cpu"))
    with pytest.raises(RuntimeError, match=r"needs torch>=2.11, .* this is torch 2.10.1\+cpu"):
        make_model(compile_update=True)


def test_a_torch_that_was_not_tried_trains_without_compilation_and_says_so_once(make_model, monkeypatch):
    monkeypatch.setattr(th, "__version__", TorchVersion("2.100.0a0+git"))
    with pytest.warns(UserWarning, match=r"this is torch 2\.100\.0a0\+git, .* tried up to torch 2\.13") as caught:
        model = make_model(compile_update=True)
        trained(model)
    assert sum("not compiled" in str(each.message) for each in caught) == 1
    assert_close(model, trained(make_model())[0])


def test_missing_compiler_is_noticed_before_the_first_step(make_model, monkeypatch):
    def no_compiler(graph, inputs):
        raise OSError("no compiler here")

    model = make_model(n_collect=0, compile_update=True)
    monkeypatch.setattr(compiled, "BACKEND", no_compiler)
    with pytest.raises(RuntimeError, match=r"fails on device=cpu: (.|\n)*no compiler here(.|\n)*compile_update=False"):
        model.learn(10)
    assert model.num_timesteps == 0
