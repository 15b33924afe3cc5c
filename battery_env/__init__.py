from battery_env.calibration.registration import register_environments

register_environments()
