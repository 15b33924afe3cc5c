"""A vector environment of Gymnasium does in Stable-Baselines3 what as many single environments do."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from stable_baselines3 import TD3
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from battery_env.loads import constant
from battery_env.trajectories import TrajectoryDataset
from sb3_lac import LAC, GymnasiumVecEnv
from sb3_lac.vec_env import env_specs

N_ENVS = 3


@pytest.fixture(scope="module")
def discharges():
    return TrajectoryDataset.generate("q_mobile", 4, [constant(12.0)], seed=0)


@pytest.fixture
def problems(discharges, make_env):
    """By name: a vector environment in any autoreset mode, which may use its arrays again, and as many single ones."""
    battery = {"dataset": discharges, "episode_steps": 5}

    def sync(make):
        return (
            lambda mode: SyncVectorEnv([make] * N_ENVS, copy=False, autoreset_mode=mode),
            lambda: DummyVecEnv([make] * N_ENVS),
        )

    return {
        "battery": (
            lambda mode: gym.make_vec("BatteryQmax-v0", num_envs=N_ENVS, autoreset_mode=mode, **battery),
            lambda: DummyVecEnv([lambda: gym.make("BatteryQmax-v0", **battery)] * N_ENVS),
        ),
        "time limit": sync(lambda: gym.make("Pendulum-v1", max_episode_steps=4)),
        "termination": sync(lambda: make_env(episode_length=4, terminate=True)),
    }


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert type(found[name]) is type(value), name
        np.testing.assert_array_equal(found[name], value, err_msg=name)


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("battery", "SameStep"),
        *((name, mode) for name in ("time limit", "termination") for mode in ("SameStep", "Disabled")),
    ],
)
def test_transitions_are_those_of_single_environments(problems, name, mode):
    make_vector, make_single = problems[name]
    found, expected = GymnasiumVecEnv(make_vector(mode)), make_single()
    assert (found.observation_space, found.action_space) == (expected.observation_space, expected.action_space)
    for env in (found, expected):
        env.seed(5)
    first, expected_first = found.reset(), expected.reset()
    found.action_space.seed(0)
    ends, kept = 0, []
    for _ in range(12):
        for info, other in zip(found.reset_infos, expected.reset_infos, strict=True):
            assert_same(info, other)
        actions = np.array([found.action_space.sample() for _ in range(N_ENVS)])
        *step, infos = found.step(actions)
        *other_step, other_infos = expected.step(actions)
        kept.append((infos, other_infos))
        for a, b in zip(step, other_step, strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        ends += step[2].sum()
    assert ends >= 2 * N_ENVS
    # What was returned before has stayed as it was
    np.testing.assert_array_equal(first, expected_first)
    for info, other in (pair for pairs in kept for pair in zip(*pairs, strict=True)):
        assert_same(info, other)


def test_episodes_may_not_start_one_step_late(problems):
    for name in ("battery", "time limit"):
        with pytest.raises(ValueError, match=r"has autoreset mode AutoresetMode.NEXT_STEP.*autoreset_mode='SameStep'"):
            GymnasiumVecEnv(problems[name][0](AutoresetMode.NEXT_STEP))


def test_statistics_of_gymnasium_belong_to_the_episode_that_ended(make_env):
    makes = [lambda length=length: make_env(episode_length=length) for length in (2, 3)]
    env = GymnasiumVecEnv(gym.wrappers.vector.RecordEpisodeStatistics(SyncVectorEnv(makes, autoreset_mode="SameStep")))
    env.reset()
    lengths = [
        [info["episode"]["l"] if "episode" in info else None for info in env.step(np.zeros((2, 2)))[3]] for _ in range(3)
    ]
    assert lengths == [[None, None], [2, None], [None, 3]] and "episode" not in env.reset_infos[0]


class Events(gym.Wrapper):
    """Tells of every third step only, and ends in a termination at its time limit."""

    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        if self.env.unwrapped.n_steps % 3 == 0:
            info["event"] = {"step": self.env.unwrapped.n_steps, "name": "third"}
        return observation, reward, truncated, truncated, info


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_infos_that_only_some_environments_have_and_ends_of_both_kinds(make_env, mode):
    lengths = (3, 4, 5)
    makes = [lambda length=length: Events(make_env(episode_length=length)) for length in lengths]
    found, expected = GymnasiumVecEnv(SyncVectorEnv(makes, autoreset_mode=mode)), DummyVecEnv(makes)
    for env in (found, expected):
        env.seed(0)
        env.reset()
    events = []
    for _ in range(7):
        infos, other_infos = (env.step(np.zeros((3, 2)))[3] for env in (found, expected))
        for info, other in zip(infos, other_infos, strict=True):
            assert_same(info, other)
            assert not info["TimeLimit.truncated"]
        events.append(sum("event" in info for info in infos))
    assert set(events) == {0, 1, 3}


def test_dicts_of_observations(make_env):
    class Split(gym.ObservationWrapper):
        def __init__(self):
            super().__init__(make_env(episode_length=3))
            self.observation_space = gym.spaces.Dict({"a": self.env.observation_space, "b": self.env.observation_space})

        def observation(self, observation):
            return {"a": observation, "b": -observation}

    env = GymnasiumVecEnv(SyncVectorEnv([Split] * N_ENVS, autoreset_mode="SameStep"))
    env.reset()
    for _ in range(3):
        observations, _, dones, infos = env.step(np.ones((N_ENVS, 2)))
    assert dones.all() and observations["a"].shape == (N_ENVS, 2)
    last = infos[1]["terminal_observation"]
    np.testing.assert_array_equal(last["a"], -last["b"])


@pytest.mark.parametrize("algorithm", [LAC, TD3])
def test_algorithms_train_and_come_back_from_a_file(discharges, algorithm, tmp_path):
    def make():
        env = gym.make_vec("BatteryQmax-v0", num_envs=8, autoreset_mode="SameStep", dataset=discharges, episode_steps=6)
        return VecNormalize(VecMonitor(GymnasiumVecEnv(env)), norm_reward=False)

    model = algorithm("MlpPolicy", make(), learning_starts=16, batch_size=16, policy_kwargs={"net_arch": [8]}, seed=0)
    model.learn(160)
    assert {episode["l"] for episode in model.ep_info_buffer} == {6}
    buffer = model.replay_buffer
    # every sixth transition ends in a time limit, and leads to the last observation of its episode
    np.testing.assert_array_equal(buffer.timeouts[: buffer.pos].sum(axis=0), buffer.pos // 6)
    end, env = np.argwhere(buffer.timeouts)[0]
    assert (buffer.next_observations[end, env] != buffer.observations[end + 1, env]).any()
    model.save(tmp_path / "model")
    again = algorithm.load(tmp_path / "model", env=make())
    again.learn(16)
    observation = buffer.observations[:1, 0]
    assert again.predict(observation, deterministic=True)[0].shape == (1, 1)


def test_options_are_those_of_the_environment_and_the_same_for_all(problems):
    env = GymnasiumVecEnv(problems["battery"][0]("SameStep"))
    env.set_options({"trajectory": 2, "sample": 100})
    env.reset()
    np.testing.assert_array_equal(env.env.unwrapped.task.cell_records["trajectory"], 2)
    env.set_options([{"trajectory": n} for n in range(N_ENVS)])
    with pytest.raises(ValueError, match="the same options for all"):
        env.reset()


def test_attributes_and_methods_of_single_environments(problems):
    env = GymnasiumVecEnv(problems["time limit"][0]("SameStep"))
    assert env.get_attr("g") == [10.0] * N_ENVS and env.has_attr("g") and not env.has_attr("gravity")
    env.set_attr("g", 1.62, indices=[1])
    assert env.get_attr("g", indices=[0, 1]) == [10.0, 1.62]
    env.reset()
    # A method is an attribute too, and called of the chosen ones only
    seen = []
    env.set_attr("see", seen.append)
    env.env_method("see", 5, indices=[1])
    assert seen == [5] and env.has_attr("see")
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [True] * N_ENVS and not any(env.env_is_wrapped(Monitor))


def test_an_environment_that_computes_all_at_once(discharges):
    vector = gym.make_vec("BatteryQmax-v0", num_envs=N_ENVS, autoreset_mode="SameStep", dataset=discharges)
    # Wrappers of Gymnasium hide what they hold
    env = GymnasiumVecEnv(gym.wrappers.vector.RecordEpisodeStatistics(vector))
    assert env.get_attr("num_envs", indices=[0, 1]) == [N_ENVS] * 2 and not env.has_attr("gravity")
    env.set_attr("mark", 3)
    assert env.has_attr("task") and env.get_attr("mark") == [3] * N_ENVS
    with pytest.raises(ValueError, match=r"All 3 environments share 'mark': it cannot be set for \[1\] only"):
        env.set_attr("mark", 4, indices=1)
    # Seeds are used once
    env.seed(1)
    first, second = env.reset(), env.reset()
    assert (first != second).any()
    env.seed(1)
    np.testing.assert_array_equal(env.reset(), first)
    env.close()
    assert vector.closed


def unpicklable_env():
    env = gym.make("Pendulum-v1", max_episode_steps=7)
    env.unwrapped.spec.entry_point = lambda: None
    return env


@pytest.mark.parametrize("make_vec", [SyncVectorEnv, AsyncVectorEnv])
def test_environments_survive_being_asked_for_what_they_do_not_have(make_vec):
    env = GymnasiumVecEnv(make_vec([unpicklable_env] * 2, autoreset_mode=AutoresetMode.SAME_STEP))
    assert not env.has_attr("action_masks") and env.has_attr("max_torque")
    with pytest.raises(AttributeError, match="no_such_method"):
        env.env_method("no_such_method")
    with pytest.raises(AttributeError, match="no_such_thing"):
        env.set_attr("no_such_thing", 1, indices=0)
    # Nor has a specification that cannot be pickled to be sent
    assert len(env_specs(env)) == 2
    assert env.reset().shape == (2, 3)
    env.close()
