"""The process that runs pycolmap: its words, without it."""

import ast
import json
import subprocess
import sys
from pathlib import Path

from scene_experts.sfm import worker

SOURCE = Path(worker.__file__)


def test_it_imports_nothing_of_this_project_nor_what_pycolmap_does_not_bear():
    found = set()
    for node in ast.walk(ast.parse(SOURCE.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
    assert found - set(sys.stdlib_module_names) - {"__future__"} == {"pycolmap"}


def test_it_says_so_where_pycolmap_is_missing(tmp_path):
    ask = json.dumps({"sparse": str(tmp_path)})
    code = f"import sys, runpy; sys.modules['pycolmap'] = None; runpy.run_path({str(SOURCE)!r}, run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], input=ask, capture_output=True, text=True)
    assert done.returncode == 0 and json.loads(done.stdout)["step"] == "missing"


class Model:
    """A reconstruction with `count` photographs."""

    def __init__(self, count, written):
        self.images, self.cameras = {}, {}
        self.count, self.written = count, written

    def num_reg_images(self):
        return self.count

    def num_points3D(self):
        return 10 * self.count

    def write_binary(self, folder):
        self.written.append((self.count, folder))

    def reg_image_ids(self):
        return []

    def compute_mean_reprojection_error(self):
        return 0.5

    compute_mean_observations_per_reg_image = compute_mean_reprojection_error


def reconstruct(tmp_path, monkeypatch, incremental, at_once, mapper="auto"):
    """Which mappers ran and which model was written, for models of these sizes; None: the mapper fails."""
    ran, written = [], []

    def mapping(name, sizes):
        def run(colmap, ask, out, total):
            ran.append(name)
            if sizes is None:
                raise RuntimeError("no good pair")
            return {i: Model(size, written) for i, size in enumerate(sizes)}

        return run

    monkeypatch.setattr(worker, "MAPPERS", {"incremental": mapping("incremental", incremental), "global": mapping("global", at_once)})
    ask = {"sparse": str(tmp_path), "groups": [["x"] * 10], "mapper": mapper}
    return ran, written, worker.poses(None, ask)


def test_the_second_mapper_is_tried_where_the_first_leaves_many_out(tmp_path, monkeypatch, capsys):
    ran, written, found = reconstruct(tmp_path, monkeypatch, [9, 3], [10])
    assert ran == ["incremental"] and written == [(9, str(tmp_path))] and found["models"] == [9, 3]
    ran, written, found = reconstruct(tmp_path, monkeypatch, [4], [7])
    assert ran == ["incremental", "global"] and written[0][0] == 7 and found["mapper"] == "global" and found["models"] == [7]
    ran, written, found = reconstruct(tmp_path, monkeypatch, [4], None)
    assert written[0][0] == 4 and found["mapper"] == "incremental" and "no good pair" in capsys.readouterr().out
    ran, written, found = reconstruct(tmp_path, monkeypatch, [], [], mapper="global")
    assert ran == ["global"] and not written and found == {"registered": []}
