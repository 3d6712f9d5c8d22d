"""A film's cameras. The films themselves are drawn in tests/unit/commands/test_render.py."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.view.film import check_out, resize_camera
from support.scenes import CAMERA


def test_a_camera_at_another_size():
    assert resize_camera(CAMERA, (96, 32)).fx == pytest.approx(2 * CAMERA.fx) and resize_camera(CAMERA, None) is CAMERA
    assert torch.allclose(resize_camera(CAMERA, (96, 64)).K[:2], CAMERA.K[:2] * 2)


def test_a_name_that_is_neither_a_video_nor_a_folder(tmp_path):
    for fine in (None, tmp_path / "a.mp4", tmp_path / "frames"):
        check_out(fine)
    with pytest.raises(InputError, match=r"a\.gif"):
        check_out(tmp_path / "a.gif")
