"""The environments' ids."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

_PACKAGE = "battery_env.tasks"

#: The task of each id, for the environments of one cell and of many; their pages are in docs/environments.
TASKS: dict[str, str] = {
    "BatteryQmax-v0": f"{_PACKAGE}.full_state.full_state_task:BatteryQmax",
    "BatteryRo-v0": f"{_PACKAGE}.full_state.full_state_task:BatteryRo",
    "BatteryJoint-v0": f"{_PACKAGE}.full_state.full_state_task:BatteryJoint",
    "BatteryQmaxPaper-v0": f"{_PACKAGE}.full_state.full_state_task:BatteryQmaxPaper",
    "BatteryRoPaper-v0": f"{_PACKAGE}.full_state.full_state_task:BatteryRoPaper",
    "BatteryVoltageJoint-v0": f"{_PACKAGE}.voltage.voltage_task:VoltageTask",
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
