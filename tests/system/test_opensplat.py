"""benchmarks/opensplat.py with a program in OpenSplat's place: it gets the training views alone, and its PLY is scored like our run."""

import subprocess
import sys

import pytest

from scene_experts import cli
from support.places import ROOT
from support.synthetic import make_capture

PROGRAM = """#!{python}
import shutil, sys
from pathlib import Path
from scene_experts.data.capture import load
from scene_experts.data.settings import Data
assert sys.argv[2:4] == ["-n", "20"] and "--keep-crs" in sys.argv
capture = load(Data(Path(sys.argv[1]), split="none"))
assert len(capture.views) == 10 and all(max(v.camera.width, v.camera.height) <= 32 for v in capture.views)
shutil.copy("{ply}", sys.argv[sys.argv.index("-o") + 1])
"""


@pytest.mark.slow
def test_the_race(tmp_path):
    capture = make_capture(tmp_path / "capture", views=12, size=(48, 32), points=200)
    run = tmp_path / "3dgs"
    assert cli.main(["train", "3dgs", "--data", str(capture.folder), "--out", str(run), "--iterations", "10", "--device", "cpu"]) == 0
    assert cli.main(["export", str(run), "--format", "ply", "--out", str(tmp_path / "scene.ply")]) == 0
    program = tmp_path / "opensplat"
    program.write_text(PROGRAM.format(python=sys.executable, ply=tmp_path / "scene.ply"))
    program.chmod(0o755)
    words = [str(program), "--capture", str(capture.folder), "--side", "32", "--iterations", "20", "--peer-iterations", "20"]
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "opensplat.py"), *words, "--out", str(tmp_path / "race")],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("10 training views") and lines[2].startswith("moe-gs, 20") and lines[3].startswith("OpenSplat, 20")
    assert all(float(line.split()[-2]) > 5 for line in lines[2:])
