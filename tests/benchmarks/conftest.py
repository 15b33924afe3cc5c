from collections.abc import Callable
from types import ModuleType

import pytest

from sb3_lac import LAC


@pytest.fixture
def train_nothing(monkeypatch) -> Callable[[ModuleType], list[tuple]]:
    def _train_nothing(benchmark: ModuleType) -> list[tuple]:
        """Let a benchmark judge models that are not trained."""
        from benchmarks.runs import record_file
        from benchmarks.study import write_json

        asked = []

        def train_or_load(run, folder, judge=None, callbacks=(), compiled=False, log=None):
            asked.append((run.kind, run.task, run.seed, run.timesteps))
            settings = {"buffer_size": 10, "policy_kwargs": {"net_arch": [8]}}
            model = LAC("MlpPolicy", run.environments(1), device="cpu", seed=run.seed, **settings)
            curve = [] if judge is None else [judge(model, run)]
            record = {"training_minutes": 1.5, "versions": {}, "timesteps": run.timesteps, "updates": 0, "curve": curve}
            write_json(record_file(run, folder), record)
            return model

        monkeypatch.setattr(benchmark, "train_or_load", train_or_load)
        return asked

    return _train_nothing
