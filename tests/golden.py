"""
What a change of the code's shape must not change: numbers of the model, the tasks, the calibrators and short trainings.

.. code-block:: bash

  python -m tests.golden write golden.npz    # before the change
  python -m tests.golden compare golden.npz  # after it: equal to the bit, or by how much not

Compare within one environment on one machine: other processors and versions make other last digits.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC

from battery_env import (
    ClosedForm,
    ExtendedKalmanFilter,
    GreedyOneStep,
    LeastSquares,
    PolicyEstimator,
    RandomSensorErrors,
    SensorErrors,
    cramer_rao_bound,
    evaluate,
    load_nasa_discharges,
    simulate,
)
from battery_env.calibration.data import standard_dataset
from sb3_lac import LAC, evaluate_lyapunov

Numbers = Iterator[tuple[str, np.ndarray]]
BATTERY_IDS = sorted(id_ for id_ in gym.registry if id_.startswith("Battery"))
COST_IDS = ("CartPoleCost-v0", "Oscillator-v0", "LinearCost-v0")


def model() -> Numbers:
    """Trajectories of the model, and of the standard data sets."""
    for name, arguments in {
        "power": {"load": 8.0, "load_unit": "power"},
        "current": {"load": 2.0, "load_unit": "current"},
        "thermal": {"load": 12.0, "load_unit": "power", "thermal": True},
    }.items():
        trajectory = simulate(q_mobile=6000.0, r_o=0.15, dt=1.0, until="eod", **arguments)
        yield f"model/{name}/state", trajectory.state
        yield f"model/{name}/voltage", trajectory.voltage_V
    for aged, load in (("q_mobile", "paper"), ("r_o", "constant"), ("joint", "random_walk"), ("joint", "piecewise")):
        dataset = standard_dataset(aged, load, "test")
        for n in (0, len(dataset) // 2, len(dataset) - 1):
            record = dataset[n]
            yield f"dataset/{aged}/{load}/{n}", np.column_stack(
                [record.time_s, record.voltage_V, record.current_A, record.load]
            )
            yield f"dataset/{aged}/{load}/{n}/state", record.state


def tasks() -> Numbers:
    """Observations, rewards and ends of every environment, one cell and many."""
    for id_ in (*BATTERY_IDS, *COST_IDS):
        env = gym.make(id_)
        observation, _ = env.reset(seed=3)
        env.action_space.seed(3)
        rows = [np.append(observation, [0.0, 0.0])]
        for _ in range(150):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            rows.append(np.append(observation, [float(reward), terminated + 2.0 * truncated]))
            if terminated or truncated:
                observation, _ = env.reset()
        yield f"env/{id_}", np.array(rows)
    for id_ in BATTERY_IDS:
        envs = gym.make_vec(id_, num_envs=5, autoreset_mode="SameStep")
        envs.reset(seed=3)
        envs.action_space.seed(3)
        steps = [envs.step(envs.action_space.sample()) for _ in range(80)]
        yield f"vector_env/{id_}/observation", np.array([observation for observation, *_ in steps])
        yield f"vector_env/{id_}/reward", np.array([reward for _, reward, *_ in steps])
        for key, values in steps[-1][4].items():
            if isinstance(values, np.ndarray) and values.dtype.kind in "fib":
                yield f"vector_env/{id_}/info/{key}", values


def calibrators() -> Numbers:
    """Estimates of every calibrator, on simulated and on recorded discharges."""
    paper, drive = standard_dataset("q_mobile", "paper", "test"), standard_dataset("joint", "random_walk", "test")
    of_paper, of_drive = paper.subset([5, 900]), drive.subset([1, 7])
    errors = SensorErrors(noise_V=0.005)
    for name, estimator in {"closed_form": ClosedForm(), "greedy": GreedyOneStep("q_mobile")}.items():
        for k, trace in enumerate(estimator.trace(of_paper)):
            yield f"{name}/{k}", np.column_stack([trace.time_s, trace.q_mobile, trace.r_o])
    for name, estimator in {"least_squares": LeastSquares(), "kalman": ExtendedKalmanFilter()}.items():
        frame = evaluate(estimator, of_drive, errors, seed=1).drop(columns="time_per_update_s")
        yield f"{name}/evaluate", frame.select_dtypes("number").to_numpy(dtype=float)
    yield "cramer_rao", np.array(list(vars(cramer_rao_bound(of_drive[0], 0.005)).values()), dtype=object).astype(str)
    frame = evaluate(ExtendedKalmanFilter(), of_drive, RandomSensorErrors((0.001, 0.03), 0.01), seed=2)
    yield "kalman/random_errors", frame.drop(columns="time_per_update_s").select_dtypes("number").to_numpy()
    for cell in ("B0005", "B0006"):
        record = load_nasa_discharges(cell)[40]
        for name, estimator in {"least_squares": LeastSquares(), "kalman": ExtendedKalmanFilter()}.items():
            for part, of_part in (("whole", record), ("half", record.until(0.5 * float(record.time_s[-1])))):
                estimate = estimator.estimate(of_part)
                yield f"{name}/{cell}/{part}", np.array([str(value) for value in vars(estimate).values()])


def trainings() -> Numbers:
    """Weights after short trainings, what the policies estimate, and how their certificate is judged."""
    th.set_num_threads(1)
    for algo, id_ in ((LAC, "BatteryQmax-v0"), (SAC, "BatteryVoltageJoint-v0"), (LAC, "LinearCost-v0"), (LAC, "Pendulum-v1")):
        policy = algo("MlpPolicy", id_, seed=5, learning_starts=50, device="cpu")
        policy.learn(300)
        for name, weights in policy.policy.state_dict().items():
            if name == "reward_bound":
                # Compared files are older than its place in the policy, and the offset says the same
                continue
            yield f"training/{algo.__name__}/{id_}/{name}", weights.numpy()
        if id_.startswith("Battery"):
            aged, load = ("q_mobile", "paper") if id_ == "BatteryQmax-v0" else ("joint", "piecewise")
            discharges = standard_dataset(aged, load, "test").subset([3, 4])
            frame = evaluate(PolicyEstimator(policy, id_), discharges).drop(columns="time_per_update_s")
            yield f"training/{algo.__name__}/{id_}/evaluate", frame.select_dtypes("number").to_numpy()
        if id_ == "LinearCost-v0":
            report = evaluate_lyapunov(policy, gym.make(id_), n_eval_episodes=5, seed=0)
            yield "evaluate_lyapunov", np.array(report.summary().splitlines())


def collect() -> dict[str, np.ndarray]:
    """
    All numbers.

    :return: arrays by name
    """
    return {name: value for part in (model, tasks, calibrators, trainings) for name, value in part()}


def differences(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> list[str]:
    """
    What is not equal to the bit.

    :param before: arrays by name
    :param after: arrays by name
    :return: one line per array
    """
    lines = []
    for name in sorted(before.keys() | after.keys()):
        if name not in before or name not in after:
            lines.append(f"{name}: only {'after' if name in after else 'before'}")
            continue
        old, new = before[name], after[name]
        if old.shape != new.shape or old.dtype.kind != new.dtype.kind:
            lines.append(f"{name}: {old.dtype} {old.shape} became {new.dtype} {new.shape}")
        elif old.dtype.kind == "U":
            lines += [f"{name}: {a!r} became {b!r}" for a, b in zip(old.ravel(), new.ravel(), strict=True) if a != b]
        elif not np.array_equal(old, new, equal_nan=True):
            with np.errstate(invalid="ignore"):
                apart = np.nanmax(np.abs(new.astype(float) - old)) / np.nanmax(np.abs(old))
            lines.append(f"{name}: {apart:.2g} of the largest value apart")
    return lines


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["write", "compare"])
    parser.add_argument("file", type=Path)
    chosen = parser.parse_args()
    numbers = collect()
    if chosen.command == "write":
        np.savez_compressed(chosen.file, **numbers)
        print(f"{len(numbers)} arrays -> {chosen.file}")
        return
    with np.load(chosen.file) as file:
        lines = differences({name: file[name] for name in file.files}, numbers)
    print("\n".join(lines) or f"{len(numbers)} arrays, all equal to the bit")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
