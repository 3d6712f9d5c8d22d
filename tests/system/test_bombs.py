"""Valid files that unpack to all that their budget admits stay below 1 GiB and 5 s."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

BOMBS = Path(__file__).resolve().parents[2] / "benchmarks" / "bombs.py"


@pytest.mark.slow
def test_bombs_are_read_within_their_budget():
    command = [sys.executable, str(BOMBS), "--sizes", "0.1", "--only", "glb", "compact", "png"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    found = re.findall(r"^(\w+) .* (\d+) MiB .* accepted$", done.stdout, re.MULTILINE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [name for name, _ in found] == ["compact", "glb", "png"] and all(int(size) < 600 for _, size in found)
