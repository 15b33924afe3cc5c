"""The environments' ids."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

_PACKAGE = "battery_env.calibration"

#: By id, the task that the environments for one cell and for many run; its docstring is their page.
TASKS: dict[str, str] = {
    "BatteryQmax-v0": f"{_PACKAGE}.full_state_tasks:BatteryQmax",
    "BatteryRo-v0": f"{_PACKAGE}.full_state_tasks:BatteryRo",
    "BatteryJoint-v0": f"{_PACKAGE}.full_state_tasks:BatteryJoint",
    "BatteryQmaxPaper-v0": f"{_PACKAGE}.full_state_tasks:BatteryQmaxPaper",
    "BatteryRoPaper-v0": f"{_PACKAGE}.full_state_tasks:BatteryRoPaper",
    "BatteryVoltageQmax-v0": f"{_PACKAGE}.voltage_tasks:BatteryVoltageQmax",
    "BatteryVoltageRo-v0": f"{_PACKAGE}.voltage_tasks:BatteryVoltageRo",
    "BatteryVoltageJoint-v0": f"{_PACKAGE}.voltage_tasks:BatteryVoltageJoint",
    "BatteryAging-v0": f"{_PACKAGE}.aging:BatteryAging",
}


def register_environments() -> None:
    """Register every environment that is not registered yet (Gymnasium warns of a second registration)."""
    for env_id, task in TASKS.items():
        if env_id not in registry:
            register(
                id=env_id,
                entry_point=f"{_PACKAGE}.env:CalibrationEnv",
                vector_entry_point=f"{_PACKAGE}.vector_env:CalibrationVectorEnv",
                kwargs={"task": task},
            )
