"""The radii of the Triton kernel against the reference projection."""

from dataclasses import replace

import pytest
import torch

from scene_experts.render.project_cuda import find_radii
from scene_experts.render.reference import project, visible
from support.gaussians import make_camera, make_scene
from support.interpret import DEVICE, kernels


@pytest.fixture(scope="module", autouse=True)
def _triton():
    kernels("scene_experts.render.triton_project")


def moved(*tensors):
    return [t.float().to(DEVICE) for t in tensors]


@pytest.mark.parametrize(("size", "centre"), [(0.04, (None, None)), (0.3, (90.0, 40.5)), (0.003, (60.0, 80.5))])
def test_radii_of_the_reference(size, centre):
    torch.manual_seed(1)
    g, camera = make_scene(900, size=size, spread=1.6), make_camera(149, 117, *centre, f=140.0).to(dtype=torch.float32)
    means = g.means.clone()
    means[::50] *= 30  # far outside
    means[1] = float("nan")
    arguments = moved(means, g.quats, g.scales)
    expected = project(*(t.cpu() for t in arguments), camera).radii
    found = find_radii(*arguments, camera).cpu()
    assert found.dtype == torch.int32 and (expected > 0).sum() > 100 and (expected == 0).any()
    assert (found != expected).float().mean() < 0.005 and (found - expected).abs().max() <= 1, "rounding before ceil"


def test_unrotated_gaussians_and_extents():
    torch.manual_seed(2)
    g, camera = make_scene(300, size=0.1, spread=2.0), make_camera(149, 117, f=140.0).to(dtype=torch.float32)
    means, scales = moved(g.means, g.scales)
    extents = torch.full((1, 300, 2), 7, dtype=torch.int32, device=DEVICE)
    radii = find_radii(means, None, scales, camera, extents)
    assert torch.equal((radii > 0).cpu(), visible(means.cpu(), scales.cpu(), camera))
    assert torch.equal(extents[0, :, 0] > 0, radii > 0) and torch.equal(extents[0, :, 1] > 0, radii > 0)
    assert extents[extents > 0].eq(7).all()


def test_no_gaussians_and_a_camera_elsewhere():
    camera = replace(make_camera(149, 117, f=140.0).to(dtype=torch.float32), near=1e9)
    assert find_radii(*moved(torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3)), camera).shape == (0,)
    assert not find_radii(*moved(torch.zeros(5, 3), torch.ones(5, 4), torch.ones(5, 3)), camera).any(), "behind the near plane"
