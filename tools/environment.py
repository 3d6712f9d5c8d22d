"""Fills the virtual environment it runs in: torch (the caller's, if it has one; else the pinned CPU build), then the project, editable.

Usage: .venv/bin/python tools/environment.py PYTHON    where PYTHON is the interpreter whose torch may be used.
"""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
FIND_TORCH = """
import sys, pathlib
import torch
assert sys.version_info[:2] == (%d, %d) and tuple(int(x) for x in torch.__version__.split('+')[0].split('.')[:2]) >= (2, 7)
print(pathlib.Path(torch.__file__).parents[1])
"""


def pip(*args: str) -> None:
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", *args], check=True, cwd=ROOT)


def has_torch() -> bool:
    return subprocess.run([sys.executable, "-c", "import torch"], capture_output=True, check=False).returncode == 0


def borrow(python: str) -> Path | None:
    """The folder that `python` imports a fitting torch from, or None."""
    found = subprocess.run([python, "-c", FIND_TORCH % sys.version_info[:2]], capture_output=True, text=True, check=False)
    return Path(found.stdout.strip()) if found.returncode == 0 else None


def main() -> None:
    constraints = ["-c", str(CONSTRAINTS)]
    if not has_torch():
        folder = borrow(sys.argv[1])
        if folder:
            print(f"using the torch installed in {folder}")
            (Path(sysconfig.get_path("purelib")) / "borrowed-torch.pth").write_text(f"{folder}\n")
            rest = [line for line in CONSTRAINTS.read_text().splitlines() if not line.startswith("torch==")]
            relaxed = Path(sys.prefix) / "constraints.txt"
            relaxed.write_text("\n".join(rest) + "\n")
            constraints = ["-c", str(relaxed)]
        else:
            print("installing torch (CPU build)")
            pip("torch", *constraints)
    print("building scene-experts")
    pip("-e", ".[test]", *constraints)


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(
            f"could not prepare the environment: `{' '.join(map(str, error.cmd))}` failed (see above); check the network and try again"
        )
