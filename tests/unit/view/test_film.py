"""A film's cameras. The films themselves are drawn in tests/unit/commands/test_render.py."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.view.film import check_out, make_path, resize_camera
from scene_experts.view.film_options import FilmOptions
from support.captures import load
from support.scenes import CAMERA
from support.synthetic import make_capture


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


def test_options_without_an_effect_on_a_path_are_told(tmp_path, caplog):
    capture = load(make_capture(tmp_path, views=9, size=(48, 32), points=200).folder)
    assert len(make_path(FilmOptions(path="test"), capture)) == len(capture.test) and not caplog.text
    none = replace(capture, test=(), train=tuple(range(9)))
    assert len(make_path(FilmOptions(path="test", frames=3), none)) == 9
    assert "--frames: no effect with --path test" in caplog.text and "shows the training views" in caplog.text
    with pytest.raises(InputError, match="--transform"):
        make_path(FilmOptions(path="orbit", transform=tmp_path), capture)
    capture.images.close()
