"""Pictures of single experts: together they hold every Gaussian as often as its anchor has experts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.evaluate import pictures
from scene_experts.evaluate.expert_pictures import WIDEST, alone, chosen_by, keep, strip, write
from scene_experts.render import choose
from support.scenes import CAMERA, start_scene


def test_top_2_puts_every_gaussian_into_two_pictures():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 2000, Mode.DRAW, draw.visible)
    mine = chosen_by(decoded, "color", scene.K)
    assert mine.shape == (len(decoded.gaussians), 5) and (mine.sum(1) == 2).all()
    routing = decoded.routing["color"].chosen
    assert routing is not None
    for m in (0, len(decoded.gaussians) - 1):
        row = int(decoded.gaussians.source[m]) // scene.K
        assert set(mine[m].nonzero().flatten().tolist()) == set(routing[decoded.rows.tolist().index(row)].tolist())
    assert len(keep(decoded.gaussians, mine[:, 0])) == int(mine[:, 0].sum())


def test_while_dense_each_gaussian_is_in_the_picture_of_its_largest_gate():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 1, Mode.DRAW, draw.visible)
    assert (chosen_by(decoded, "cov", scene.K).sum(1) == 1).all()


def test_the_pictures():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    whole, each = alone(scene, CAMERA, 2000, draw, torch.zeros(3))
    assert whole.shape == (32, 48, 3) and len(each) == 5 and each[0].shape == whole.shape
    assert whole.max() > 0.01 and any(not torch.equal(e, whole) for e in each)


def test_a_strip_holds_the_pictures_in_order():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    whole, each = alone(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity")
    sheet = strip(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity")
    panel = 48 + pictures.GAP
    assert sheet.shape == (pictures.BAR + 32, 6 * panel - pictures.GAP, 3) and len(each) == 5
    for i, picture in enumerate((whole, *each)):
        assert np.array_equal(sheet[pictures.BAR :, i * panel :][:, :48], pictures.to_8bit(picture))
    assert strip(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity", 24).shape == (
        pictures.BAR + 16,
        6 * (24 + pictures.GAP) - pictures.GAP,
        3,
    )


@pytest.mark.parametrize(
    ("recipe", "names"), [("moe-gs", {"opacity.png", "cov.png", "color.png"}), ("scaffold-gs", set()), ("3dgs", set())]
)
def test_a_file_for_each_attribute_with_experts(recipe, names, tmp_path):
    large = replace(CAMERA, K=CAMERA.K * torch.tensor([[20.0], [20], [1]]), width=960, height=640)
    write(tmp_path, start_scene(recipe), large, 2000, choose("auto", "cpu"), torch.zeros(3))
    found = list((tmp_path / "experts").glob("*"))
    assert {path.name for path in found} == names
    for sheet in map(pictures.read, found):
        assert sheet.shape[1] == 6 * (WIDEST + pictures.GAP) - pictures.GAP
        assert sheet[-320:, :WIDEST].max() > 20, "the whole picture is no black one"
