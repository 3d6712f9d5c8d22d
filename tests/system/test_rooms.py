"""An export visits at most 12 of our modules, besides those that open the run, bake, measure and check files (tools/rooms.py)."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from scene_experts.cli import main
from support.synthetic import make_capture

TOOL = Path(__file__).parents[2] / "tools" / "rooms.py"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("rooms")
    folder = make_capture(root / "capture", views=9, size=(24, 16), points=60).folder
    words = ["--data", str(folder), "--out", str(root / "run"), "--iterations", "300", "--stop-at", "12", "--device", "cpu"]
    assert main(["train", "moe-gs", *words]) == 0
    return root / "run"


@pytest.mark.slow
@pytest.mark.parametrize("words", [["compact"], ["anchors"], ["ply", "--refine", "2"]])
def test_one_export_visits_at_most_12_modules(run, words, tmp_path):
    command = [sys.executable, str(TOOL), "export", str(run), "--out", str(tmp_path / "out"), "--format", *words]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    on_the_way = re.findall(r"^ *\d+  (\S+) +entered.*  on the way itself", out, re.M)
    assert 5 < len(on_the_way) <= 12, on_the_way
    assert f"{len(on_the_way)} modules on the way itself" in out and "modules opening the run and its capture" in out
