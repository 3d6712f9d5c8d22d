"""The benchmark scene: any number of Gaussians, finite values, deterministic."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.bench import cloud


@pytest.fixture(scope="module")
def made():
    return cloud.make_cloud()


@pytest.mark.parametrize("count", [1_000, 4_000])
def test_any_number_of_gaussians(made, count):
    made = replace(made, xyz=made.xyz[::50], rgb=made.rgb[::50])  # 2,776 points: fewer and more than that
    g, camera = cloud.make_scene(made, count, 200, 130)
    assert len(g) == count and (camera.width, camera.height) == (200, 130)
    assert all(torch.isfinite(t).all() for t in (g.means, g.quats, g.scales, g.opacities, g.colors))
    assert (g.scales > 0).all() and g.opacities.min() > 0 and g.opacities.max() < 1
    torch.testing.assert_close(g.quats.norm(dim=1), torch.ones(count))
    again, _ = cloud.make_scene(made, count, 200, 130)
    assert torch.equal(g.means, again.means)


def test_the_camera_looks_at_the_table(made):
    inside = made.view @ np.array([0, 0, 0, 1.0])
    assert inside[2] > 0 and abs(inside[0]) < 1e-9 and np.allclose(made.view[:3, :3] @ made.view[:3, :3].T, np.eye(3))
