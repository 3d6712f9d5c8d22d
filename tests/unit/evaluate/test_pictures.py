"""Pictures on disk: rounding, names, colours, captions."""

from __future__ import annotations

import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.evaluate import pictures
from support.messages import naming


def test_rounding_is_that_of_the_protocol() -> None:
    values = torch.tensor([-0.1, 0.0, 0.49 / 255, 0.51 / 255, 254.49 / 255, 254.51 / 255, 1.0, 1.7])
    image = values[:, None, None].expand(-1, 1, 3)
    assert pictures.to_8bit(image)[:, 0, 0].tolist() == [0, 0, 0, 1, 254, 255, 255, 255]


def test_8_bit_pictures_survive_a_round_trip(tmp_path: Path) -> None:
    pixels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    image = np.stack([pixels, pixels.T, 255 - pixels], axis=-1)
    pictures.write_picture(tmp_path / "a" / "b.png", image)
    assert np.array_equal(pictures.read_picture(tmp_path / "a" / "b.png"), image)
    assert np.array_equal(pictures.to_8bit(pictures.from_8bit(image)), image)
    pictures.write_picture(tmp_path / "mask.png", pixels)
    assert np.array_equal(pictures.read_picture(tmp_path / "mask.png", "L"), pixels)


def test_names_stay_apart() -> None:
    found = pictures.make_file_names(["b/1.jpg", "a/1.jpg", "x.1.jpg", "x.2.jpg", "y.jpg", "Y.png"])
    assert found["b/1.jpg"] == "b/1.png" and found["a/1.jpg"] == "a/1.png"
    assert found["x.1.jpg"] == "x.1.png" and found["x.2.jpg"] == "x.2.png"
    assert found["y.jpg"] == "y.jpg.png" and found["Y.png"] == "Y.png.png"
    for views in (["a.jpg", "a.png", "a.jpg.tif"], ["a.jpg", "A.JPG"], ["a.jpg", "A.JPG", "a.JPG.x", "A.jpg-2.x"], ["b\\1.jpg", "b/1.png"]):
        found = pictures.make_file_names(views)
        assert len({name.casefold() for name in found.values()}) == len(views) and not any("\\" in name for name in found.values())


def test_error_colours_run_from_black_to_white() -> None:
    colours = pictures.color_errors(np.linspace(0, 2 * pictures.WORST, 101)[None])[0].astype(int)
    assert colours[0].tolist() == [0, 0, 0] and colours[50].tolist() == colours[100].tolist() == list(pictures.HEAT[-1])
    brightness = colours[:51] @ np.array([0.299, 0.587, 0.114])
    assert (np.diff(brightness) >= 0).all()


def test_errors_are_black_where_the_mask_excludes_pixels() -> None:
    photo, render = np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 64, np.uint8)
    mask = np.zeros((4, 6), np.uint8)
    mask[:, :3] = 255
    drawn = pictures.draw_error_map(render, photo, mask)
    assert drawn[:, 3:].max() == 0 and drawn[:, :3].min() > 200


@pytest.mark.parametrize("width", [3, 60, 300])
def test_side_by_side(width: int) -> None:
    photo, render = np.full((20, width, 3), 10, np.uint8), np.full((20, width, 3), 200, np.uint8)
    sheet = pictures.compose_comparison(photo, render, render, ("photograph", "render", "error"))
    assert sheet.shape == (20 + pictures.BAR, 3 * width + 2 * pictures.GAP, 3)
    top, second = pictures.BAR, width + pictures.GAP
    assert np.array_equal(sheet[top:, :width], photo) and np.array_equal(sheet[top:, second : second + width], render)
    assert (sheet[top:, width:second] == 255).all()


def test_unreadable_picture(tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(b"no picture")
    with pytest.raises(InputError):
        pictures.read_picture(tmp_path / "x.png")
    with pytest.raises(InputError):
        pictures.read_picture(tmp_path / "gone.png")


def test_removing_pictures_leaves_other_files(tmp_path: Path) -> None:
    for kind in ("renders", "experts"):
        pictures.write_picture(tmp_path / kind / "old.png", np.zeros((2, 2), np.uint8))
    (tmp_path / "mine.txt").write_text("keep")
    pictures.remove_pictures(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_new_pictures_replace_old_ones_when_all_are_written(tmp_path: Path) -> None:
    old = tmp_path / "test" / "renders" / "old.png"
    pictures.write_picture(old, np.zeros((2, 2), np.uint8))
    with pytest.raises(ZeroDivisionError), pictures.replacing(tmp_path / "test") as new:
        pictures.write_picture(new / "renders" / "new.png", np.zeros((2, 2), np.uint8))
        raise ZeroDivisionError
    assert old.is_file() and [p.name for p in tmp_path.iterdir()] == ["test"]
    with pictures.replacing(tmp_path / "test") as new:
        pictures.write_picture(new / "renders" / "new.png", np.zeros((2, 2), np.uint8))
    assert [p.name for p in (tmp_path / "test" / "renders").iterdir()] == ["new.png"]
    assert [p.name for p in tmp_path.iterdir()] == ["test"]


def test_two_evaluations_of_one_run_do_not_write_into_each_other(tmp_path: Path) -> None:
    with pictures.replacing(tmp_path / "test"), pytest.raises(InputError, match=naming(tmp_path)), pictures.replacing(tmp_path / "test"):
        pass


def test_joined_pictures_have_a_white_gap():
    left, right = torch.zeros(5, 7, 3), torch.full((5, 6, 3), 0.5)
    made = pictures.join_pictures([left, right], gap=2)
    assert made.shape == (5, 15, 3) and (made[:, 7:9] == 1).all() and (made[:, 9:] == 0.5).all()


def test_captions_of_a_wide_row_grow_with_it():
    part = np.zeros((20, 400, 3), np.uint8)
    narrow, wide = (pictures.compose_row([part] * n, ["expert 1"] * n) for n in (3, 6))
    assert narrow.shape[0] == pictures.BAR + 20 and wide.shape[0] == 2 * pictures.BAR + 20
    ink = [np.flatnonzero((sheet[:-20, :400] < 128).any(axis=(1, 2))) for sheet in (narrow, wide)]
    assert np.ptp(ink[1]) > 1.6 * np.ptp(ink[0]) > 0


def test_limiting_the_width_keeps_narrow_pictures():
    part = np.full((30, 60, 3), 7, np.uint8)
    assert pictures.limit_width(part, 60) is part
    assert pictures.limit_width(part, 20).shape == (10, 20, 3) and (pictures.limit_width(part, 20) == 7).all()


def test_a_writer_does_all_work_and_raises_what_a_thread_raised(tmp_path: Path) -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    with pictures.Writer() as writer:
        for i in range(2 * pictures.PENDING):
            writer.submit(partial(pictures.write_picture, tmp_path / f"{i}.png", pixels + i, sync=False))
    assert all(np.array_equal(pictures.read_picture(tmp_path / f"{i}.png"), pixels + i) for i in range(2 * pictures.PENDING))
    slow = threading.Event()
    with pictures.Writer() as writer:
        writer.submit(lambda: time.sleep(0.2) or slow.set())
        writer.finish()
        assert slow.is_set()
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="file"), pictures.Writer() as writer:
        writer.submit(partial(pictures.write_picture, tmp_path / "file" / "a.png", pixels))
