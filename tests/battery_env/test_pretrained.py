"""The policies that come with the package."""

import hashlib
import sys
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from battery_env import (
    AgingPath,
    LeastSquares,
    OnnxPolicy,
    PolicyEstimator,
    SensorErrors,
    TrajectoryDataset,
    calibrate,
    evaluate,
    load_nasa_discharges,
)
from battery_env.estimates import last_estimate
from battery_env.loads import Load
from battery_env.policies.pretrained import file_stem, pretrained_card, pretrained_policy
from battery_env.records.discharge import BUNDLED_CELLS
from battery_env.tasks.data import standard_dataset
from tests.records import recorded
from tests.sweeps import sweep

FOLDER = files("battery_env.policies.pretrained_policies")
ENV_ID = "BatteryVoltageJoint-v0"


@pytest.mark.parametrize("recorded", [False, True])
def test_the_card_is_that_of_the_file(recorded, aged_both):
    content, card = FOLDER.joinpath(f"{file_stem(ENV_ID, recorded)}.onnx").read_bytes(), pretrained_card(ENV_ID, recorded)
    assert len(content) < 1_000_000
    assert hashlib.sha256(content).hexdigest() == card["sha256"]
    policy, options = pretrained_policy(ENV_ID, recorded)
    assert policy.env_id == card["env_id"] == card["recipe"]["env_id"] == ENV_ID
    assert policy.description["algorithm"] == card["algorithm"] == "LAC"
    trained_with = card["recipe"]["hyperparameters"]["env_kwargs"]
    assert trained_with["cost"] == "state" and ("process_noise_V" in trained_with) == recorded
    if recorded:  # along the path of the bundled cells
        assert isinstance(options["path"], AgingPath) and trained_with["reading_s"] == list(options["reading_s"])
        assert card["command"].startswith("python -m benchmarks.aging_paths") and len(card["recipe"]["seed"]) == 5
        assert {row["cell"] for row in card["scores"]} == set(BUNDLED_CELLS)
    else:
        assert options == card["options"] and options.items() <= trained_with.items()
        assert card["command"].startswith("python -m benchmarks.pretrained") and "seed" in card["recipe"]
        assert {row["mismatch"] for row in card["scores"]} == {0.0, 0.1, 0.2}
    env = PolicyEstimator.environment(ENV_ID, dataset=aged_both, **options)
    assert policy.observation_shape == env.observation_space.shape


@pytest.mark.attacks
def test_it_does_what_its_card_says():
    """On a tenth of the discharges, with 5 mV of noise and constants that are off by 20 %."""
    estimator = PolicyEstimator.pretrained()
    data = standard_dataset(estimator.parameters, "piecewise", "test", mismatch=0.2)[:10]
    scores = evaluate(estimator, data, SensorErrors(noise_V=0.005), seed=1)
    for name in estimator.parameters:
        (row,) = (
            row
            for row in pretrained_card(ENV_ID)["scores"]
            if (row["mismatch"], row["sensor"], row["parameter"]) == (0.2, "5 mV noise", name)
        )
        assert scores[f"{name}_second_half_mape_percent"].max() <= row["worst_percent"] + 1e-3
        assert scores[f"{name}_second_half_mape_percent"].mean() < 2.0 * row["mean_percent"]


@pytest.mark.parametrize("cell", sweep(*BUNDLED_CELLS))
def test_on_recorded_cells_the_one_for_them_agrees_with_least_squares_and_settles(cell):
    records = [discharge.loaded_part(2.7) for discharge in load_nasa_discharges(cell)[::24]]
    truth = [LeastSquares(thermal=True, mismatch_V=0.05).estimate(record).q_mobile for record in records]
    estimates = [last_estimate(trace) for trace in PolicyEstimator.pretrained(recorded=True).trace(records)]
    off = np.abs(np.array([estimate.q_mobile for estimate in estimates]) / truth - 1.0)
    assert off.max() < 0.02 and off.mean() < 0.01
    assert np.mean([estimate.settled for estimate in estimates]) > 0.8


