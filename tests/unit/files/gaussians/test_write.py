"""Explicit Gaussians in the capture's own frame, and the result folder of 3DGS."""

import json
import math

import pytest
import torch

from scene_experts.core.types import Points
from scene_experts.data.views import World
from scene_experts.files.formats import ply
from scene_experts.files.gaussians import FAMILY
from scene_experts.files.gaussians.read import table_columns
from scene_experts.files.gaussians.write import splats_of
from scene_experts.scene.gaussians import COLUMNS, Explicit
from support.files import run_in_memory


@pytest.mark.parametrize("degree", [0, 3])
def test_a_scene_to_the_capture_s_frame_and_back(degree):
    world = World(scale=2.5, shift=(1.0, -2.0, 3.0))
    points = Points(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), torch.full((50, 3), 90, dtype=torch.uint8))
    scene = Explicit(sh_degree=degree).start(points, 1.0)
    out = splats_of(scene, world)
    torch.testing.assert_close(out.means, world.to_input(points.xyz.double()).float())
    assert out.degree == degree
    torch.testing.assert_close(out.log_scales, scene.table.params["log_scales"].detach() - math.log(2.5))
    columns = table_columns(out, world)
    assert tuple(columns) == COLUMNS
    for name in COLUMNS:
        torch.testing.assert_close(columns[name], scene.table.params[name].detach(), rtol=1e-6, atol=1e-6)
        assert columns[name].is_contiguous()


def test_a_result_folder_holds_the_gaussians_and_says_the_degree(tmp_path):
    run, world = run_in_memory("3dgs"), World(2.0, (1.0, 0.0, 0.0))
    about = FAMILY.describe(run, world)
    assert FAMILY.write(run, world, tmp_path, about) == {"sh_degree": 3} and FAMILY.warnings(run) == []
    assert json.loads(json.dumps(about)) == about and about["kind"] == "gaussians" and about["step"] == run.step
    assert torch.equal(ply.read(tmp_path / "point_cloud.ply").means, splats_of(run.scene, world).means)
