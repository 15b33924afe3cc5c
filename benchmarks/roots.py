"""
Which root of ``L`` the critics of LAC learn, by settings that were tuned to nothing: control problems by one setting, and
batteries by the line as typed, ``LAC("MlpPolicy", "BatteryQmax-v0").learn(20_000)``.

.. code-block:: bash

  python -m benchmarks.roots --compile --jobs 2

A control problem is judged by the cost per step of the mean action, a battery by how far off its parameter is in the mean, in
episodes of held-out discharges. What a plant that changes makes of the roots, ``benchmarks.changing_plant`` shows. A training
that is done is a row of ``runs.csv``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.control import DISTURBANCES, roll_out
from benchmarks.runs import AT_THE_END, Run, control_networks, make_rows, rows_command_line
from benchmarks.study import Study, markdown, table_of, with_interval

CONTROL = list(DISTURBANCES)
BATTERIES = ["BatteryQmax-v0", "BatteryRo-v0"]
TIMESTEPS = {**dict.fromkeys(CONTROL, 15_000), **dict.fromkeys(BATTERIES, 20_000)}
#: The setting of control problems, which no trial chose.
UNTUNED = {"n_envs": 4, "learning_rate": 1e-3, "gradient_steps": 2, "learning_starts": 1000, "gamma": 0.99}
#: By the name on the command line what readers call them, the class, and the root of its critics if it is stated.
ALGORITHMS: dict[str, tuple[str, str, int | None]] = {
    "lac": ("LAC", "sb3_lac:LAC", None),
    "lac_square_root": ("LAC (root=2)", "sb3_lac:LAC", 2),
    "lac_fourth_root": ("LAC (root=4)", "sb3_lac:LAC", 4),
    "sac": ("SAC", "stable_baselines3:SAC", None),
}
EPISODES, BATTERY_EPISODES, BATTERY_STEPS = 60, 30, 400


def run_of(task: str, algorithm: str, seed: int, timesteps: int | None = None) -> Run:
    """A training of this study."""
    label, kind, root = ALGORITHMS[algorithm]
    settings: dict[str, Any] = {}
    if task in CONTROL:
        settings = {**UNTUNED, "policy_kwargs": control_networks(root)}
    elif root is not None:
        settings = {"policy_kwargs": f"dict(root={root})"}
    return Run(task, label, kind, seed, timesteps or TIMESTEPS[task], settings)


def percent_off(model: OffPolicyAlgorithm, task: str) -> float:
    """Mean error of the parameter of held-out discharges with the mean action, in percent."""
    env = gym.make(task, split="test", episode_steps=BATTERY_STEPS)
    (parameter,) = env.unwrapped.task.parameters  # type: ignore[attr-defined]
    errors = []
    for seed in range(BATTERY_EPISODES):
        observation, _ = env.reset(seed=seed)
        is_over = False
        while not is_over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, _, is_over, info = env.step(action)
            errors.append(abs(info[f"{parameter}_hat"] / info[parameter] - 1.0))
    env.close()
    return 100.0 * float(np.mean(errors))


def score(model: OffPolicyAlgorithm, run: Run) -> float:
    """Cost per step of a control problem, percent of a battery; lower is better."""
    if run.task in BATTERIES:
        return percent_off(model, run.task)
    return float(roll_out(model, partial(gym.make, run.task), EPISODES)["cost"].mean())


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = rows_command_line("roots", __doc__, "15000 of control problems, 20000 of batteries")
    parser.add_argument("--envs", nargs="+", default=list(TIMESTEPS), choices=list(TIMESTEPS))
    parser.add_argument("--algos", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    study = Study(parser, arguments)
    chosen = study.chosen
    runs = [
        run_of(task, algorithm, seed, chosen.timesteps)
        for seed, task, algorithm in product(chosen.seeds, chosen.envs, chosen.algos)
    ]
    rows = make_rows(study, runs, score)
    cells = {"seeds": lambda group: str(len(group)), "at the end": lambda group: with_interval(group[AT_THE_END])}
    table = table_of(rows, {"task": "environment", "algorithm": "policy"}, cells)
    text = "Cost per step of the mean action, of batteries by how many percent the parameter is off; interquartile mean over\n"
    text += "seeds with its 95 % interval, lower is better:\n\n"
    study.write({}, {}, text + markdown(table))


if __name__ == "__main__":
    main()
