"""The policies that come with the package."""

import hashlib
import json
import subprocess
import sys
from dataclasses import asdict
from importlib.resources import files

import numpy as np
import pytest

from battery_env import LeastSquares, PolicyEstimator, evaluate, load_nasa_discharges
from battery_env.electrochemistry import NEW_CELL
from battery_env.policies.pretrained import file_stem, policy_of_file, pretrained_card, pretrained_policy
from battery_env.records.discharge import BUNDLED_CELLS
from battery_env.sensors import SensorErrors
from battery_env.tasks.data import standard_dataset

FOLDER = files("battery_env.policies.pretrained_policies")
IDS = {"BatteryVoltageJoint-v0": ("q_mobile", "r_o"), "BatteryVoltageQmax-v0": "q_mobile", "BatteryVoltageRo-v0": "r_o"}


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("env_id", IDS)
def test_the_card_is_that_of_the_file(env_id, recorded, aged_both):
    content, card = FOLDER.joinpath(f"{file_stem(env_id, recorded)}.onnx").read_bytes(), pretrained_card(env_id, recorded)
    assert len(content) < 1_000_000
    assert hashlib.sha256(content).hexdigest() == card["sha256"]
    policy, options = pretrained_policy(env_id, recorded)
    assert policy.env_id == card["env_id"] == card["recipe"]["env_id"] == env_id
    assert policy.description["algorithm"] == card["algorithm"] == "LAC"
    assert options == card["options"]
    trained_with = card["recipe"]["hyperparameters"]["env_kwargs"]
    assert options.items() <= trained_with.items() and trained_with["cost"] == "state"
    assert ("process_noise_V" in trained_with) == recorded
    assert card["command"].startswith("python -m benchmarks.pretrained") and "seed" in card["recipe"]
    assert {row["mismatch"] for row in card["scores"]} == {0.0, 0.1, 0.2}
    env = PolicyEstimator.environment(env_id, dataset=aged_both, **options)
    assert policy.observation_shape == env.observation_space.shape


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("env_id", IDS)
def test_it_does_what_its_card_says(env_id, recorded):
    """On a tenth of the discharges, with 5 mV of noise and constants that are off by 20 %."""
    data = standard_dataset(IDS[env_id], "piecewise", "test", mismatch=0.2)[:10]
    estimator = PolicyEstimator.pretrained(env_id, recorded=recorded)
    scores = evaluate(estimator, data, SensorErrors(noise_V=0.005), seed=1)
    for name in estimator.parameters:
        (row,) = (
            row
            for row in pretrained_card(env_id, recorded)["scores"]
            if (row["mismatch"], row["sensor"], row["parameter"]) == (0.2, "5 mV noise", name)
        )
        assert scores[f"{name}_second_half_mape_percent"].max() <= row["worst_percent"] + 1e-3
        assert scores[f"{name}_second_half_mape_percent"].mean() < 2.0 * row["mean_percent"]


@pytest.mark.parametrize("cell", BUNDLED_CELLS)
def test_on_recorded_cells_the_one_for_them_agrees_with_least_squares(cell):
    records = [discharge.loaded_part(2.7) for discharge in load_nasa_discharges(cell)[::40]]
    truth = [LeastSquares(thermal=True, mismatch_V=0.05).estimate(record).q_mobile for record in records]
    off = {}
    for recorded in (False, True):
        estimator = PolicyEstimator.pretrained(recorded=recorded)
        estimates = np.array([estimator.estimate(record).q_mobile for record in records])
        off[recorded] = np.abs(estimates / truth - 1.0)
    assert off[True].max() < 0.04 and off[True].mean() < 0.6 * off[False].mean()


def test_it_needs_no_torch():
    code = (
        "import sys; sys.modules['torch'] = None; sys.modules['stable_baselines3'] = None\n"
        "from battery_env import PolicyEstimator, load_nasa_discharges\n"
        "print(PolicyEstimator.pretrained().estimate(load_nasa_discharges('B0005')[0].loaded_part(2.7)).q_mobile)\n"
    )
    q_mobile = float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert 6000.0 < q_mobile < 8000.0


@pytest.mark.parametrize("env_id", ["BatteryAging-v0", "BatteryRo-v0", "../secrets"])
def test_where_there_is_none_the_error_names_those_there_are(env_id):
    with pytest.raises(ValueError, match=r"no policy for '.*' comes with the package: there are BatteryVoltageJoint-v0, B"):
        PolicyEstimator.pretrained(env_id)


def test_without_onnxruntime_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"needs pip install 'battery_env\[onnx\]'"):
        PolicyEstimator.pretrained()


def test_a_stream_does_not_go_on_with_another_policy(tmp_path):
    stream = PolicyEstimator.pretrained()
    stream.update(4.19, 2.0, 0.0)
    saved = stream.save(tmp_path / "state.npz")
    PolicyEstimator.pretrained().load(saved)
    with pytest.raises(ValueError, match="is of an estimator with policy = "):
        PolicyEstimator.pretrained(recorded=True).load(saved)


class TestFiles:
    @pytest.fixture
    def copy(self, tmp_path):
        path = tmp_path / "mine.onnx"
        path.write_bytes(FOLDER.joinpath("BatteryVoltageRo-v0.onnx").read_bytes())
        return path

    def test_a_card_says_the_options_and_the_constants(self, copy):
        policy, options = policy_of_file(copy)
        assert options == {} and policy.env_id == "BatteryVoltageRo-v0"
        cell = NEW_CELL.replace(kn=1000.0)
        copy.with_suffix(".json").write_text(json.dumps({"options": {"reading_s": 5.0, "cell": asdict(cell)}}))
        assert policy_of_file(copy)[1] == {"reading_s": 5.0, "cell": cell}

    def test_a_policy_that_its_card_is_not_of_is_refused(self, copy):
        copy.with_suffix(".json").write_text(FOLDER.joinpath("BatteryVoltageRo-v0.json").read_text())
        content = bytearray(copy.read_bytes())
        assert policy_of_file(copy)[1]["reading_s"] == 2.0
        content[content.index(b"BatteryVoltageRo")] ^= 1
        copy.write_bytes(content)
        with pytest.raises(ValueError, match=r"mine\.onnx is damaged, or not the policy that .*mine\.json is of"):
            policy_of_file(copy)

    @pytest.mark.parametrize("text", ["{", "[]", "{}", "null", '{"options": 3}', '{"options": {"cell": {"kn": 1000.0}}}'])
    def test_a_card_that_is_none_is_refused(self, copy, text):
        copy.with_suffix(".json").write_text(text)
        with pytest.raises(ValueError, match="has to be an object in JSON with the options of the task"):
            policy_of_file(copy)
