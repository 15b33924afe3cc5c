"""The discount that an environment states, and who listens to it."""

import pytest
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_lac import LAC
from sb3_lac.discounts import DEFAULT_DISCOUNT


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
    assert make_model(stating(0.5), n_collect=0, n_steps=3).replay_buffer.gamma == 0.5


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


def test_discounts_that_cannot_be_meant_are_refused(make_model, make_env, stating):
    with pytest.raises(ValueError, match=r"gamma=1\.1 must lie within 0 \.\. 1"):
        make_model(stating(1.1), n_collect=0)
    with pytest.raises(ValueError, match=r"different discounts, \[0\.5, 0\.99\]: set gamma"):
        make_model(DummyVecEnv([lambda: stating(0.5), make_env]), n_collect=0)
    assert make_model(stating(1.1), n_collect=0, gamma=0.9).gamma == 0.9
