"""What every test shares: one thread, and GPU tests only where there is a CUDA device."""

import os

import pytest
import torch

pytest.register_assert_rewrite("support")  # asserts in support modules show their values too

# One thread, here and in the commands that tests start: more threads slow small tensors down on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")
torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)
