"""A film's cameras. The films themselves are drawn in tests/unit/commands/test_render.py."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.view.film import check_out, resize_camera
from support.scenes import CAMERA


def test_a_camera_at_another_size():
    assert resize_camera(CAMERA, None) is CAMERA
    assert torch.allclose(resize_camera(CAMERA, (96, 64)).K[:2], CAMERA.K[:2] * 2)


@pytest.mark.parametrize("size", [(96, 32), (24, 64)])
def test_another_aspect_ratio_stretches_nothing(size):
    before = replace(CAMERA, K=torch.tensor([[40.0, 0, 29], [0, 44, 13], [0, 0, 1]]))
    made = resize_camera(before, size)
    assert (made.width, made.height) == size and made.fov == pytest.approx(before.fov)
    assert made.fx / made.fy == pytest.approx(before.fx / before.fy)
    assert (float(made.K[0, 2]) - size[0] / 2) / made.fx == pytest.approx(5 / 40) and float(made.K[1, 2]) / size[1] == pytest.approx(
        13 / 32
    )


def test_a_name_that_is_neither_a_video_nor_a_folder(tmp_path):
    for fine in (None, tmp_path / "a.mp4", tmp_path / "frames"):
        check_out(fine)
    with pytest.raises(InputError, match=r"a\.gif"):
        check_out(tmp_path / "a.gif")
