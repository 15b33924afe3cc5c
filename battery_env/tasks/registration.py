"""The environments' ids."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

_PACKAGE = "battery_env.tasks"

#: By id, the task that the environments for one cell and for many run; its docstring is their page.
TASKS: dict[str, str] = {
    "BatteryQmax-v0": f"{_PACKAGE}.full_state.pages:BatteryQmax",
    "BatteryRo-v0": f"{_PACKAGE}.full_state.pages:BatteryRo",
    "BatteryJoint-v0": f"{_PACKAGE}.full_state.pages:BatteryJoint",
    "BatteryQmaxPaper-v0": f"{_PACKAGE}.full_state.pages:BatteryQmaxPaper",
    "BatteryRoPaper-v0": f"{_PACKAGE}.full_state.pages:BatteryRoPaper",
    "BatteryVoltageQmax-v0": f"{_PACKAGE}.voltage.pages:BatteryVoltageQmax",
    "BatteryVoltageRo-v0": f"{_PACKAGE}.voltage.pages:BatteryVoltageRo",
    "BatteryVoltageJoint-v0": f"{_PACKAGE}.voltage.pages:BatteryVoltageJoint",
    "BatteryAging-v0": f"{_PACKAGE}.voltage.aging:BatteryAging",
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
