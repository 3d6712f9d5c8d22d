"""Blocks of a capture: every place belongs to one block, and every view to at least one."""

import math

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.blocks import FAR, Block, make_blocks, read_plan, read_view_names, split_box, visible, write_plan
from support.captures import load
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    found = load(make_capture(tmp_path_factory.mktemp("blocks") / "box", views=12, size=(48, 32), points=500).folder)
    found.images.close()
    return found


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_every_place_lies_in_one_block_and_points_are_shared_evenly(count):
    xyz = torch.randn(2_000, 3, dtype=torch.float64) * torch.tensor([5.0, 1.0, 2.0])
    boxes = split_box(xyz, Block((-math.inf,) * 3, (math.inf,) * 3), count)
    assert len(boxes) == count
    everywhere = torch.cat([xyz, 100 * torch.randn(500, 3).double()])
    assert (torch.stack([box.holds(everywhere) for box in boxes]).sum(0) == 1).all(), "also far outside and on the sides"
    sizes = [int(box.holds(xyz).sum()) for box in boxes]
    assert max(sizes) - min(sizes) <= count


def test_points_at_one_place_are_not_divided():
    xyz = torch.zeros(8, 3, dtype=torch.float64)
    xyz[:2, 1] = 1.0
    assert len(split_box(xyz, Block((-math.inf,) * 3, (math.inf,) * 3), 1)) == 1
    with pytest.raises(InputError, match=r"into 2 blocks, found 6 .*--blocks"):
        split_box(xyz, Block((-math.inf,) * 3, (math.inf,) * 3), 2)


def test_every_training_view_has_a_block_and_held_out_views_have_none(capture):
    blocks = make_blocks(capture, 3)
    named = {name for block in blocks for name in block.views}
    assert named == {capture.views[index].name for index in capture.train}
    one = make_blocks(capture, 1)
    assert len(one[0].views) == len(capture.train)
    few = make_blocks(capture, 3, share=1.0)
    assert sum(len(block.views) for block in few) < 3 * len(capture.train), "a view may belong to one block alone"


def test_points_behind_a_camera_and_beside_the_picture_are_not_visible(capture):
    camera = capture.views[0].camera
    pose = camera.world_to_cam.double()
    local = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [30.0, 0.0, 3.0]], dtype=torch.float64)
    world = (local - pose[:3, 3]) @ pose[:3, :3]
    assert visible(capture.views[0], world).tolist() == [True, False, False]


def test_a_plan_is_written_and_read(capture, tmp_path):
    blocks = make_blocks(capture, 2)
    write_plan(tmp_path, capture, blocks)
    assert read_plan(tmp_path) == (capture.fingerprint(), blocks)
    assert read_view_names(tmp_path / "block1.json") == list(blocks[1].views)
    assert blocks[0].margin > 0 and FAR in blocks[0].bounds and -FAR in blocks[1].bounds


def test_the_bounds_of_a_block_are_its_box_and_its_margin():
    assert Block((0.0, 1.0, -math.inf), (2.0, math.inf, 3.0), margin=0.5).bounds == (-0.5, 0.5, -FAR, 2.5, FAR, 3.5)


def test_invalid_plans_and_numbers(capture, tmp_path):
    for numbers, flag in (({"count": 10_000}, "--blocks"),):
        with pytest.raises(InputError, match=flag):
            make_blocks(capture, **numbers)
    with pytest.raises(InputError, match=r"plan\.json"):
        read_plan(tmp_path)
    for text in ("{}", '{"format": 1, "capture": "", "blocks": [{"low": [1], "high": [], "views": []}]}', "[1"):
        (tmp_path / "plan.json").write_text(text)
        with pytest.raises(InputError, match=r"plan\.json"):
            read_plan(tmp_path)
    (tmp_path / "views.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="--views"):
        read_view_names(tmp_path / "views.json")
