"""Graph points as files: SAGS's row layout, and a picture from the files alone in the capture's own frame; other formats refuse."""

import numpy as np
import pytest
import torch

from scene_experts.core.checkpoint import read_tensors
from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Mode
from scene_experts.evaluate.results import describe_size
from scene_experts.files.formats.ply import read_vertices
from scene_experts.files.graph import write as graph_points
from scene_experts.render import choose
from scene_experts.scene.graph.scene import GraphScene
from scene_experts.training import run_folder
from support.files import export_run
from support.messages import naming


def test_a_row_takes_196_bytes_in_the_layout_of_sags(made):
    run, folder, _ = made
    columns = read_vertices(folder / "point_cloud.ply")
    names = [*"xyz", "nx", "ny", "nz", *(f"feats_{i}" for i in range(32)), "opacity"]
    assert list(columns) == [*names, *(f"scale_{i}" for i in range(6)), *(f"rot_{i}" for i in range(4))]
    assert sum(c.dtype.itemsize for c in columns.values()) == 196 and all(c.dtype == np.float32 for c in columns.values())
    scene = run_folder.open_run(run).scene
    assert describe_size(scene)["ply_bytes"] == 196 * len(columns["x"]) and float(columns["opacity"][0]) == pytest.approx(-2.1972246)
    networks = 4256 + 4320 + 4448 + 6336 + 192 + scene.grid.table.numel()
    assert describe_size(scene)["network_bytes"] == 4 * networks


def test_the_files_alone_give_the_same_picture_in_the_capture_s_own_frame(made):
    run, folder, capture = made
    opened, draw = run_folder.open_run(run), choose("auto", "cpu", deterministic=True)
    columns = {k: torch.from_numpy(v.copy()) for k, v in read_vertices(folder / "point_cloud.ply").items()}
    stack = lambda *names: torch.stack([columns[n] for n in names], dim=1)  # noqa: E731
    params = {"feature": stack(*(f"feats_{i}" for i in range(32))), "log_scaling": stack(*(f"scale_{i}" for i in range(6)))}
    tensors, about = read_tensors(folder / graph_points.NETWORKS, graph_points.KIND)
    xyz = stack(*"xyz")
    assert capture.world.scale != 1
    facts = {"xyz": xyz, "cell": torch.zeros(len(xyz), 3, dtype=torch.int64)}
    scene = GraphScene(opened.config.train.scene, Table(params, facts), 1.0, 1.0, tuple(about["grid"]["low"]), about["grid"]["edge"])
    with torch.no_grad():
        for name, value in scene.network_tensors().items():
            value.copy_(tensors[name])
        camera = capture.views[capture.test[0]].camera
        ours, theirs = (
            opened.scene(camera, 60, Mode.DRAW, draw.visible),
            scene(capture.world.camera_to_input(camera), 60, Mode.DRAW, draw.visible),
        )
    assert torch.equal(ours.gaussians.source, theirs.gaussians.source) and len(ours.gaussians) > 50
    torch.testing.assert_close(theirs.gaussians.colors, ours.gaussians.colors, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(theirs.gaussians.scales * capture.world.scale, ours.gaussians.scales, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("format", ["anchors", "compact"])
def test_formats_that_cannot_hold_it_say_so(format, made):
    with pytest.raises(InputError, match=naming("sags", "ply")):
        export_run(made[0], format)
