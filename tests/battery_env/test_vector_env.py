"""The vector environments make the episodes of the scalar ones."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from battery_env.loads import RandomPiecewise
from battery_env.tasks.base import CalibrationTask
from battery_env.tasks.registration import TASKS
from battery_env.trajectories import TrajectoryDataset

IDS = ("BatteryQmax-v0", "BatteryRo-v0", "BatteryJoint-v0", "BatteryQmaxPaper-v0", "BatteryRoPaper-v0")
# whatever draws at random
NOISY = {"initial_perturbation": 3.0, "continue_probability": 0.5, "first_sample_probability": 0.3}
OPTIONS = [("BatteryVoltageJoint-v0", {"nuisance": 0.2}), *((env_id, NOISY) for env_id in IDS)]


@pytest.fixture(scope="module")
def discharges():
    return TrajectoryDataset.generate(("q_mobile", "r_o"), 6, RandomPiecewise(), seed=0)


def make_pair(env_id, mode, cells=3, **options):
    """A vector environment, and Gymnasium's own over as many scalar environments."""
    kwargs = {"num_envs": cells, "disable_env_checker": True, **options}
    sync = gym.make_vec(env_id, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs)
    del kwargs["disable_env_checker"]
    return gym.make_vec(env_id, autoreset_mode=mode, **kwargs), sync


def assert_same_infos(found, expected, mask=None):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        if isinstance(values, dict):
            assert_same_infos(found[name], values, expected[f"_{name}"])
        elif name == "final_obs":
            assert [o is None for o in found[name]] == [o is None for o in values]
            for a, b in zip(found[name], values, strict=True):
                np.testing.assert_array_equal(a, b)
        elif name.startswith("_"):
            np.testing.assert_array_equal(found[name], values)
        else:  # where the mask is False, there is no value
            assert found[name].dtype == values.dtype
            valid = expected.get(f"_{name}", mask)
            np.testing.assert_array_equal(found[name][valid], values[valid])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(("env_id", "options"), [*((env_id, {}) for env_id in TASKS), *OPTIONS])
def test_a_batch_makes_the_episodes_of_scalar_environments_to_the_bit(env_id, options, mode, discharges):
    batch, sync = make_pair(env_id, mode, dataset=discharges, episode_steps=4, **options)
    assert (batch.observation_space, batch.action_space) == (sync.observation_space, sync.action_space)
    assert batch.metadata["autoreset_mode"] is mode and batch.metadata["discount"] == 0.8
    sync.action_space.seed(0)
    for seed in (3, [7, 1, 5], None):
        found, expected = batch.reset(seed=seed), sync.reset(seed=seed)
        np.testing.assert_array_equal(found[0], expected[0])
        assert_same_infos(found[1], expected[1])
        for _ in range(11):
            actions = sync.action_space.sample()
            *step, info = batch.step(actions)
            *other_step, other_info = sync.step(actions)
            for a, b in zip(step, other_step, strict=True):
                assert a.dtype == b.dtype
                np.testing.assert_array_equal(a, b)
            assert_same_infos(info, other_info)
            step[3][:] = False  # what was returned is the caller's


def test_nonsense_is_refused(discharges):
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        gym.make_vec("BatteryQmax-v0", num_envs=0, dataset=discharges)
    with pytest.raises(ValueError, match="'NextStep' or 'SameStep', got 'Disabled'"):
        gym.make_vec("BatteryQmax-v0", autoreset_mode="Disabled", dataset=discharges)
    for make in (gym.make, gym.make_vec):
        # Libraries that try options read it in the words of Python
        with pytest.raises(TypeError, match=r"unexpected keyword argument 'frameskip'\. There are .*episode_steps"):
            make("BatteryQmax-v0", dataset=discharges, frameskip=1)
    batch = gym.make_vec("BatteryQmax-v0", num_envs=2, dataset=discharges)
    with pytest.raises(gym.error.ResetNeeded, match="before step"):
        batch.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="one for each of the 2 cells, got 3"):
        batch.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"'trajectory' and 'sample', got \['where'\]"):
        batch.reset(options={"where": 3})


def test_every_task_reports_what_info_promises(discharges):
    batch = gym.make_vec("BatteryQmax-v0", num_envs=2, dataset=discharges)
    assert batch.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP  # as of Gymnasium
    _, info = batch.reset(seed=0)
    names = {"cost", *CalibrationTask.REPORT_NAMES}
    assert set(info) == names | {f"_{name}" for name in names}
    # arrays of their own: the next step does not change them
    before = {name: values.copy() for name, values in info.items()}
    batch.step(np.ones((2, 1)))
    for name, values in info.items():
        np.testing.assert_array_equal(values, before[name])
