"""The process that runs pycolmap: what it imports, how it begins and ends."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

from scene_experts.sfm import worker

FOLDER = Path(worker.__file__).parent
WORKER = worker.__name__


def test_the_worker_imports_only_pycolmap_numpy_and_the_standard_library():
    found = set()
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith(f"{WORKER}."):
                found.add((node.module or "").split(".")[0])
    assert found - set(sys.stdlib_module_names) - {"__future__"} == {"pycolmap", "numpy"}  # pycolmap loads numpy


def test_the_worker_loads_nothing_that_pycolmap_does_not_bear():
    code = f"import sys, {WORKER}.__main__; print(*{{'numpy', 'torch', 'PIL', 'cv2'}} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "\n"


def test_a_missing_pycolmap_is_reported(tmp_path):
    ask = json.dumps({"seed": 0}) + "\n"
    code = f"import sys, runpy; sys.modules['pycolmap'] = None; runpy.run_module({WORKER!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], input=ask, capture_output=True, text=True)
    assert done.returncode == 0 and json.loads(done.stdout)["step"] == "missing"


def test_the_worker_ends_when_its_parent_ends(tmp_path):
    """The parent is killed while a stand-in for pycolmap sleeps."""
    (tmp_path / "pycolmap.py").write_text("import time\ndef set_random_seed(seed):\n    print('here', flush=True)\n    time.sleep(60)\n")
    code = "import os, subprocess, sys; p = subprocess.Popen([sys.executable, '-m', sys.argv[1]], stdin=subprocess.PIPE); " \
        "p.stdin.write(b'{\"seed\": 0}\\n'); p.stdin.flush(); print(p.pid, flush=True); import time; time.sleep(60)"  # fmt: skip
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])}
    parent = subprocess.Popen([sys.executable, "-c", code, WORKER], stdout=subprocess.PIPE, text=True, env=env)
    said = {parent.stdout.readline().strip(), parent.stdout.readline().strip()}
    parent.kill()
    assert "here" in said
    assert parent.stdout.read() == ""  # returns when the worker, which holds the other end, ends
    parent.wait()
