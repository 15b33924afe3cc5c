"""The tasks that pay rewards are environments, pay what they say, and start as their seed says."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from benchmarks import reward_tasks

IDS = ["SparseGoal-v0", "BonusGoal-v0", "StayAlive-v0", "AnyGoal-v0"]


def rolled_out(env_id, seed, act=lambda env: env.action_space.sample()):
    """An episode: the observations as one array, the rewards, and whether it was ended by the task."""
    env = gym.make(env_id)
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    observations, rewards, terminated, truncated = [observation], [], False, False
    while not (terminated or truncated):
        observation, reward, terminated, truncated, _ = env.step(act(env))
        observations.append(observation)
        rewards.append(reward)
    flat = [gym.spaces.flatten(env.observation_space, observation) for observation in observations]
    return np.array(flat), rewards, terminated


def to_goal(env):
    """Push towards the goal, against the velocity."""
    mass = env.unwrapped
    return np.clip(4.0 * (mass.goal - mass.position) - 2.0 * mass.velocity, -1.0, 1.0)


@pytest.mark.parametrize("env_id", IDS)
def test_a_task_is_an_environment_that_its_seed_determines(env_id):
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)
    (first, rewards, _), (again, *_), (other, *_) = (rolled_out(env_id, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first[0] != other[0]).any() and len(first) == len(rewards) + 1


@pytest.mark.parametrize(("env_id", "at_goal", "elsewhere"), [("SparseGoal-v0", 1.0, 0.0), ("BonusGoal-v0", 100.0, -1.0)])
def test_an_episode_ends_with_the_reward_of_the_goal(env_id, at_goal, elsewhere):
    observations, rewards, terminated = rolled_out(env_id, 0, to_goal)
    assert terminated and rewards == [elsewhere] * (len(rewards) - 1) + [at_goal]
    assert np.linalg.norm(observations[-1, :2]) <= reward_tasks.PointMass.GOAL_RADIUS_M < np.linalg.norm(observations[-2, :2])
    _, rewards, terminated = rolled_out(env_id, 0, lambda env: np.ones(2))
    assert not terminated and rewards == [elsewhere] * 50


def test_each_step_alive_pays_one():
    _, rewards, terminated = rolled_out("StayAlive-v0", 0, lambda env: np.ones(1))
    assert terminated and set(rewards) == {1.0} and len(rewards) < 50


def test_a_goal_is_paid_where_it_is_drawn_and_wherever_it_is_put():
    _, rewards, terminated = rolled_out("AnyGoal-v0", 0, to_goal)
    assert not terminated and len(rewards) == 50 and set(rewards) == {-1.0, 0.0} and rewards[-20:] == [0.0] * 20
    places = np.array([[0.0, 0.0], [0.0, 0.09], [0.08, 0.08]])
    rewards = gym.make("AnyGoal-v0").unwrapped.compute_reward(places, np.zeros((3, 2)), [{}] * 3)
    np.testing.assert_array_equal(rewards, [0.0, 0.0, -1.0])


def test_a_wall_stops_the_mass():
    observations, *_ = rolled_out("SparseGoal-v0", 0, lambda env: np.array([1.0, 0.0]))
    assert observations[-1, 0] == 1.0 and observations[-1, 2] == 0.0
