from collections.abc import Callable
from types import ModuleType

import pytest

from sb3_lac import LAC


@pytest.fixture
def train_nothing(monkeypatch) -> Callable[[ModuleType], list[tuple]]:
    def _train_nothing(benchmark: ModuleType) -> list[tuple]:
        """Let a benchmark judge models that are not trained."""
        from benchmarks.study import write_json
        from benchmarks.training import record_file

        asked = []

        def train_or_load(recipe, folder, callbacks=(), compile_update=False):
            asked.append((recipe.algo, recipe.env_id, recipe.seed, recipe.timesteps))
            write_json(record_file(recipe, folder), {"training_minutes": 1.5, "versions": {}})
            settings = {"buffer_size": 10, "policy_kwargs": {"net_arch": [8]}}
            model = LAC("MlpPolicy", recipe.env_id, device="cpu", seed=recipe.seed, **settings)
            for callback in callbacks:
                callback.init_callback(model)
                callback.on_training_end()
            return model

        monkeypatch.setattr(benchmark, "train_or_load", train_or_load)
        return asked

    return _train_nothing
