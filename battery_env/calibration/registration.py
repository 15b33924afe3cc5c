"""The environments' ids."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

ENTRY_POINTS: dict[str, str] = {
    "BatteryQmax-v0": "battery_env.calibration.variants:BatteryQmaxEnv",
    "BatteryRo-v0": "battery_env.calibration.variants:BatteryRoEnv",
    "BatteryQmaxPaper-v0": "battery_env.calibration.variants:BatteryQmaxPaperEnv",
    "BatteryRoPaper-v0": "battery_env.calibration.variants:BatteryRoPaperEnv",
}


def register_environments() -> None:
    """Register every environment that is not registered yet (Gymnasium warns of a second registration)."""
    for env_id, entry_point in ENTRY_POINTS.items():
        if env_id not in registry:
            register(id=env_id, entry_point=entry_point)
