"""
What a change of the code's shape must not change: numbers of the model, the tasks, the calibrators, the command line,
forecasts, policies, short trainings and certificates.

.. code-block:: bash

  python -m tests.golden write golden.npz                    # before the change
  python -m tests.golden compare golden.npz                  # after it: equal to the bit, or by how much not
  python -m tests.golden compare golden.npz --parts streams  # one part of it

Compare within one environment on one machine: other processors and versions make other last digits.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC, TD3

from battery_env import PolicyEstimator, evaluate, forecast, load_nasa_discharges, read_discharges, simulate, track_life
from battery_env.__main__ import calibrate as battery_calibrate
from battery_env.estimators import ClosedForm, LeastSquares, cramer_rao_bound, fit_cell
from battery_env.loads import BlockBootstrap, Cycle, Load
from battery_env.sensors import SensorErrors
from battery_env.tasks.data import standard_dataset
from sb3_lac import LAC, certify, evaluate_lyapunov, fit_lyapunov
from sb3_lac.envs import reference_controller

Numbers = Iterator[tuple[str, np.ndarray]]
BATTERY_IDS = sorted(id_ for id_ in gym.registry if id_.startswith("Battery"))
COST_IDS = ("CartPoleCost-v0", "Oscillator-v0", "LinearCost-v0")


def model() -> Numbers:
    """Trajectories of the model."""
    for name, arguments in {
        "power": {"load": 8.0, "load_unit": "power"},
        "current": {"load": 2.0, "load_unit": "current"},
        "thermal": {"load": 12.0, "load_unit": "power", "thermal": True},
    }.items():
        trajectory = simulate(q_mobile=6000.0, r_o=0.15, dt=1.0, **arguments)
        yield f"model/{name}/state", trajectory.state
        yield f"model/{name}/voltage", trajectory.voltage_V


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
    paper, drive = standard_dataset("q_mobile", "paper", "test"), standard_dataset(("q_mobile", "r_o"), "random_walk", "test")
    of_paper, of_drive = paper.subset([5, 900]), drive.subset([1, 7])
    errors = SensorErrors(noise_V=0.005, offset_V=0.01)
    estimators = {"least_squares": LeastSquares(), "policy": PolicyEstimator.pretrained()}
    for k, trace in enumerate(ClosedForm().trace(of_paper)):
        yield f"closed_form/{k}", np.column_stack([trace.time_s, trace.q_mobile, trace.r_o])
    for name, estimator in estimators.items():
        frame = evaluate(estimator, of_drive, errors, seed=1).drop(columns="time_per_update_s")
        yield f"{name}/evaluate", frame.select_dtypes("number").to_numpy(dtype=float)
    yield "cramer_rao", np.array(list(vars(cramer_rao_bound(of_drive[0], 0.005)).values()), dtype=object).astype(str)


def streams() -> Numbers:
    """What a policy says sample by sample: of whole and changed records."""
    record = load_nasa_discharges("B0005")[40]
    time_s, voltage_V, current_A = (column[::3] for column in (record.time_s, record.voltage_V, record.current_A))
    dt_s = np.diff(time_s, prepend=time_s[0])
    gap, spike, charged = dt_s.copy(), voltage_V.copy(), voltage_V.copy()
    gap[60:], spike[50] = dt_s[60:] + 400.0 * (np.arange(60, len(dt_s)) == 60), np.nan
    charged[:5] -= 0.4
    changed = {
        "as_it_is": (voltage_V, current_A, dt_s),
        "gap": (voltage_V, current_A, gap),
        "missing": (spike, current_A, dt_s),
        "not_full": (charged, current_A, dt_s),
        "steps": (voltage_V, current_A * np.where(np.arange(len(dt_s)) % 20 < 10, 1.0, 0.2), dt_s),
        "offset": (voltage_V + 0.08, current_A, dt_s),
    }
    estimator = PolicyEstimator.pretrained("BatteryVoltageJoint-v0", recorded=True)
    for what, columns in changed.items():
        estimator.reset()
        said = [estimator.update(*sample) for sample in zip(*columns, strict=True)]
        now = estimator.remaining(2.0, 2.7)
        yield f"stream/policy/{what}/remaining", np.array([now.time_s, now.sd_s, estimator.soc, estimator.voltage_V])
        yield f"stream/policy/{what}", np.array([[e.q_mobile, e.r_o, e.sd_q_mobile, e.sd_r_o, e.settled] for e in said])
        yield f"stream/policy/{what}/reason", np.array([e.reason for e in said[::7]])
    load = np.where(np.arange(9000) // 300 % 2 == 0, 1.0, 2.5)
    estimator.reset()
    for sample in zip(voltage_V[:60], current_A[:60], dt_s[:60], strict=True):
        estimator.update(*sample)
    for name, given in {
        "array": load,
        "cycle": Cycle(Load(np.array([0.0, 30.0]), np.array([3.0, 6.0])), 60.0),
        "function": lambda t: 1.0 + t / 1e4,
    }.items():
        yield f"remaining/{name}", np.array(estimator.remaining(given, 2.8, "power" if name == "cycle" else "current"))


def fits() -> Numbers:
    """Least squares with every option, over lives, and the constants of a cell."""
    life = load_nasa_discharges("B0006")
    record = life[20]
    for name, options in {
        "thermal": {"thermal": True, "mismatch_V": 0.05},
        "prior": {"prior_q_mobile_C": (7000.0, 150.0), "mismatch_V": 0.05},
        "partly_charged": {"initial_soc": (0.9, 0.02), "mismatch_V": 0.05, "thermal": True},
        "noise_stated": {"voltage_noise_V": 0.004},
        "r_o": {"parameters": ("r_o",), "mismatch_V": 0.05},
        "windows": {"window_every_s": 600.0, "mismatch_V": 0.05},
    }.items():
        for part, of_part in (("whole", record), ("half", record.until(0.5 * float(record.time_s[-1])))):
            for k, trace in enumerate(LeastSquares(**options).trace([of_part])):
                columns = (trace.time_s, trace.q_mobile, trace.r_o, trace.sd_q_mobile, trace.sd_r_o, trace.settled)
                yield f"fit/{name}/{part}/{k}", np.column_stack(columns)
            yield f"fit/{name}/{part}/reason", np.array([LeastSquares(**options).estimate(of_part).reason])
    fitted = fit_cell([life[5], life[90]])
    with tempfile.TemporaryDirectory() as folder:
        fitted.to_json(Path(folder) / "cell.json")
        yield "fit_cell", np.array((Path(folder) / "cell.json").read_text(encoding="utf-8").splitlines())
    found = LeastSquares(cell=fitted.cell, mismatch_V=fitted.mismatch_V, thermal=fitted.thermal).estimate(life[50])
    yield "fit_cell/estimate", np.array([found.q_mobile, found.r_o, found.sd_q_mobile, found.sd_r_o])
    lived = track_life(life[::20], 2.7)
    yield "life", lived.table.select_dtypes("number").to_numpy(dtype=float)
    yield "life/prior", np.array([*lived.prior_q_mobile_C, lived.step_share, lived.noise_share, lived.drift_share])


def forecasts() -> Numbers:
    """Ends of discharges in progress, under loads of every kind."""
    whole = load_nasa_discharges("B0005")[60]
    record = whole.until(0.6 * float(whole.time_s[-1]))
    estimate = LeastSquares(prior_q_mobile_C=(6500.0, 100.0), mismatch_V=0.05).estimate(record)
    walk = standard_dataset(("q_mobile", "r_o"), "random_walk", "test")[3]
    for name, load, unit in (
        ("goes_on", None, "current"),
        ("number", 1.5, "current"),
        ("load", Load(np.arange(0.0, 9000.0, 700.0), np.linspace(0.5, 3.0, 13), "power"), "current"),
        ("cycle", Cycle(Load(np.array([0.0, 15.0, 30.0]), np.array([2.0, 9.0, 5.0])), 45.0), "power"),
        ("function", lambda t: 1.0 + np.sin(t / 300.0) ** 2, "current"),
        ("bootstrap", BlockBootstrap(walk, block_s=120.0), "current"),
    ):
        found = forecast(record, estimate, load, 2.7, load_unit=unit, samples=120, seed=4)
        yield f"forecast/{name}", np.column_stack([found.eod_time_s, found.soc, found.q_mobile, found.r_o, found.capacity_Ah])
        yield f"forecast/{name}/band", found.voltage_V
        yield f"forecast/{name}/nominal", np.array([found.nominal_Ah])


def command_line() -> Numbers:
    """What battery-calibrate says of recorded discharges, and of files: lines of JSON, texts, and the exit status."""
    record = load_nasa_discharges("B0006")[30]
    walk = standard_dataset(("q_mobile", "r_o"), "random_walk", "test")[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def write(file: str, header: str, *columns: np.ndarray) -> None:
            np.savetxt(folder / file, np.column_stack(columns), "%.17g", ",", header=header, comments="")

        half = record.until(0.5 * float(record.time_s[-1]))
        write(
            "milli.csv", "Time [s],Voltage [mV],Current [mA]", record.time_s, 1e3 * record.voltage_V, -1e3 * record.current_A
        )
        write("walk.csv", "time_min,voltage_V,current_A", walk.time_s / 60.0, walk.voltage_V, walk.current_A)
        write("half.csv", "Test Time (s),Voltage (V),Current (A)", half.time_s, half.voltage_V, half.current_A)
        (folder / "odd.csv").write_text("time,voltage\n0,4\n1,3.9\n", encoding="utf-8")
        for k, discharge in enumerate(read_discharges(folder / "milli.csv")):
            yield f"read/{k}", np.column_stack([discharge.time_s, discharge.voltage_V, discharge.current_A])
        for what, arguments in {
            "bundled": ["B0005:40"],
            "several": ["B0005:10", "B0005:160", "B0006:80"],
            "policy": ["B0006:40", "--method", "policy"],
            "rest": ["B0005:40", "--initial-soc", "rest"],
            "partly": ["B0005:40", "--initial-soc", "0.9,0.02"],
            "milli": ["milli.csv"],
            "walk": ["walk.csv", "--cut-off", "3.0", "--mismatch", "0"],
            "half": ["half.csv"],
            "half_prior": ["half.csv", "--prior", "6800", "150"],
            "odd": ["odd.csv"],
            "missing": ["nowhere.csv"],
        }.items():
            for form in (["--json"], []):
                given = [str(folder / each) if each.endswith(".csv") else each for each in arguments]
                out, err = io.StringIO(), io.StringIO()
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                    status = battery_calibrate(["calibrate", *given, *form])
                lines = out.getvalue().replace(name, "FOLDER").splitlines()
                key = f"command_line/{what}/{'json' if form else 'text'}"
                yield f"{key}/status", np.array([status])
                yield f"{key}/errors", np.array(err.getvalue().replace(name, "FOLDER").splitlines() or [""])
                if not form:
                    yield key, np.array(lines or [""])
                for k, line in enumerate(lines if form else []):
                    for column, value in sorted(json.loads(line).items()):
                        yield f"{key}/{k}/{column}", np.array([repr(value)])


def certificates() -> Numbers:
    """Reference controllers, a policy that is too short trained, and what is said of both."""
    th.set_num_threads(1)
    trained = TD3("MlpPolicy", "LinearCost-v0", seed=2, learning_starts=50, device="cpu").learn(200)
    for name, env_id, controller in (
        ("reference", "CartPoleCost-v0", None),
        ("reference", "Oscillator-v0", None),
        ("reference", "LinearCost-v0", None),
        ("td3", "LinearCost-v0", trained),
    ):
        env = gym.make(env_id)
        policy = controller or reference_controller(env)
        lyapunov = fit_lyapunov(policy, env, n_episodes=8, seed=0)
        report = evaluate_lyapunov(policy, env, n_episodes=8, lyapunov=lyapunov, seed=1000)
        for metric, interval in report.metrics.items():
            yield f"certificate/{name}/{env_id}/{metric}", np.array(interval)
        found = certify(policy, env, lyapunov=lyapunov, n_episodes=8, seed=2000)
        for statement, row in found.statements.iterrows():
            yield f"certificate/{name}/{env_id}/statement/{statement}", row.to_numpy(dtype=float)
        values = [np.nan if each is None else each for each in (found.ultimate_bound, found.level, found.window_steps)]
        yield f"certificate/{name}/{env_id}/bounds", np.array(values, dtype=float)


def trainings() -> Numbers:
    """Weights after short trainings, with each variant of LAC, what the policies estimate, and how a critic is judged."""
    th.set_num_threads(1)
    for name, algo, id_, arguments in (
        ("default", LAC, "BatteryQmax-v0", {}),
        ("default", SAC, "BatteryVoltageJoint-v0", {}),
        ("compiled", LAC, "LinearCost-v0", {"compile_update": True}),
        ("n_steps", LAC, "Pendulum-v1", {"n_steps": 3, "ent_coef": 0.1}),
        ("gsde", LAC, "Pendulum-v1", {"use_sde": True, "train_freq": 8, "gradient_steps": 4}),
        ("two_critics", LAC, "CartPoleCost-v0", {"policy_kwargs": {"n_critics": 2, "net_arch": [32, 32]}, "lambda_max": 5.0}),
        ("bound", LAC, "Pendulum-v1", {"reward_bound": 2.0, "alpha3": 0.3, "gamma": 0.9}),
    ):
        model = algo("MlpPolicy", id_, seed=7, learning_starts=50, device="cpu", **arguments).learn(250)
        for key, weights in model.policy.state_dict().items():
            yield f"training/{id_}/{name}/{key}", weights.numpy()
        if id_.startswith("Battery"):
            aged, load = ("q_mobile", "paper") if id_ == "BatteryQmax-v0" else (("q_mobile", "r_o"), "piecewise")
            discharges = standard_dataset(aged, load, "test").subset([3, 4])
            frame = evaluate(PolicyEstimator(model, id_), discharges).drop(columns="time_per_update_s")
            yield f"training/{id_}/evaluate", frame.select_dtypes("number").to_numpy()
        if id_ == "LinearCost-v0":
            report = evaluate_lyapunov(model, gym.make(id_), n_episodes=5, seed=0)
            for metric, interval in report.metrics.items():
                yield f"evaluate_lyapunov/{metric}", np.array(interval)


PARTS: dict[str, Callable[[], Numbers]] = {
    part.__name__: part
    for part in (model, tasks, calibrators, streams, fits, forecasts, command_line, trainings, certificates)
}


def collect(parts: list[str]) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by name, by part."""
    return {part: dict(PARTS[part]()) for part in parts}


def differences(before: dict[str, np.ndarray], after: dict[str, np.ndarray]) -> list[str]:
    """What is not equal to the bit, one line per array."""
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
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="default: all")
    chosen = parser.parse_args()
    numbers = {f"{part}:{name}": value for part, arrays in collect(chosen.parts).items() for name, value in arrays.items()}
    if chosen.command == "write":
        np.savez_compressed(chosen.file, **numbers)
        print(f"{len(numbers)} arrays -> {chosen.file}")
        return
    with np.load(chosen.file) as file:
        before = {name: file[name] for name in file.files if name.split(":")[0] in chosen.parts}
    lines = differences(before, numbers)
    print("\n".join(lines) or f"{len(numbers)} arrays, all equal to the bit")
    sys.exit(bool(lines))


if __name__ == "__main__":
    main()