class TestWhatIsNotThere:
    """Faults of a record that a policy must not settle on."""

    @pytest.mark.parametrize("share", sweep(0.145, 0.1, 0.13, 0.15, 0.2))
    def test_rows_lost_down_to_the_last_one(self, share):
        record = load_nasa_discharges("B0005")[30]
        first_s, last_s = record.time_s[record.current_A > 1.0][[0, -1]]
        kept = (record.time_s <= last_s - share * (last_s - first_s)) | (record.time_s >= last_s)
        found = calibrate(recorded(record, kept), method="policy")
        off = abs(found.q_mobile_C / LeastSquares(mismatch_V=0.05).estimate(record.loaded_part(2.7)).q_mobile - 1.0)
        assert off < 0.02 or not found.settled_q_mobile

    @pytest.mark.parametrize("offset_A", sweep(0.1, -0.2, -0.03, 0.01, 0.03, 0.2, 0.22))
    def test_an_offset_of_the_current_is_in_the_standard_deviation(self, offset_A):
        record = load_nasa_discharges("B0006")[40]
        truth = calibrate(record, method="policy")
        found = calibrate(replace(record, current_A=record.current_A + offset_A), method="policy")
        assert abs(found.q_mobile_C - truth.q_mobile_C) < 3.0 * found.sd_q_mobile_C

    @pytest.mark.parametrize("load_A", sweep(2.0, 1.0, 4.0))
    def test_pulses_whose_noise_is_not_noise(self, load_A):
        _, options = pretrained_policy(ENV_ID, recorded=True)
        pulses = Load(np.arange(3000) * 10.0, np.tile([load_A, 0.0], 1500), "current")
        for cell in TrajectoryDataset.along(options["path"], 4, [pulses], seed=7):
            found = calibrate(recorded(cell, starts_at_rest=True), method="policy")
            assert abs(found.r_o_ohm / cell.r_o - 1.0) < 0.1 or not found.settled_r_o


@pytest.mark.parametrize("env_id", ["BatteryVoltageRo-v0", "BatteryRo-v0", "../secrets"])
def test_where_there_is_none_the_error_names_those_there_are(env_id):
    with pytest.raises(ValueError, match=r"no policy for '.*' comes with the package: there are BatteryVoltageJoint-v0"):
        PolicyEstimator.pretrained(env_id)


def test_without_onnxruntime_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"needs pip install './battery_env\[onnx\]'"):
        PolicyEstimator.pretrained()


class TestDamage:
    @pytest.fixture
    def copies(self, tmp_path, monkeypatch):
        """The folder of the policies that come with the package, in a place where they may be damaged."""
        for file in FOLDER.iterdir():
            if file.name.endswith((".onnx", ".json")):
                (tmp_path / file.name).write_bytes(file.read_bytes())
        monkeypatch.setattr("battery_env.policies.pretrained.files", lambda _: tmp_path)
        return tmp_path

    @pytest.mark.parametrize("recorded", [False, True])
    @pytest.mark.parametrize("suffix", [".onnx", ".json"])
    def test_a_flipped_bit_is_refused_by_every_door(self, suffix, recorded, copies):
        policy = copies / f"{file_stem(ENV_ID, recorded)}.onnx"
        file, rng = policy.with_suffix(suffix), np.random.default_rng(0)
        whole, sha256 = file.read_bytes(), OnnxPolicy(policy).sha256
        doors = [
            lambda: pretrained_policy(ENV_ID, recorded),
            lambda: PolicyEstimator.pretrained(ENV_ID, recorded=recorded),
            lambda: pretrained_card(ENV_ID, recorded) if suffix == ".json" else OnnxPolicy(policy),
        ]
        for place in (*rng.integers(len(whole), size=40), 0, len(whole) - 2):
            content = bytearray(whole)
            content[place] ^= 1 << rng.integers(8)
            file.write_bytes(content)
            for door in doors:
                with pytest.raises(ValueError, match=f"{policy.stem}.* is damaged"):
                    door()
            if suffix == ".json":  # which the policy itself asks for nothing but a checksum
                try:
                    assert OnnxPolicy(policy).sha256 == sha256
                except ValueError as error:
                    assert "is damaged, or not the policy" in str(error)

    def test_the_command_refuses_them_too(self, copies, terminal):
        for path in copies.glob("*.onnx"):
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 4
            path.write_bytes(content)
        assert "is damaged" in terminal.refuses("B0005:100", "--method", "policy")

    @pytest.mark.parametrize("text", ["{", "[]", "{}", "null", '{"sha256": 3}'[:-1], '{"options": {}}'])
    def test_a_file_of_the_same_name_that_is_no_card_is_none_of_its_business(self, copies, text):
        policy = copies / "BatteryVoltageJoint-v0.onnx"
        policy.with_suffix(".json").write_text(text)
        assert OnnxPolicy(policy).env_id == "BatteryVoltageJoint-v0"
        with pytest.raises(ValueError, match=r"BatteryVoltageJoint-v0\.json is damaged, or no card of a policy"):
            pretrained_policy("BatteryVoltageJoint-v0")
