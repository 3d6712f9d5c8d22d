"""The version of the package, which `pyproject.toml` reads here, and the folders where it is
installed."""

from importlib.util import find_spec
from pathlib import Path

__version__ = "0.1.0"


def package_folders() -> list[Path]:
    """The folders of the package: several where it is installed to be edited, and its libraries lie
    elsewhere."""
    spec = find_spec(__name__.partition(".")[0])
    return [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
