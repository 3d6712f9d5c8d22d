"""Where the package is installed."""

from pathlib import Path

import scene_experts
from scene_experts.core import version


def test_the_folders_hold_the_package():
    assert Path(scene_experts.__file__).parent in version.package_folders() and scene_experts.__version__ == version.__version__
