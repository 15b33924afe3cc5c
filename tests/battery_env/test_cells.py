import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from battery_env.files import call_in_process
from battery_env.lab.readers import nasa
from battery_env.lab.readers.discharges import read_discharges
from battery_env.records import integrate_load, resample_current
from battery_env.records.discharge import BUNDLED_CELLS, Discharge, load_nasa_discharges
from tests.sweeps import sweep


def recorded(**changes) -> dict:
    """Two samples at rest, a load of 2 A from about 15 s on, and a cut-off between two samples."""
    arrays = {
        "time_s": [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0],
        "voltage_V": [4.19, 4.19, 3.9, 3.5, 3.0, 2.6, 3.1],
        "current_A": [0.0, 0.01, 2.0, 2.02, 2.01, 2.0, 0.0],
        "temperature_C": [24.0, 24.0, 24.5, 25.0, 25.5, 26.0, 26.0],
    }
    return arrays | changes


@pytest.fixture(scope="module")
def bundled() -> dict[str, list[Discharge]]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return {cell: load_nasa_discharges(cell) for cell in BUNDLED_CELLS}


class TestDischarge:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"voltage_V": [4.1, 3.9]}, r"voltage_V must hold one value a sample, at least 5.*\(2,\)"),
            ({"voltage_V": [4.1] * 6}, "voltage_V has 6 samples, but time_s has 7"),
            ({"voltage_V": np.ones((7, 2))}, r"shape \(7, 2\)"),
            ({"current_A": [0.0, 0.0, np.nan, 2.0, 2.0, 2.0, 0.0]}, "current_A must be finite, got nan at sample 2"),
            ({"current_A": [0.0, 0.0, 1e-300, 1e-300, 1e-300, 1e-300, 0.0]}, "current_A must reach 2e-13 A, got 1e-300 A"),
            ({"time_s": [0.0, 10.0, 20.0, 20.0, 40.0, 50.0, 60.0]}, "sample 3 is at 20 s, after 20 s"),
            ({"time_s": np.arange(7) / 3600.0}, "seconds: 144 s if it is in days"),
            ({"time_s": np.arange(7) * 1e6}, "milliseconds"),
            ({"voltage_V": np.full(7, 3900.0)}, "voltage_V must lie within -0.1 .. 5.5 V, got 3900 at sample 0.*not in mV"),
            ({"current_A": np.full(7, 2000.0)}, "current_A must lie within -1000 .. 1000 A, got 2000.*not in mA"),
            ({"time_s": 1e4 * np.arange(7), "current_A": np.full(7, 500.0)}, "draws 3e.07 C.*not in mA"),
            ({"temperature_C": np.full(7, 297.0)}, "got 297.*not in kelvin"),
            ({"current_A": np.full(7, -2.0)}, "draws -120 C.*flip the sign.*--discharge-is-negative"),
            ({"voltage_V": ["4.1", "3.9", "ERROR", "3.5", "3.4", "3.0", "3.0"]}, "voltage_V must hold numbers"),
            ({"current_A": np.full(7, 2.0 + 1.0j)}, "current_A must hold real numbers, got np.complex128"),
            ({"current_A": np.arange(7) > 1}, "current_A must hold real numbers, got np.False_"),
            ({"current_A": [0.0, 0.0, 2.0, True, 2.0, 2.0, 0.0]}, "current_A must hold real numbers, got True"),
            ({"voltage_V": pd.Series([True] * 7, dtype="boolean")}, "voltage_V must hold real numbers, got np.True_"),
            ({"current_A": np.ma.masked_less(np.arange(7.0), 1.0)}, "current_A must hold real numbers"),
            ({"time_s": None}, "time_s must hold real numbers"),
            ({"time_s": pd.date_range("2026-02-28", periods=7)}, "time_s must hold numbers, got dates. read_discharges takes"),
        ],
    )
    def test_refuses_what_cannot_be_meant_and_says_what_to_do(self, changes, message):
        with pytest.raises((TypeError, ValueError), match=message) as caught:
            Discharge(**recorded(**changes))
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(("rest_every_s", "gap_s"), [(600.0, 600.0), (600.0, 20.0), (120.0, 200.0)])
    def test_a_rest_that_is_seldom_logged_does_not_switch_the_load_on_before_its_samples(self, rest_every_s, gap_s):
        rest_s = rest_every_s * np.arange(4)
        loaded_s = rest_s[-1] + gap_s + 10.0 * np.arange(60)
        current_A = np.repeat([0.0, 2.0], [4, 60])
        voltage_V = np.append(np.full(4, 4.19), np.linspace(3.9, 2.6, 60))
        discharge = Discharge(np.append(rest_s, loaded_s), voltage_V, current_A)
        assert discharge.load_on_time_s == loaded_s[0] - 10.0
        assert discharge.loaded_part(2.0).charge_C == pytest.approx(2.0 * 600.0)

    def test_end_of_discharge_is_interpolated(self):
        discharge = Discharge(**recorded())
        assert discharge.eod_time_s(2.7) == pytest.approx(47.5)
        assert discharge.eod_time_s(3.0) == 40.0
        assert np.isnan(discharge.eod_time_s(2.1))

    @pytest.mark.parametrize("count", [1, 3])
    @pytest.mark.parametrize("period", [1000, 20, 7])
    def test_a_voltage_that_only_seems_to_be_below_the_cut_off_is_refused(self, period, count):
        sample, time_s = np.arange(300), 10.0 * np.arange(300)
        current_A = np.where(sample < 10, 0.0, np.where(sample % period < 5, 1.5, 2.0))
        voltage_V = np.where(sample < 10, 4.19, np.linspace(4.2, 2.6, 300) - 0.1 * current_A)
        clean = Discharge(time_s, voltage_V, current_A)
        assert clean.loaded_part(2.7).time_s[-1] == clean.eod_time_s(2.7) > 2400.0
        for position in (12, 200):
            wild = voltage_V.copy()
            wild[position : position + count] = 2.0
            for method in (Discharge.eod_time_s, Discharge.loaded_part):
                message = rf"falls to 2.00 V at {10 * position} s and is back .* fault of the sensor.*\({count}\)"
                with pytest.raises(ValueError, match=message):
                    method(Discharge(time_s, wild, current_A), 2.7)

    def test_a_load_that_is_logged_a_sample_early_explains_the_voltage_after_it(self):
        current_A = np.array([0.0, *[2.0] * 8, 0.2, 0.2, 0.2])
        voltage_V = np.array([4.2, *np.linspace(3.5, 2.74, 8), 2.68, 2.78, 2.80])
        assert Discharge(np.arange(12.0), voltage_V, current_A).eod_time_s(2.7) == pytest.approx(8.7, abs=0.05)

    def test_the_end_under_a_heavy_load_is_an_end_though_the_voltage_comes_back(self):
        time_s = 10.0 * np.arange(40)
        current_A = np.where(np.arange(40) < 2, 0.0, np.where(np.arange(40) % 10 == 9, 6.0, 1.0))
        voltage_V = np.linspace(4.2, 3.2, 40) - 0.12 * current_A
        discharge = Discharge(time_s, voltage_V, current_A)
        assert discharge.eod_time_s(2.8) == pytest.approx(288.0, abs=10.0)
        # and so is one after which the cell was charged, or rested
        spliced = np.append(np.linspace(3.9, 2.65, 20), np.linspace(3.9, 2.65, 20))
        assert Discharge(time_s, spliced, np.full(40, 2.0)).eod_time_s(2.7) == pytest.approx(182.4, abs=0.1)

    @pytest.mark.parametrize("behind_s", [0.02, 0.2, 2.0, 4.0])
    @pytest.mark.parametrize("noise_V", [0.0, 0.001, -0.001])
    def test_the_row_of_the_end_may_lie_just_behind_a_regular_one(self, behind_s, noise_V):
        time_s = np.append(10.0 * np.arange(40), 390.0 + behind_s)
        voltage_V = 2.7 + 0.001 + 0.003 * (time_s[-1] - time_s) + 0.5 * (np.arange(41) < 2)
        voltage_V[-1] += noise_V
        record = Discharge(time_s, voltage_V, np.where(np.arange(41) < 2, 0.0, 2.0))
        assert record.eod_time_s(2.7) == pytest.approx(time_s[-1], abs=0.1)
        # nor is one that ends a fall above it
        assert np.isnan(record.eod_time_s(2.6))

    def test_loaded_part_runs_from_the_switch_to_the_cut_off(self):
        part = Discharge(**recorded(), meta={"cell": "X"}).loaded_part(2.7)
        np.testing.assert_allclose(part.time_s, [15.0, 20.0, 30.0, 40.0, 47.5])
        np.testing.assert_allclose(part.voltage_V, [4.19, 3.9, 3.5, 3.0, 2.7])
        np.testing.assert_allclose(part.current_A, [2.0, 2.0, 2.02, 2.01, 2.0025])
        np.testing.assert_allclose(part.temperature_C, [24.25, 24.5, 25.0, 25.5, 25.875])
        assert part.meta == {"cell": "X"}
        np.testing.assert_array_equal(part.loaded_part(2.7).time_s, part.time_s)
        # where it has not ended, with its last sample under load
        assert Discharge(**recorded()).loaded_part(2.0).time_s[-1] == 50.0

    @settings(max_examples=40)
    @given(st.integers(0, 1000), st.floats(0.5, 40.0), st.integers(8, 200))
    def test_averaging_keeps_the_ends_and_the_charge(self, seed, dt_s, samples):
        random = np.random.default_rng(seed)
        time_s = 5.0 + np.cumsum(random.uniform(0.5, 3.0, samples))
        assume(time_s[-1] - time_s[0] > 10.0 + 4.0 * dt_s)
        current_A = np.repeat(random.uniform(1.0, 3.0, samples // 8 + 1), 8)[:samples]
        discharge = Discharge(time_s, np.linspace(4.2, 3.0, samples), current_A, np.linspace(24.0, 30.0, samples))
        mean = discharge.averaged(dt_s)
        assert len(mean.time_s) <= (time_s[-1] - time_s[0]) / dt_s + 3
        for name in ("time_s", "voltage_V", "current_A", "temperature_C"):
            np.testing.assert_array_equal(getattr(mean, name)[[0, -1]], getattr(discharge, name)[[0, -1]])
        # half a stretch at either end has the current of its sample
        assert mean.charge_C == pytest.approx(discharge.charge_C, abs=4.0 * (dt_s + 3.0))

    def test_parts_are_checked_for_what_is_left_of_them_and_cannot_be_written_to_either(self):
        part = Discharge(**recorded(), meta={"cell": "X"}, starts_at_rest=True).until(55.0)
        np.testing.assert_array_equal(part.time_s, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0])
        assert part.starts_at_rest and part.meta == {"cell": "X"} and part.without_temperature().temperature_C is None
        for each in (part, part.loaded_part(2.7), part.averaged(5.0)):
            with pytest.raises(ValueError, match="read-only"):
                each.voltage_V[0] = 0.0
        with pytest.raises(ValueError, match="draws 0 C in total"):
            Discharge(**recorded(current_A=[0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0])).until(40.0)


class TestResampling:
    def test_load_steps_at_the_midpoint_and_does_not_ramp(self):
        discharge = Discharge(**recorded())
        current_A = resample_current(discharge.time_s, discharge.current_A, 1.0, 60)
        np.testing.assert_allclose(current_A[:10], 0.001 * (np.arange(10) + 0.5))
        np.testing.assert_allclose(current_A[10:15], 0.01)
        np.testing.assert_allclose(current_A[15:20], 2.0)
        np.testing.assert_allclose(current_A[20:22], [2.001, 2.003])
        np.testing.assert_allclose(current_A[55:], 0.0)

    def test_simulated_records_are_taken_as_they_are(self):
        time_s, current_A = np.arange(50) * 1.0, np.random.default_rng(0).uniform(0.0, 5.0, 50)
        resampled = resample_current(time_s, current_A, 1.0, 53)
        np.testing.assert_array_equal(resampled[:50], current_A)
        np.testing.assert_array_equal(resampled[50:], current_A[-1])

    @settings(max_examples=60)
    @given(gaps=st.lists(st.floats(0.05, 30.0), min_size=4, max_size=40), dt_s=st.floats(0.1, 5.0), seed=st.integers(0, 1000))
    def test_no_charge_is_lost(self, gaps, dt_s, seed):
        time_s = np.concatenate([[0.0], np.cumsum(gaps)])
        current_A = np.random.default_rng(seed).choice([0.0, 0.05, 1.9, 2.0, 2.1], size=len(time_s))
        assume(not np.allclose(np.diff(time_s), dt_s))  # such records are simulated ones, taken as they are
        n_steps = int(np.ceil(time_s[-1] / dt_s)) + 1
        drawn_C = float(integrate_load(time_s, current_A, n_steps * dt_s))
        assert dt_s * resample_current(time_s, current_A, dt_s, n_steps).sum() == pytest.approx(drawn_C, abs=1e-9)


class TestBundledCells:
    def test_first_discharge_is_as_published(self, bundled):
        first = bundled["B0005"][0]
        assert first.meta["capacity_Ah"] == pytest.approx(1.8565, abs=1e-4)
        assert first.meta["start_time"].startswith("2008-04-02T15:25:41")
        assert first.meta["ambient_temperature_C"] == 24
        assert first.meta["Re_ohm"] == pytest.approx(0.04467, abs=1e-5)
        assert "Saha" in first.meta["source"]
        assert len(first.time_s) == 197 and first.temperature_C is not None
        assert first.load_on_time_s == pytest.approx((16.781 + 35.703) / 2)

    @pytest.mark.parametrize("cell", BUNDLED_CELLS)
    def test_charge_to_cut_off_is_the_published_capacity(self, bundled, cell):
        assert [discharge.meta["cycle"] for discharge in bundled[cell]] == list(range(1, 169))
        for discharge in bundled[cell]:
            # the published one counts up to the first sample below 2.7 V, at most one interval of 20 s later
            late_C = 3600.0 * discharge.meta["capacity_Ah"] - discharge.loaded_part(2.7).charge_C
            assert discharge.meta["cell"] == cell and -5.0 < late_C < 45.0

    def test_other_cells_are_refused(self):
        with pytest.raises(FileNotFoundError, match=r"B0007.* but B0005, B0006; read_discharges reads files"):
            load_nasa_discharges("B0007")


class TestNasaMatFile:
    @staticmethod
    def write(path: Path, broken: bool = False) -> Path:
        """Write the layout of NASA's B0005.mat: charge, discharge, impedance, and one discharge without capacity."""
        arrays = {name: np.array(values) for name, values in recorded().items()}
        data = {
            "Voltage_measured": arrays["voltage_V"],
            "Current_measured": -arrays["current_A"],
            "Temperature_measured": arrays["temperature_C"],
            "Time": arrays["time_s"],
        }
        short = {name: values[:2] for name, values in data.items()}

        def test(kind: str, hour: float, data: dict) -> dict:
            time = np.array([2008.0, 4.0, 2.0, hour, 25.0, 41.593])
            return {"type": kind, "ambient_temperature": 24, "time": time, "data": data}

        cycle = np.array(
            [
                test("charge", 13.0, {"Voltage_charge": np.ones(3)}),
                test("discharge", 15.0, data | {"Capacity": 1.8565}),
                test("impedance", 16.0, {"Re": 0.0447, "Rct": 0.0695}),
                test("impedance", 23.0, {"Re": 0.05, "Rct": 0.07}),
                test("discharge", 22.0, short if broken else data | {"Capacity": np.array([])}),
            ],
            dtype=object,
        )
        savemat(path, {path.stem: {"cycle": cycle}})
        return path

    def test_discharges_are_read_with_the_sign_of_the_current_turned(self, tmp_path):
        first, second = read_discharges(self.write(tmp_path / "B0018.mat"))
        np.testing.assert_allclose(first.current_A, recorded()["current_A"])
        np.testing.assert_allclose(first.time_s, recorded()["time_s"])
        assert first.meta["cell"] == "B0018"
        assert (first.meta["cycle"], second.meta["cycle"]) == (1, 2)
        assert (first.meta["test_id"], second.meta["test_id"]) == (1, 4)
        assert first.meta["start_time"] == "2008-04-02T15:25:41.593"
        assert first.meta["capacity_Ah"] == 1.8565 and "capacity_Ah" not in second.meta
        assert (first.meta["Re_ohm"], second.meta["Re_ohm"]) == (0.0447, 0.05)

    def test_a_broken_discharge_does_not_lose_the_others(self, tmp_path):
        path = self.write(tmp_path / "B0018.mat", broken=True)
        with pytest.warns(UserWarning, match="It is left out: .*discharge 2: 2 rows are no discharge"):
            assert [discharge.meta["cycle"] for discharge in read_discharges(path)] == [1]

    @pytest.mark.filterwarnings("ignore::UserWarning")
    @pytest.mark.parametrize("at", sweep(448, *range(128, 1024, 16)))
    def test_a_tag_that_is_damaged_does_not_end_the_process_that_asks_for_a_file(self, at, tmp_path):
        path = self.write(tmp_path / "B0018.mat")
        content = bytearray(path.read_bytes())
        content[at : at + 4] = (20).to_bytes(4, "little")  # no kind of number
        path.write_bytes(content)
        with suppress(ValueError):
            read_discharges(path)

    def test_a_reader_that_dies_is_an_error_of_its_file_alone(self, tmp_path, monkeypatch):
        self.write(tmp_path / "B1.mat")
        monkeypatch.setattr(nasa, "call_in_process", lambda *given, **options: call_in_process("os", "_exit", 139))
        with pytest.raises(ValueError, match=r"B1\.mat: the file is damaged, .*os\._exit ended its process with 139"):
            read_discharges(tmp_path / "B1.mat")

    @pytest.mark.parametrize("content", [{"x": np.ones(3)}, {"B1": {"cycle": {"type": "discharge", "time": np.ones(2)}}}])
    def test_other_files_are_refused(self, content, tmp_path):
        savemat(tmp_path / "B1.mat", content)
        for size in (None, -100):
            (tmp_path / "B1.mat").write_bytes((tmp_path / "B1.mat").read_bytes()[:size])
            with pytest.raises(ValueError, match=r"B1\.mat.* damaged"):
                read_discharges(tmp_path / "B1.mat")
