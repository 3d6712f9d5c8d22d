"""The types that users of the package see are complete."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import scene_experts

PYRIGHT = Path(sys.executable).with_name("pyright")


@pytest.mark.slow
@pytest.mark.skipif(not PYRIGHT.is_file(), reason="pyright is not installed")
def test_every_name_has_a_known_type(tmp_path):
    places = [str(Path(scene_experts.__file__).parents[1]), *(p for p in sys.path if p.endswith("site-packages"))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places), "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    words = [str(PYRIGHT), "--verifytypes", "scene_experts", "--ignoreexternal", "--outputjson"]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    report = json.loads(done.stdout[done.stdout.index("{") :])["typeCompleteness"]
    unknown = [symbol["name"] for symbol in report["symbols"] if symbol["isExported"] and not symbol["isTypeKnown"]]
    assert report["exportedSymbolCounts"]["withKnownType"] > 1000, "the package and its dependencies were found"
    assert not unknown
