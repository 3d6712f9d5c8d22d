"""What is written is in the capture's own frame: the same scene, seen from the same cameras, decodes to the same Gaussians."""

import math

import pytest
import torch

from scene_experts.data.views import World
from scene_experts.files.anchors import frame

WORLD = World(scale=2.5, shift=(1.0, -20.0, 0.125))


def test_positions_and_lengths():
    anchors = {"xyz": torch.tensor([[5.0, -2.5, 0.0]]), "log_scaling": torch.zeros(1, 6), "feature": torch.ones(1, 2)}
    found = frame.anchors_to_input(anchors, WORLD)
    torch.testing.assert_close(found["xyz"], torch.tensor([[2.0 - 1.0, -1.0 + 20.0, -0.125]]))
    torch.testing.assert_close(found["log_scaling"], torch.full((1, 6), -math.log(2.5)))
    assert found["feature"] is anchors["feature"]
    back = frame.anchors_from_input(found, WORLD)
    torch.testing.assert_close(back, anchors)


def test_the_lattice_in_both_frames():
    cells = torch.randint(-(2**20), 2**20, (1000, 3))
    voxel = 0.0013
    edge, origin = frame.lattice_to_input(voxel, WORLD)
    trained = frame.cell_positions(cells, voxel)
    torch.testing.assert_close(frame.cell_positions(cells, edge, origin), WORLD.to_input(trained.double()).float(), rtol=1e-6, atol=1e-4)
    for positions, size, at in ((trained, voxel, (0.0, 0.0, 0.0)), (frame.cell_positions(cells, edge, origin), edge, origin)):
        found = frame.cells_of(positions, size, at)
        assert found is not None and torch.equal(found, cells)
    assert frame.cells_of(trained, voxel * 1.01) is None
    assert frame.cells_of(torch.zeros(0, 3), voxel).shape == (0, 3)


@pytest.mark.parametrize("sees_distance", [True, False])
def test_decoded_gaussians_are_the_same_after_the_move(sees_distance):
    """mu = x + O exp(l)[:3], scale = exp(l)[3:] s, networks of (feature, direction, distance): written out and compared in both frames."""
    torch.manual_seed(0)
    n, F, H, out = 20, 4, 8, 6
    anchors = {"xyz": torch.randn(n, 3), "log_scaling": torch.randn(n, 6), "feature": torch.randn(n, F), "offsets": torch.randn(n, 5, 3)}
    network = {"w1": torch.randn(2, H, F + 3 + sees_distance), "b1": torch.randn(2, H), "w2": torch.randn(2, out, H)}
    names = ("color",) if sees_distance else ()
    moved_networks = frame.networks_to_input({"color": network, "opacity": network}, names, WORLD.scale, F)
    moved = frame.anchors_to_input(anchors, WORLD)
    camera = torch.tensor([[3.0, 4.0, -5.0]])

    def decode(a, w, camera):
        v = a["xyz"] - camera
        d = v.norm(dim=1, keepdim=True)
        x = torch.cat([a["feature"], v / d] + ([d] if sees_distance else []), 1)
        y = [torch.relu(x @ w["w1"][e].T + w["b1"][e]) @ w["w2"][e].T for e in range(2)]
        return a["xyz"][:, None] + a["offsets"] * a["log_scaling"][:, None, :3].exp(), a["log_scaling"][:, 3:].exp(), torch.stack(y)

    means, scales, y = decode(anchors, network, camera)
    means_in, scales_in, y_in = decode(moved, moved_networks["color"], WORLD.to_input(camera))
    torch.testing.assert_close(WORLD.from_input(means_in), means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scales_in * WORLD.scale, scales)
    torch.testing.assert_close(y_in, y, rtol=1e-4, atol=1e-3)
    assert moved_networks["opacity"] is network
    back = frame.networks_from_input(moved_networks, names, WORLD.scale, F)
    torch.testing.assert_close(back["color"], network)


@pytest.mark.parametrize("voxel", [0.001, 0.0137, 3.3])
def test_a_voxel_size_that_nothing_says_is_found_again(voxel):
    g = torch.Generator().manual_seed(2)
    cells = torch.randint(-3000, 3000, (4000, 3), generator=g)
    found = frame.recover_voxel(frame.cell_positions(cells, voxel))
    assert found == pytest.approx(voxel, rel=1e-6)
    assert torch.equal(frame.cells_of(frame.cell_positions(cells, voxel), found), cells)
    assert frame.recover_voxel(torch.randn(1000, 3, generator=g)) is None
    assert frame.recover_voxel(torch.ones(3, 3)) is None and frame.recover_voxel(torch.zeros(0, 3)) is None
