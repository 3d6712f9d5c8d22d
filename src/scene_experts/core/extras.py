"""How to install what an optional feature needs."""

from __future__ import annotations

import importlib.metadata
import sys


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
