"""The environments' ids."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

_VARIANTS = "battery_env.calibration.variants"
_VOLTAGE_VARIANTS = "battery_env.calibration.voltage_variants"

#: By id, the environment for one cell; the one for many is called ``...VectorEnv`` and stands beside it.
ENTRY_POINTS: dict[str, str] = {
    "BatteryQmax-v0": f"{_VARIANTS}:BatteryQmaxEnv",
    "BatteryRo-v0": f"{_VARIANTS}:BatteryRoEnv",
    "BatteryJoint-v0": f"{_VARIANTS}:BatteryJointEnv",
    "BatteryQmaxPaper-v0": f"{_VARIANTS}:BatteryQmaxPaperEnv",
    "BatteryRoPaper-v0": f"{_VARIANTS}:BatteryRoPaperEnv",
    "BatteryVoltageQmax-v0": f"{_VOLTAGE_VARIANTS}:BatteryVoltageQmaxEnv",
    "BatteryVoltageRo-v0": f"{_VOLTAGE_VARIANTS}:BatteryVoltageRoEnv",
    "BatteryVoltageJoint-v0": f"{_VOLTAGE_VARIANTS}:BatteryVoltageJointEnv",
    "BatteryAging-v0": f"{_VOLTAGE_VARIANTS}:BatteryAgingEnv",
}


def register_environments() -> None:
    """Register every environment that is not registered yet (Gymnasium warns of a second registration)."""
    for env_id, entry_point in ENTRY_POINTS.items():
        if env_id not in registry:
            vector_entry_point = f"{entry_point.removesuffix('Env')}VectorEnv"
            register(id=env_id, entry_point=entry_point, vector_entry_point=vector_entry_point)
