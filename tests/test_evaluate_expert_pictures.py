"""Pictures of single experts: together they hold every Gaussian as often as its anchor has experts."""

import torch

from scene_experts.evaluate.expert_pictures import alone, chosen_by, keep
from scene_experts.render import choose
from test_scene import CAMERA, started


def test_top_2_puts_every_gaussian_into_two_pictures():
    scene, draw = started("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 2000, False, draw.visible)
    mine = chosen_by(decoded, "color", scene.K)
    assert mine.shape == (len(decoded.gaussians), 5) and (mine.sum(1) == 2).all()
    routing = decoded.routing["color"].chosen
    assert routing is not None
    for m in (0, len(decoded.gaussians) - 1):
        row = int(decoded.gaussians.source[m]) // scene.K
        assert set(mine[m].nonzero().flatten().tolist()) == set(routing[decoded.rows.tolist().index(row)].tolist())
    assert len(keep(decoded.gaussians, mine[:, 0])) == int(mine[:, 0].sum())


def test_while_dense_each_gaussian_is_in_the_picture_of_its_largest_gate():
    scene, draw = started("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 1, False, draw.visible)
    assert (chosen_by(decoded, "cov", scene.K).sum(1) == 1).all()


def test_the_pictures():
    scene, draw = started("moe-gs"), choose("auto", "cpu")
    whole, each = alone(scene, CAMERA, 2000, draw, torch.zeros(3))
    assert whole.shape == (32, 48, 3) and len(each) == 5 and each[0].shape == whole.shape
    assert whole.max() > 0.01 and any(not torch.equal(e, whole) for e in each)
