"""What is handed to the package from outside gives a right result, or an error that says what was wrong with what."""

import copy
import dataclasses
import pickle
from datetime import datetime

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

import battery_env
from battery_env.loads import RandomPiecewise
from battery_env.tasks.registration import TASKS

NUMBERS = st.floats() | st.integers(-(2**63), 2**63 - 1) | st.floats(0.0, 1e4)
ARRAYS = arrays(np.float64, array_shapes(min_side=0), elements=st.floats() | st.floats(0.0, 1e4))
JUNK = st.one_of(
    st.none(),
    st.text("AhmWΩ, "),
    st.binary(min_size=1).map(lambda contents: contents + b"W"),
    st.just(1j),
    st.lists(st.text("AhmWΩ, "), min_size=1),
    st.just([[1.0], [1.0, 2.0]]),
    st.dictionaries(st.text(), st.floats()),
    st.builds(object),
    st.just(datetime(2020, 1, 1)),
)
FAST = settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def right_or_refused(call, *names):
    """The result, or ``None`` if it was refused with an error that names one of ``names``."""
    try:
        return call()
    except (TypeError, ValueError) as error:
        assert any(name in str(error) for name in names), f"{error!r} names none of {names}"
        return None


@pytest.fixture(scope="module")
def data():
    return battery_env.TrajectoryDataset.generate(("q_mobile", "r_o"), 20, RandomPiecewise(), seed=0)


class TestModel:
    @FAST
    @given(name=st.sampled_from(["load", "q_mobile", "r_o"]), value=NUMBERS | ARRAYS | JUNK)
    def test_a_step_is_a_number_wherever_there_is_a_voltage(self, name, value):
        state = battery_env.initial_state(7600.0)
        arguments = {"load": 8.0, "q_mobile": 7600.0, "r_o": 0.1} | {name: value}
        after = right_or_refused(lambda: battery_env.step(state, **arguments), name)
        if after is not None:
            assert after.shape == (*np.shape(value), 8) and after.dtype == np.float64
            volts = battery_env.voltage(state, arguments["q_mobile"])
            np.testing.assert_array_equal(np.isfinite(after).all(axis=-1), np.broadcast_to(volts > 0.0, after.shape[:-1]))

    @FAST
    @given(
        change=st.tuples(st.sampled_from(["q_mobile", "r_o", "load", "until"]), NUMBERS)
        | st.tuples(st.just("dt"), st.floats(0.05, 20.0) | st.sampled_from([0.0, -1.0, np.nan, np.inf]))
    )
    def test_a_simulation_is_made_of_numbers_above_the_cut_off(self, change):
        name, value = change
        arguments = {"load": 8.0, "q_mobile": 7600.0, "r_o": 0.1, "until": 300.0} | {name: value}
        result = right_or_refused(lambda: battery_env.simulate(**arguments), name)
        if result is not None:
            assert len(result.time_s) >= 1 and (result.voltage_V >= 3.0).all()
            for array in (result.time_s, result.state, result.voltage_V, result.current_A, result.load):
                assert np.isfinite(array).all() and len(array) == len(result.time_s)

    @FAST
    @given(
        change=st.tuples(st.sampled_from(["load", "q_mobile", "r_o", "until", "dt", "initial"]), JUNK)
        | st.tuples(st.sampled_from(["thermal", "cell", "load_unit", "cut_off_V"]), JUNK | st.just(np.nan))
    )
    def test_arguments_of_another_kind_are_refused(self, change):
        name, value = change
        assume(value is not None or name not in ("q_mobile", "r_o", "initial", "cell", "cut_off_V"))
        arguments = {"load": 8.0, "q_mobile": 7600.0, "r_o": 0.1} | {name: value}
        assert right_or_refused(lambda: battery_env.simulate(**arguments), "state" if name == "initial" else name) is None
        if name in ("dt", "thermal", "cell", "load_unit"):
            state = battery_env.initial_state(7600.0)
            assert right_or_refused(lambda: battery_env.step(state, **arguments), name) is None


@FAST
@given(
    index=ARRAYS | JUNK | st.lists(st.booleans()) | arrays(np.int64, array_shapes(max_dims=2), elements=st.integers(-2, 22))
)
def test_trajectories_are_chosen_by_numbers_that_there_are(data, index):
    part = right_or_refused(lambda: data.subset(index), "index")
    if part is not None:
        np.testing.assert_array_equal(part.q_mobile, data.q_mobile[np.asarray(index)])


@FAST
@given(name=st.sampled_from(["voltage_V", "current_A", "temperature_C"]), value=ARRAYS | NUMBERS | arrays(np.float64, 20))
def test_a_discharge_holds_plausible_numbers(name, value):
    arguments = {"time_s": np.arange(20.0), "voltage_V": np.full(20, 4.0), "current_A": np.full(20, 2.0)} | {name: value}
    discharge = right_or_refused(lambda: battery_env.Discharge(**arguments), name)
    if discharge is not None:
        kept = getattr(discharge, name)
        assert np.isfinite(kept).all() and kept.shape == (20,) and discharge.charge_C > 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda record: record.part(0, 1), "at least 3 samples"),
        (lambda record: dataclasses.replace(record, time_s=record.time_s[::-1]), "time"),
        (lambda record: dataclasses.replace(record, voltage_V=record.voltage_V[:-1]), "voltage_V"),
        (lambda record: dataclasses.replace(record, current_A=0.0 * record.current_A), "no current"),
    ],
)
def test_records_that_cannot_be_calibrated_with_are_refused(data, change, message):
    with pytest.raises(ValueError, match=message):
        battery_env.LeastSquares().estimate(change(data[0]))


@pytest.mark.parametrize("env_id", TASKS)
class TestEnvironments:
    @staticmethod
    def run(env, steps=5):
        actions = np.random.default_rng(1).uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)
        return [env.step(action)[:2] for action in actions]

    def test_copies_go_on_as_the_original_does(self, data, env_id):
        for env in (gym.make(env_id, dataset=data).unwrapped, gym.make_vec(env_id, num_envs=3, dataset=data)):
            env.reset(seed=3)
            env.step(env.action_space.low)
            twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
            expected = self.run(env)
            for twin in twins:
                for (observation, reward), (other, other_reward) in zip(expected, self.run(twin), strict=True):
                    np.testing.assert_array_equal(observation, other)
                    np.testing.assert_array_equal(reward, other_reward)

    def test_actions_beyond_the_range_count_as_its_ends(self, data, env_id):
        env = gym.make(env_id, dataset=data).unwrapped
        found = []
        for action in (env.action_space.high, 7.0 * env.action_space.high, np.full(env.action_space.shape, np.inf)):
            env.reset(seed=0)
            found.append(env.step(action)[0])
        np.testing.assert_array_equal(found[0], found[1])
        np.testing.assert_array_equal(found[0], found[2])

    def test_what_is_no_action_is_refused(self, data, env_id):
        env = gym.make(env_id, dataset=data).unwrapped
        vector_env = gym.make_vec(env_id, num_envs=2, dataset=data)
        for each in (env, vector_env):
            each.reset(seed=0)
            shape = each.action_space.shape
            wrong = [None, "0", 0.0, np.full(shape, np.nan), np.zeros(0), np.zeros((*shape, 1)), np.zeros(9)]
            for action in (*wrong, np.zeros(shape, complex), np.zeros(shape, object)):
                with pytest.raises(ValueError, match="action must hold numbers"):
                    each.step(action)
