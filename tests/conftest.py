"""Settings of all tests: one thread, markers that depend on the folder or the machine, and the number of processes."""

import math
import os
from pathlib import Path

import pytest

# A card is hidden, so that the tests are the same on every machine; `make gpu` runs those that are for one, and the kernels' tests.
if not os.environ.get("SCENE_EXPERTS_GPU"):
    os.environ["CUDA_VISIBLE_DEVICES"] = ""

import torch

pytest.register_assert_rewrite("support")  # asserts in support modules show their values too

# One thread, here and in the commands that tests start: more threads slow small tensors down on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(1)

TESTS = Path(__file__).parent
MOST_WORKERS = 8  # each one holds torch in memory


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests in tests/system, and skip those marked `gpu` where there is no CUDA device."""
    skip = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if TESTS / "system" in item.path.parents:
            item.add_marker(pytest.mark.system)
        if "gpu" in item.keywords and not torch.cuda.is_available():
            item.add_marker(skip)


@pytest.fixture(autouse=True, scope="session")
def _hold_out_of_few():
    """Hold out every 8th of the few views that made captures have, as of more."""
    from scene_experts.data import prepare

    prepare.FEW = 0


@pytest.fixture(autouse=True)
def _restore_algorithms():
    """Undo what `--deterministic` sets for the whole process, so that no test depends on those before it."""
    yield
    torch.use_deterministic_algorithms(False)


def cores() -> int:
    """Return the number of cores that this process may use: its CPU affinity, limited by the quota of its container."""
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return min(bound, max(1, math.ceil(int(quota) / int(period))))
    except (OSError, ValueError):  # no quota
        return bound


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """The processes of `pytest -n auto`: one per core. On a single core the tests run in this process."""
    workers = min(cores(), MOST_WORKERS)
    return workers if workers > 1 else 0
