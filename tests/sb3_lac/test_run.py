"""Arguments and logs of a run, as SAC's."""

import math

import pytest


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
