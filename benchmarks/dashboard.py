"""What a run of a comparison writes for TensorBoard, beside its evaluations."""

from __future__ import annotations

import contextlib
import io

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from battery_env.callbacks import CALIBRATION_CHARTS
from benchmarks.training import Recipe
from sb3_lac import DashboardCallback, LyapunovCallback
from sb3_lac.costs import CostAlgorithm
from sb3_lac.zoo import LACExperimentManager


def dashboard_callbacks(
    recipe: Recipe, manager: LACExperimentManager, model: BaseAlgorithm, episodes: int, every: int
) -> list[BaseCallback]:
    """Callbacks that make a run part of a comparison in TensorBoard. They do not change the training."""
    about = {"env": recipe.env_id, "recipe": recipe.digest, "timesteps": recipe.timesteps, "source": recipe.source}
    callbacks: list[BaseCallback] = [DashboardCallback(CALIBRATION_CHARTS, {**recipe.hyperparameters, **about})]
    if isinstance(model, CostAlgorithm):
        with contextlib.redirect_stdout(io.StringIO()):
            env = manager.create_envs(n_envs=1, eval_env=True, no_log=True)
        # from the same start states each time, which are not those of the training
        seed = recipe.seed + model.n_envs
        callbacks.append(LyapunovCallback(env, n_eval_episodes=episodes, eval_freq=every, seed=seed, verbose=0))
    return callbacks
