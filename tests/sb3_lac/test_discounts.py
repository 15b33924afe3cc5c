"""The discount that an environment states, and who listens to it."""

import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_lac import LAC
from sb3_lac.discounts import DEFAULT_DISCOUNT, stated_discount


@pytest.fixture
def stating(make_env):
    def _stating(discount, **kwargs):
        env = make_env(**kwargs)
        env.metadata = {"render_modes": [], "discount": discount}
        return env

    return _stating


def test_discount_is_that_of_the_environment(make_model, make_env, stating):
    assert make_model(make_env(), n_collect=0).gamma == DEFAULT_DISCOUNT == 0.99
    assert make_model(stating(0.5), n_collect=0).gamma == 0.5
    assert make_model(Monitor(stating(0.5)), n_collect=0).gamma == 0.5
    assert make_model(VecNormalize(DummyVecEnv([lambda: stating(0.5)] * 2)), n_collect=0).gamma == 0.5
    assert make_model(stating(0.5), n_collect=0, gamma=0.8).gamma == 0.8


def test_discount_reaches_the_replay_buffers(make_model, stating):
    assert make_model(stating(0.5), n_collect=0, n_steps=3).replay_buffer.gamma == 0.5
    assert make_model(stating(0.5), n_collect=0, horizon=3).replay_buffer.gamma == 0.5


def test_subprocesses_state_it_too(make_model, stating):
    env = SubprocVecEnv([lambda: stating(0.5)] * 2, start_method="fork")
    assert make_model(env, n_collect=0).gamma == 0.5
    env.close()


def test_vector_environment_without_attributes(make_model, make_env):
    class WithoutAttributes(DummyVecEnv):
        def get_attr(self, attr_name, indices=None):
            if attr_name == "metadata":
                raise NotImplementedError
            return super().get_attr(attr_name, indices)

    assert make_model(WithoutAttributes([make_env]), n_collect=0).gamma == DEFAULT_DISCOUNT


def test_model_keeps_the_discount_that_it_learned_with(make_model, make_env, stating, tmp_path):
    make_model(stating(0.5), n_collect=0).save(tmp_path / "model")
    assert LAC.load(tmp_path / "model").gamma == 0.5
    assert LAC.load(tmp_path / "model", env=make_env()).gamma == 0.5
    assert LAC.load(tmp_path / "model", env=make_env(), gamma="auto").gamma == DEFAULT_DISCOUNT
    with pytest.raises(ValueError, match=r"gamma='auto' is the discount that the environment states, and there is none"):
        LAC.load(tmp_path / "model", gamma="auto")


@pytest.mark.parametrize("discount", ["high", 1.1, -0.1, float("nan"), [0.5], None])
def test_discount_out_of_range_is_refused(make_model, stating, discount):
    with pytest.raises(ValueError, match=r"metadata\['discount'\]=.*set gamma"):
        make_model(stating(discount), n_collect=0)
    assert make_model(stating(discount), n_collect=0, gamma=0.9).gamma == 0.9


def test_different_discounts_are_refused(make_model, make_env, stating):
    env = DummyVecEnv([lambda: stating(0.5), make_env])
    with pytest.raises(ValueError, match=r"\[0\.5, 'none'\]: set gamma"):
        make_model(env, n_collect=0)


def test_metadata_that_cannot_be_sent_is_named(make_model, make_env):
    def make():
        env = make_env()
        env.metadata = {"render_modes": [], "callback": lambda: 0}
        return env

    env = SubprocVecEnv([make], start_method="fork")
    with pytest.raises(ValueError, match="cannot be sent between processes"):
        make_model(env, n_collect=0)


@pytest.mark.parametrize(
    ("gamma", "message"),
    [
        ("high", "gamma='high' must be a number, or 'auto'"),
        (1.1, "gamma=1.1 must lie within 0 .. 1"),
        (-0.1, "gamma=-0.1 must lie within 0 .. 1"),
        (float("nan"), "gamma=nan must lie within 0 .. 1"),
    ],
)
def test_gamma_is_a_discount_or_auto(make_model, gamma, message):
    with pytest.raises(ValueError, match=message):
        make_model(n_collect=0, gamma=gamma)


def test_nothing_known_is_the_default():
    assert stated_discount([]) == stated_discount([None, {}, []]) == DEFAULT_DISCOUNT
