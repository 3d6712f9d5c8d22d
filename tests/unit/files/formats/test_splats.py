"""Standard Gaussians: shapes are checked, a scene comes back from them in its own world, and its picture stays."""

import dataclasses
import math

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data.views import World
from scene_experts.files.formats.splats import from_scene, to_columns
from scene_experts.scene.gaussians import COLUMNS, Explicit
from support.messages import naming
from support.splats import splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degree_length_and_rows(degree):
    s = splats(5, degree)
    assert s.degree == degree and len(s) == 5
    part = s.rows(torch.tensor([4, 0]))
    assert len(part) == 2 and torch.equal(part.sh[0], s.sh[4]) and torch.equal(part.quats[1], s.quats[0])
    assert len(s.rows(torch.zeros(5, dtype=torch.bool))) == 0


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logit", "sh"])
def test_shapes_that_disagree(name):
    s = splats()
    with pytest.raises(InputError, match=name):
        dataclasses.replace(s, **{name: getattr(s, name)[:4]})
    with pytest.raises(InputError, match=naming("sh", 16)):
        dataclasses.replace(s, sh=s.sh[:, :5])


@pytest.mark.parametrize("degree", [0, 3])
def test_a_scene_to_the_capture_s_frame_and_back(degree):
    world = World(scale=2.5, shift=(1.0, -2.0, 3.0))
    points = Points(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), torch.full((50, 3), 90, dtype=torch.uint8))
    scene = Explicit(sh_degree=degree).start(points, 1.0)
    out = from_scene(scene, world)
    torch.testing.assert_close(out.means, world.to_input(points.xyz.double()).float())
    assert out.degree == degree
    torch.testing.assert_close(out.log_scales, scene.table.params["log_scales"].detach() - math.log(2.5))
    columns = to_columns(out, world)
    assert tuple(columns) == COLUMNS
    for name in COLUMNS:
        torch.testing.assert_close(columns[name], scene.table.params[name].detach(), rtol=1e-6, atol=1e-6)
        assert columns[name].is_contiguous()
