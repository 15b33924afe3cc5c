"""Batches of a call of ``train()``: of Stable-Baselines3's own buffers they are sampled at once."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_lac import LAC, PublishedLAC, buffers
from tests.sweeps import sweep


def sizes_of_samples(model, monkeypatch, gradient_steps):
    """How many transitions each call for samples of a call of ``train()`` asks for."""
    sizes = []
    kind = type(model.replay_buffer)
    sample = kind.sample

    def counted(self, batch_size, env=None):
        sizes.append(batch_size)
        return sample(self, batch_size, env=env)

    monkeypatch.setattr(kind, "sample", counted)
    model.train(gradient_steps, model.batch_size)
    return sizes


class OwnBuffer(ReplayBuffer):
    """Of a class that nobody here knows: what it gives may depend on what was learned from its last samples."""


@pytest.mark.parametrize(
    ("kwargs", "sizes"),
    [
        ({}, [80]),
        ({"n_steps": 3}, [80]),
        ({"algorithm": PublishedLAC, "horizon": 3}, [80]),
        ({"replay_buffer_class": OwnBuffer}, 5 * [16]),
    ],
)
def test_own_buffers_are_sampled_at_once_and_others_before_each_update(make_model, monkeypatch, n_updates, kwargs, sizes):
    model = make_model(**kwargs)
    assert sizes_of_samples(model, monkeypatch, 5) == sizes
    assert n_updates(model) == 5


def test_memory_of_what_is_sampled_at_once_is_limited(make_model, monkeypatch):
    # Two observations of two numbers of four bytes, 16 times
    monkeypatch.setattr(buffers, "_CHUNK_BYTES", 2 * 256 + 1)
    assert sizes_of_samples(make_model(), monkeypatch, 5) == [32, 32, 16]


def test_each_transition_is_in_one_batch_and_those_in_line_are_not_in_the_same():
    numbers = th.arange(6)[:, None]
    samples = buffers.Samples({"a": numbers, "b": -numbers}, numbers, {"a": numbers, "b": -numbers}, numbers, numbers)
    batches = list(buffers.split(samples, 3))
    assert [batch.actions.flatten().tolist() for batch in batches] == [[0, 3], [1, 4], [2, 5]]
    for batch in batches:
        assert th.equal(batch.observations["a"], batch.actions) and th.equal(batch.observations["b"], -batch.rewards)
        assert batch.actions.is_contiguous() and batch.discounts is None


@pytest.mark.parametrize("name", ["sample", "_get_samples"])
def test_a_method_that_is_replaced_on_the_buffer_at_hand_is_asked_for_one_batch_an_update(make_model, n_updates, name):
    model = make_model()
    method, calls = getattr(model.replay_buffer, name), []
    setattr(model.replay_buffer, name, lambda *args, **kwargs: calls.append(1) or method(*args, **kwargs))
    model.train(5, model.batch_size)
    assert len(calls) == n_updates(model) == 5


def test_each_batch_has_as_many_goals_of_its_own(make_model, monkeypatch):
    env = BitFlippingEnv(n_bits=3, continuous=True)
    model = make_model(env, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=60, n_collect=60)
    real, virtual = [], []
    for name, rows in (("_get_real_samples", real), ("_get_virtual_samples", virtual)):
        got = getattr(HerReplayBuffer, name)

        def marked(*args, got=got, rows=rows):
            samples = got(*args)
            rows.append(len(samples.rewards))
            return samples._replace(actions=th.full_like(samples.actions, float(rows is virtual)))

        monkeypatch.setattr(HerReplayBuffer, name, marked)
    shares = [batch.actions.mean().item() for batch, _ in model._batches(10, 20)]
    assert (real, virtual) == ([40], [160])
    assert shares == pytest.approx(10 * [0.8])


class Weighted(ReplayBuffer):
    """Its samples are objects with the names that SAC reads, and have weights and indices of other types."""

    def sample(self, batch_size, env=None):
        rows = np.random.randint(0, self.size(), batch_size)
        own = {"weights": np.ones(batch_size).tolist(), "indices": rows}
        return SimpleNamespace(**self._get_samples(rows, env)._asdict(), **own)


@pytest.mark.parametrize("compile_update", sweep(False, True))
@pytest.mark.parametrize("algorithm", [LAC, PublishedLAC])
def test_samples_may_be_any_object_with_other_parts(make_model, n_updates, monkeypatch, algorithm, compile_update):
    monkeypatch.setattr("sb3_lac.compiled.update.BACKEND", "eager")
    model = make_model(algorithm=algorithm, replay_buffer_class=Weighted, compile_update=compile_update)
    model.train(3, model.batch_size)
    assert n_updates(model) == 3
    model.replay_buffer._get_samples = lambda *args: ReplayBufferSamples(*(5 * [th.full((16, 2), th.nan)]))
    with pytest.raises(ValueError, match="The replay buffer gave actions with nan"):
        model.train(1, model.batch_size)
