from collections.abc import Callable
from types import ModuleType

import pytest

from sb3_lac import LAC


@pytest.fixture
def train_nothing(monkeypatch) -> Callable[[ModuleType], list[tuple]]:
    def _train_nothing(benchmark: ModuleType) -> list[tuple]:
        """Let a benchmark judge models that are not trained."""
        from benchmarks.study import write_json
        from benchmarks.training import Recipe, record_file

        asked = []

        def train_or_load(algo, env_id, seed, timesteps, folder, *differing, callback=None, compile_update=False):
            asked.append((algo, env_id, seed, timesteps))
            chosen = dict(zip(("hyperparameters", "settings"), differing, strict=False))
            write_json(record_file(Recipe.of(algo, env_id, seed, timesteps, **chosen), folder), {"training_minutes": 1.5})
            model = LAC("MlpPolicy", env_id, device="cpu", buffer_size=10, seed=seed, policy_kwargs={"net_arch": [8]})
            if callback is not None:
                callback.init_callback(model)
                callback.on_training_end()
            return model

        monkeypatch.setattr(benchmark, "train_or_load", train_or_load)
        return asked

    return _train_nothing
