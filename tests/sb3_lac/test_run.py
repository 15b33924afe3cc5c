"""Arguments and logs of a run, as SAC's."""

import math

import pytest

from sb3_lac import LAC


@pytest.mark.parametrize(("ent_coef", "initial"), [("auto", 1.0), ("auto_0.1", 0.1)])
def test_entropy_coefficient_is_learned_from_its_initial_value(make_model, train_metrics, ent_coef, initial):
    model = make_model(ent_coef=ent_coef)
    assert train_metrics(model)["ent_coef"] == pytest.approx(initial)
    assert model.log_ent_coef.item() != pytest.approx(math.log(initial))


def test_entropy_coefficient_and_target_can_be_written_as_text(make_model):
    model = make_model(n_collect=0, ent_coef="0.2", target_entropy="-1.5")
    assert model.log_ent_coef is None
    assert model.ent_coef_tensor.item() == pytest.approx(0.2)
    assert model.target_entropy == -1.5


@pytest.mark.parametrize("name", ["ent_coef", "target_entropy"])
def test_unknown_text_is_an_error(make_model, name):
    with pytest.raises(ValueError, match="could not convert string to float: 'high'"):
        make_model(n_collect=0, **{name: "high"})


def test_each_run_has_a_folder_of_tensorboard_logs(make_env, tmp_path):
    pytest.importorskip("tensorboard")
    model = LAC("MlpPolicy", make_env(), policy_kwargs={"net_arch": [8]}, buffer_size=50, tensorboard_log=str(tmp_path))
    model.learn(20)
    model.learn(20, reset_num_timesteps=False)
    assert [path.name for path in tmp_path.iterdir()] == ["LAC_1"]
    model.learn(20)
    model.learn(20, tb_log_name="other")
    assert {path.name for path in tmp_path.iterdir()} == {"LAC_1", "LAC_2", "other_1"}
