"""The model against the published reference, against progpy, and against its own invariants."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from battery_env import NEW_CELL, CellParameters, initial_state, simulate, step, voltage
from battery_env.electrochemistry import UNCERTAIN_CONSTANTS, advance_in_place, state_of_charge
from battery_env.electrochemistry.cell import new_cell_of
from battery_env.electrochemistry.kernels import step_batch, voltage_batch

# Tb, Vo, Vsn, Vsp, qnB, qnS, qpB, qpS, V of a new cell, dt 1 s
REFERENCE_2A_THERMAL = {
    1: (292.100000, 0.038515, 0.000077, 0.000029, 6840.000000, 758.000000, 4560.000000, 508.666667, 4.149791),
    60: (292.635829, 0.234425, 0.004465, 0.000966, 6754.521186, 725.478814, 4645.478814, 541.187852, 3.900787),
    600: (293.530937, 0.234430, 0.034505, 0.001313, 5782.680000, 617.320000, 5617.320000, 649.346667, 3.733269),
    1800: (293.715944, 0.234430, 0.065086, 0.001426, 3622.680000, 377.320000, 7777.320000, 889.346667, 3.525836),
    3000: (293.811029, 0.234430, 0.082084, 0.002056, 1462.680000, 137.320000, 9937.320000, 1129.346667, 3.405704),
    3571: (293.887275, 0.234430, 0.096566, 0.004254, 434.880000, 23.120000, 10965.120000, 1243.546667, 3.002716),
}
REFERENCE_8W_ISOTHERMAL = {
    1: (292.1, 0.036757, 0.000075, 0.000027, 6840.000000, 758.091307, 4560.000000, 508.575359, 4.151687),
    60: (292.1, 0.240670, 0.004503, 0.000984, 6753.399297, 724.720707, 4646.600703, 541.945959, 3.893352),
    600: (292.1, 0.252900, 0.035448, 0.001405, 5729.593573, 609.449053, 5670.406427, 657.217613, 3.706245),
    1800: (292.1, 0.270540, 0.069347, 0.001683, 3316.879615, 339.467750, 8083.120385, 927.198917, 3.465343),
    3000: (292.1, 0.287304, 0.094277, 0.003586, 774.787937, 55.254009, 10625.212063, 1211.412658, 3.257963),
    3101: (292.1, 0.309179, 0.098459, 0.004853, 546.809368, 27.789045, 10853.190632, 1238.877622, 3.004657),
}

Q_MOBILE = st.floats(3500.0, 8000.0)


@pytest.mark.parametrize(
    ("load", "load_unit", "thermal", "reference", "eod_time_s"),
    [
        (2.0, "current", True, REFERENCE_2A_THERMAL, 3572),
        (8.0, "power", False, REFERENCE_8W_ISOTHERMAL, 3102),
        (8.0, "power", True, {}, 3101),
    ],
)
def test_reference_trajectories_to_all_printed_digits(load, load_unit, thermal, reference, eod_time_s):
    discharge = simulate(load, 7600.0, 0.117215, load_unit=load_unit, thermal=thermal)
    assert discharge.eod_time_s == eod_time_s
    for t, expected in reference.items():
        found = [*discharge.state[t], discharge.voltage_V[t]]
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=5.1e-7, err_msg=f"t = {t}")


@pytest.mark.parametrize("size", [0.2, 4.0, 30.0])
def test_a_cell_of_another_size_has_the_same_voltage_and_temperature_at_as_much_more_current(size):
    other = new_cell_of(size * NEW_CELL.q_mobile)
    cells = ((NEW_CELL, 2.0), (other, 2.0 * size))
    one, same = (simulate(amperes, load_unit="current", thermal=True, cell=cell) for cell, amperes in cells)
    np.testing.assert_allclose(same.voltage_V, one.voltage_V, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(same.state[:, 0], one.state[:, 0], rtol=1e-9)


def test_agrees_with_progpy_on_random_cells_and_loads():
    progpy_models = pytest.importorskip("progpy.models")
    rng = np.random.default_rng(0)
    for _ in range(15):
        q_mobile, r_o = rng.uniform(4000.0, 7600.0), rng.uniform(0.08, 0.3)
        load = np.repeat(rng.uniform(0.0, 3.0, size=12), 25)
        # given to the constructor: set later, progpy's initial state would stay that of the new cell
        peer = progpy_models.BatteryElectroChemEOD(qMobile=q_mobile, Ro=r_o)
        ours = simulate(load, q_mobile, r_o, load_unit="current", thermal=True, until=len(load) - 1.0)
        x = peer.initialize()
        for k in range(len(ours.time_s)):
            values = dict(zip(x.keys(), np.asarray(x.matrix, dtype=float)[:, 0], strict=True))
            expected = [values[name] for name in ("tb", "Vo", "Vsn", "Vsp", "qnB", "qnS", "qpB", "qpS")]
            np.testing.assert_allclose(ours.state[k], expected, rtol=1e-9, atol=1e-9)
            assert ours.voltage_V[k] == pytest.approx(float(peer.output(x)["v"]), abs=1e-9)
            x = peer.next_state(x, peer.InputContainer({"i": load[k]}), 1.0)


@given(Q_MOBILE)
def test_full_charge_has_the_same_voltage_for_every_cell(q_mobile):
    assert voltage(initial_state(q_mobile), q_mobile) == pytest.approx(4.191350, abs=5e-7)
    assert state_of_charge(initial_state(q_mobile), np.array(q_mobile)) == pytest.approx(1.0)


@pytest.mark.parametrize(("load_unit", "thermal"), [("power", False), ("current", True)])
def test_a_cell_comes_out_the_same_in_a_batch_of_any_size_and_on_its_own_way(load_unit, thermal):
    # blocks, their remainders, constants of each cell's own, and ways of different lengths
    rng = np.random.default_rng(3)
    n = 150
    q, r, steps = rng.uniform(5000.0, 7600.0, n), rng.uniform(0.1, 0.2, n), rng.integers(0, 9, n)
    loads, first = rng.uniform(1.0, 3.0, 60), rng.integers(0, 50, n)
    factors = np.exp(0.1 * rng.standard_normal((n, 4)))
    known = np.array([getattr(NEW_CELL, name) for name in UNCERTAIN_CONSTANTS])
    cells = [NEW_CELL.replace(**dict(zip(UNCERTAIN_CONSTANTS, known * each, strict=True))) for each in factors]
    for own, constants in ((False, [NEW_CELL] * n), (True, cells)):
        packed = NEW_CELL.packed_with(factors) if own else NEW_CELL.packed
        state = initial_state(q)
        advance_in_place(state, loads, first, steps, q, r, 1.0, load_unit, thermal, packed)
        volts = np.empty(n)
        voltage_batch(state, q, False, packed, volts)
        for m in range(0, n, 7):
            one = initial_state(q[m])
            for k in range(steps[m]):
                one = step(one, loads[first[m] + k], q[m], r[m], 1.0, load_unit, thermal, cell=constants[m])
            rtol = 0.0 if constants[m] is NEW_CELL else 1e-14  # a constant times a factor is rounded twice
            np.testing.assert_allclose(state[m], one, rtol=rtol)
            np.testing.assert_allclose(volts[m], voltage(one, q[m]), rtol=rtol)
        out, is_power = np.empty_like(state), load_unit == "power"
        step_batch(state, loads[first], q, r, 1.0, is_power, thermal, False, packed, out)
        for size in (1, 3, 64, 65):
            part = np.empty((size, 8))
            some = NEW_CELL.packed_with(factors[:size]) if own else packed
            step_batch(state[:size], loads[first][:size], q[:size], r[:size], 1.0, is_power, thermal, False, some, part)
            np.testing.assert_array_equal(part, out[:size])


def test_roll_out_equals_single_steps():
    load = np.random.default_rng(2).uniform(2.0, 10.0, 50)
    discharge = simulate(load, 6500.0, 0.13)
    state = initial_state(6500.0)
    for k in range(50):
        np.testing.assert_array_equal(discharge.state[k], state)
        assert discharge.current_A[k] == pytest.approx(load[k] / discharge.voltage_V[k], rel=1e-15)
        state = step(state, load[k], 6500.0, 0.13)


def test_smaller_time_steps_converge():
    ends = [simulate(8.0, 7600.0, 0.117215, dt=dt).eod_time_s for dt in (1.0, 0.5, 0.25)]
    assert abs(ends[1] - ends[0]) <= 2.0 and abs(ends[2] - ends[1]) <= 1.0


def test_simulation_stops_where_it_is_told():
    assert len(simulate(2.0, 7600.0, 0.1, until=100.0).time_s) == 101
    assert np.isnan(simulate(2.0, 7600.0, 0.1, until=100.0).eod_time_s)
    assert len(simulate(np.full(40, 2.0), 7600.0, 0.1).time_s) == 40
    assert simulate(0.0, 7600.0, 0.1).time_s[-1] == 86_400.0


def test_extended_model_is_the_model_where_it_is_defined_and_finite_where_not():
    discharge = simulate(12.0, 6000.0, 0.12)
    state, n = discharge.state, len(discharge.state)
    load, q, r = np.full(n, 12.0), np.full(n, 6000.0), np.full(n, 0.12)
    plain, extended = np.empty_like(state), np.empty_like(state)
    for is_extended, out in ((False, plain), (True, extended)):
        step_batch(state, load, q, r, 1.0, True, False, is_extended, NEW_CELL.packed, out)
    np.testing.assert_array_equal(plain, extended)
    for wrong in (4000.0, 8000.0):
        step_batch(state, load, np.full(n, wrong), r, 1.0, True, False, True, NEW_CELL.packed, extended)
        assert np.isfinite(extended).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q_mobile": 2.1}, "q_mobile must lie within .* C, got 2.1. Ampere-hours"),
        ({"q_mobile": np.nan}, "q_mobile"),
        ({"r_o": 117.0}, "r_o must lie within .* ohm, got 117. Milliohms"),
        ({"r_o": -0.1}, "r_o"),
        ({"load": 8000.0}, "load must lie within .* W, got 8000"),
        ({"load": np.inf}, "load"),
        ({"load_unit": "mA"}, "load_unit must be 'power'"),
        ({"dt": 12.3}, "dt must be .* at most 12.17 s .* got 12.3"),
        ({"dt": 0.0}, "dt"),
        ({"dt": float("nan")}, "dt"),
    ],
)
@pytest.mark.parametrize("function", [step, simulate])
def test_values_out_of_range_are_refused(function, arguments, message):
    valid = {"load": 8.0, "q_mobile": 7600.0, "r_o": 0.117215} | arguments
    if function is step:
        valid["state"] = initial_state(7600.0)
    with pytest.raises(ValueError, match=message):
        function(**valid)


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"state must have shape \(\.\.\., 8\)"):
        step(np.zeros(7), 8.0, 7600.0, 0.1)
    with pytest.raises(ValueError, match="one value a step"):
        simulate(np.full((3, 2), 2.0), 7600.0, 0.1, until=2.0)
    with pytest.raises(TypeError, match="q_mobile must be a number"):
        initial_state("full")
    with pytest.raises(ValueError, match="until must be"):
        simulate(8.0, 7600.0, 0.1, until="empty")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q_mobile": -1.0}, "q_mobile"),
        ({"kn": 0.0}, "kn must be greater than 0"),
        ({"Ap": (np.nan,)}, "Ap must be finite"),
        ({"Ap": (1.0,) * 14}, "1 to 13 coefficients"),
        ({"VolSFraction": 1.5}, "VolSFraction"),
        ({"kn": 1e308}, r"kn is more than 1e\+09 times off the 2120.96 of a new 18650"),
        ({"R": 1.0}, "R is more than 1.01 times off"),
        ({"Ap": (1e300,)}, "Ap is more than"),
        ({"mC": True}, "mC must be float, got True"),
    ],
)
def test_constants_out_of_range_are_refused(changes, message):
    with pytest.raises((TypeError, ValueError), match=message):
        CellParameters(**changes)


def test_a_cell_brings_its_own_age():
    aged = NEW_CELL.replace(q_mobile=6000.0, r_o=0.2)
    own, given = simulate(8.0, cell=aged), simulate(8.0, 6000.0, 0.2)
    np.testing.assert_array_equal(own.state, given.state)
    assert (own.cell, own.q_mobile, own.r_o) == (aged, 6000.0, 0.2) == (given.cell, given.q_mobile, given.r_o)
    state = initial_state(cell=aged)
    np.testing.assert_array_equal(state, initial_state(6000.0))
    np.testing.assert_array_equal(voltage(state, cell=aged), voltage(state, 6000.0))
    np.testing.assert_array_equal(step(state, 8.0, cell=aged), step(state, 8.0, 6000.0, 0.2))
    # what is given goes before what the cell brings
    np.testing.assert_array_equal(simulate(8.0, 7000.0, cell=aged).state, simulate(8.0, 7000.0, 0.2).state)
