"""Fills the virtual environment it runs in: torch (the caller's, if it has one; else the pinned version), then the project.

Usage: .venv/bin/python tools/environment.py PYTHON    where PYTHON is the interpreter whose torch may be used.
"""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
STEPS = ("Collecting", "Downloading", "Installing", "Preparing", "Building", "Getting", "Using cached", "Created")  # lines of pip
FIND_TORCH = """
import sys, pathlib
import torch
assert sys.version_info[:2] == (%d, %d) and tuple(int(x) for x in torch.__version__.split('+')[0].split('.')[:2]) >= (2, 7)
print(pathlib.Path(torch.__file__).parents[1])
"""


def shorten(step: str) -> str:
    """A line of pip as one short line: without versions, sizes and the long list of packages."""
    if step.startswith("Installing"):
        return f"Installing {step.count(',') + 1} packages"
    if step.startswith("Building editable"):
        return "Compiling scene-experts"
    return step.split(" (")[0][:80]


def pip(*args: str) -> None:
    """Run pip. Every three seconds it prints what pip does, so that nobody waits before a silent screen; an error prints all of it."""
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--progress-bar", "off", *args]
    with TemporaryFile("w+", errors="replace") as log:
        process, started = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT), time.monotonic()
        while process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(3)
            log.seek(0)
            steps = [line.strip() for line in log.readlines() if line.lstrip().startswith(STEPS)]
            if process.poll() is None:
                print(f"  {time.monotonic() - started:3.0f} s  {shorten(steps[-1]) if steps else 'Looking for packages'}", flush=True)
        if process.returncode:
            log.seek(0)
            print(log.read())
            raise subprocess.CalledProcessError(process.returncode, command)


def has_torch() -> bool:
    return subprocess.run([sys.executable, "-c", "import torch"], capture_output=True, check=False).returncode == 0


def borrow(python: str) -> Path | None:
    """The folder that `python` imports a fitting torch from, or None."""
    found = subprocess.run([python, "-c", FIND_TORCH % sys.version_info[:2]], capture_output=True, text=True, check=False)
    return Path(found.stdout.strip()) if found.returncode == 0 else None


def main() -> None:
    constraints = ["-c", str(CONSTRAINTS)]
    borrowed, relaxed = Path(sysconfig.get_path("purelib")) / "borrowed-torch.pth", Path(sys.prefix) / "constraints.txt"
    if not has_torch():
        folder = borrow(sys.argv[1])
        if folder:
            print(f"using the torch installed in {folder}")
            borrowed.write_text(f"{folder}\n")
        else:
            print(f"installing torch (to use another build of it, for example one for the CPU, install that build for {sys.argv[1]} first)")
            pip("torch", *constraints)
    if borrowed.exists():  # a later run too must not fetch the pinned one beside it
        rest = [line for line in CONSTRAINTS.read_text().splitlines() if not line.startswith("torch==")]
        relaxed.write_text("\n".join(rest) + "\n")
        constraints = ["-c", str(relaxed)]
    print("installing scene-experts and the packages that it needs")
    pip("-e", ".[test]", *constraints)


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(
            f"could not prepare the environment: `{' '.join(map(str, error.cmd))}` failed (see above); check the network and try again"
        )
