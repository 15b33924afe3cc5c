"""What makes the tests say the same on every machine."""

import gc
import os

# Before numpy and torch are imported: sums depend on how many threads share them
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

gc.set_threshold(50_000, 20, 20)  # few collections find anything

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

# No limit depends on the speed of the machine, and every run tries the same examples; others are searched for with
# ``pytest --hypothesis-profile=search``
_SETTINGS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("search", **_SETTINGS)
settings.register_profile("same", **_SETTINGS, derandomize=True, database=None)
settings.load_profile("same")


def pytest_collection_finish():
    """What has been imported stays: no collection of garbage has to look through it again."""
    gc.freeze()


@pytest.fixture(scope="module")
def dask_cluster(tmp_path_factory):
    """Two workers on this machine, which import the tests as this process does. They cost time while they are idle, too."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    folder = str(tmp_path_factory.mktemp("dask"))
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=":0", local_directory=folder) as started:
        yield started
