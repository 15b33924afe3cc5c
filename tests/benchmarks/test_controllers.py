"""Loops that should settle do, and loops that should not do not."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("tabulate")

from benchmarks.controllers import ScaledController, controllers
from benchmarks.references import DISTURBANCES
from benchmarks.robustness import roll_out
from sb3_lac.envs import reference_controller


def test_actions_are_multiplied_and_nothing_else():
    env = gym.make("QuadrotorCost-v0")
    reference = reference_controller(env)
    observations = np.array([env.observation_space.sample() for _ in range(20)])
    actions, state = ScaledController(reference, -0.25).predict(observations)
    np.testing.assert_array_equal(actions, -0.25 * reference.predict(observations)[0])
    assert state is None and actions.dtype == np.float32
    assert ScaledController(reference, 0.5).predict(observations[0])[0].shape == env.action_space.shape


@pytest.mark.parametrize("env_id", list(DISTURBANCES))
def test_only_some_loops_end_at_the_goal(env_id):
    tolerance = gym.make(env_id).unwrapped.error_tolerance
    at_goal = {}
    for name, controller in controllers(env_id).items():
        outcome = roll_out(controller, partial(gym.make, env_id), 10)
        at_goal[name] = ((outcome["error"] <= tolerance) & ~outcome["died"]).mean()
    assert next(iter(at_goal)) == "reference" and at_goal.pop("reference") == 1.0
    assert at_goal.pop("wrong sign") == 0.0
    # half the gain still reaches the goal in some, and 15 % of it in the linear one
    at_goal.pop("weak")
    assert at_goal and max(at_goal.values()) <= 0.2


def test_other_environments_have_none():
    with pytest.raises(ValueError, match="has no reference controller"):
        controllers("Pendulum-v1")
