"""How to install what an optional feature needs, and where installed packages keep their files."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from pathlib import Path


def install_line(extra: str) -> str:
    """Return a command that installs the packages of an extra of pyproject.toml, whatever this
    program was installed from: `pip install 'pycolmap>=4.2'`."""
    try:
        stated = importlib.metadata.requires("scene-experts") or []
    except importlib.metadata.PackageNotFoundError:  # run from its source folder
        return f"pip install '.[{extra}]' in the folder of scene-experts"
    found = []
    for line in stated:
        package, _, marker = (part.strip() for part in line.partition(";"))
        elsewhere = 'platform_system == "Linux"' in marker and sys.platform != "linux"
        if f'extra == "{extra}"' in marker and not elsewhere:
            found.append(f"'{package}'")
    return f"pip install {' '.join(found)}"


def find_package_folders(package: str, *parts: str) -> list[Path]:
    """Return the folders `parts` of an installed top-level package that exist. The package is not
    imported."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return []
    roots = (spec.submodule_search_locations if spec else None) or []
    return [folder for root in roots if (folder := Path(root).joinpath(*parts)).is_dir()]
