"""Trainings that were good once: the line as typed on batteries, and one setting tuned to nothing on control problems."""

import pytest

from benchmarks.roots import run_of, score


@pytest.mark.attacks
@pytest.mark.parametrize(
    ("task", "seed", "most"),
    [
        ("BatteryQmax-v0", 11, 0.5),
        # five seeds reached 0.0039 to 0.0094, SAC 0.18
        ("VehicleCost-v0", 5, 0.03),
        # five seeds reached 0.03 to 0.11; whoever lets some crash costs 0.15 to 0.75
        ("QuadrotorCost-v0", 5, 0.3),
    ],
)
def test_a_training_that_was_good_once_is_good(task, seed, most):
    run = run_of(task, "lac", seed)
    env = run.environments()
    model = run.model(env, compiled=False).learn(run.timesteps)
    env.close()
    assert score(model, run) <= most
