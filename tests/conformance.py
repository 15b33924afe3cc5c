"""
Run the tests of Stable-Baselines3 and of SB3-Contrib with LAC, or PublishedLAC, in place of SAC and of TQC:

    pip install -e ./battery_env -e .[peers,dev]
    git clone --depth 1 --branch v2.9.0 https://github.com/DLR-RM/stable-baselines3 /tmp/sb3
    git clone --depth 1 --branch v2.9.0 https://github.com/Stable-Baselines-Team/stable-baselines3-contrib /tmp/sb3-contrib
    python tests/conformance.py /tmp/sb3/tests
    python tests/conformance.py /tmp/sb3-contrib/tests
    ALGORITHM=PublishedLAC python tests/conformance.py /tmp/sb3/tests

Options of pytest can follow, for instance ``-k test_save_load`` or ``--durations=10``. Only tests of SAC and of TQC are run.
A test that passes without having made a model of LAC is reported as skipped. ``NOT_APPLICABLE`` lists the tests that ask for
what only SAC does, with the reason. The argument ``n_quantiles`` of the policy, which only TQC has, is left out.
"""

import functools
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import sb3_contrib
import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm

# Without this, ``sb3_lac`` would be the folder of tests next to this file
sys.path.insert(0, str(Path(__file__).parents[1]))

import sb3_lac

LAC = getattr(sb3_lac, os.environ.get("ALGORITHM", "LAC"))
NOT_APPLICABLE = {
    f"test_gae.py::test_infinite_horizon[True-{LAC.__name__}]": "the critic must learn a return of positive rewards",
    f"test_gae.py::test_infinite_horizon[False-{LAC.__name__}]": "the critic must not learn that return, which it never does",
    "test_tensorboard.py::test_tensorboard[sac]": "the folder of the log must have the name of SAC",
    "test_cnn.py::test_features_extractor_target_net[True-PublishedLAC]": "all networks must have one learning rate",
    "test_cnn.py::test_features_extractor_target_net[False-PublishedLAC]": "all networks must have one learning rate",
    "test_cnn.py::test_feature_extractor_target_net[True-PublishedLAC]": "all networks must have one learning rate",
    "test_cnn.py::test_feature_extractor_target_net[False-PublishedLAC]": "all networks must have one learning rate",
    "test_custom_policy.py::test_custom_offpolicy[PublishedLAC-net_arch0]": "the critic must do without a layer",
    "test_identity.py::test_continuous[PublishedLAC]": "400 steps must do, of which its learning starts after 1000",
}
if LAC is sb3_lac.PublishedLAC:
    NOT_APPLICABLE["test_save_load.py::test_save_load_pytorch_var"] = (
        "256 steps must do, of which its learning starts after 1000"
    )


class Conformance:
    """Plugin of pytest, which puts LAC in place before the tests import SAC and TQC."""

    def __init__(self) -> None:
        self.n_models = 0
        replaced = (stable_baselines3.SAC, sb3_contrib.TQC)
        for module_name in [name for name in sys.modules if name.split(".")[0] in ("stable_baselines3", "sb3_contrib")]:
            for name, value in list(vars(sys.modules[module_name]).items()):
                if value in replaced:
                    setattr(sys.modules[module_name], name, LAC)

        init = LAC.__init__

        @functools.wraps(init)
        def counted_init(*args: Any, **kwargs: Any) -> None:
            self.n_models += 1
            (kwargs.get("policy_kwargs") or {}).pop("n_quantiles", None)
            init(*args, **kwargs)

        LAC.__init__ = counted_init

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        # Other files may need packages that these tests do not need
        if collection_path.is_file() and not any(name in collection_path.read_text("utf-8") for name in ("SAC", "TQC")):
            return True
        return None

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Function]) -> None:
        selected = select(items)
        config.hook.pytest_deselected(items=[item for item in items if item not in selected])
        items[:] = selected
        for item in items:
            reason = NOT_APPLICABLE.get(f"{item.path.name}::{item.name}")
            if reason is not None:
                item.add_marker(pytest.mark.skip(reason=reason))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self) -> Iterator[None]:
        n_models = self.n_models
        yield
        if self.n_models == n_models:
            pytest.skip("makes no model of LAC")


def holds_lac(value: Any) -> bool:
    """Whether a value is LAC, or a collection with LAC in it."""
    if isinstance(value, dict):
        return any(map(holds_lac, value.values()))
    return value is LAC or (isinstance(value, (list, tuple, set)) and any(map(holds_lac, value)))


def names_lac(function: Callable[..., Any]) -> bool:
    """Whether the code of a test has a name that stands for LAC, or for a collection with LAC in it."""
    return any(holds_lac(function.__globals__.get(name)) for name in function.__code__.co_names)


def select(items: list[pytest.Function]) -> list[pytest.Function]:
    """The tests that take LAC as a parameter and, of those that take no algorithm, the ones that name LAC."""
    parameters = {item: list(item.callspec.params.values()) if hasattr(item, "callspec") else [] for item in items}
    take_algorithm = {
        item.function
        for item in items
        if any(isinstance(value, type) and issubclass(value, BaseAlgorithm) for value in parameters[item])
    }
    return [
        item
        for item in items
        if holds_lac(parameters[item]) or (item.function not in take_algorithm and names_lac(item.function))
    ]


if __name__ == "__main__":
    sys.exit(pytest.main(["-rfEs", *sys.argv[1:]], plugins=[Conformance()]))
