"""Short runs whose standard files are tested."""

from pathlib import Path

import pytest

from support.exports import short_run


@pytest.fixture(scope="session", params=["moe-gs", "sags", "3dgs"])
def short(request, tmp_path_factory) -> Path:
    return short_run(request.param, tmp_path_factory.mktemp(request.param))
