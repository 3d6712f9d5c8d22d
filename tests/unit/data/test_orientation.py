"""EXIF orientations that do not change the size of a photograph: one rule a capture, by evidence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from scene_experts.core.types import Points
from scene_experts.data.images import probe
from scene_experts.data.orientation import compare_colours
from scene_experts.data.readers.colmap_model import read_model, write_model
from scene_experts.data.readers.reader import PosedImage
from support.captures import load
from support.foreign_poses import make_bundler, make_realitycapture
from support.synthetic import Synthetic, make_capture

SIDEWAYS = {2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}  # the orientation that undoes each


@pytest.fixture(scope="module", params=[(48, 32), (40, 40)], ids=["landscape", "square"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"), views=9, size=request.param, points=2000, mixed_sizes=False)


@pytest.fixture
def copy(made: Synthetic, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made.folder, tmp_path / "copy"))


def tag(path: Path, orientation: int, store_turned: bool) -> None:
    """Give a photograph an orientation, and store it so that the orientation turns it upright or as
    it was."""
    with Image.open(path) as image:
        picture = image.convert("RGB")
    exif = picture.getexif()
    if store_turned:
        exif[0x0112] = SIDEWAYS[orientation]
        picture = ImageOps.exif_transpose(picture)
    exif[0x0112] = orientation
    picture.save(path, exif=exif)


def fit_size(made: Synthetic) -> list[int]:
    size = next(iter(made.images.values())).shape
    return [2, 3, 4, 5, 6, 7, 8] if size[0] == size[1] else [2, 3, 4]


@pytest.mark.parametrize("store_turned", [True, False])
def test_the_colours_of_the_points_decide(made: Synthetic, copy: Path, store_turned: bool) -> None:
    names = sorted(made.images)
    for i, orientation in enumerate(fit_size(made)):
        tag(copy / "images" / names[i], orientation, store_turned)
    capture = load(copy)
    for i, name in enumerate(names):
        np.testing.assert_array_equal(capture.frame(i).rgb, made.images[name], err_msg=name)
    (told,) = [line for line in capture.warnings if "EXIF" in line]
    assert told.startswith(f"{len(fit_size(made))} photographs") and ("turned by it" if store_turned else "read as stored") in told


def test_without_points_they_are_read_as_stored_and_that_is_told(made: Synthetic, copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(
        copy / "sparse/0", replace(model, ids=model.ids[:0], xyz=model.xyz[:0], rgb=model.rgb[:0], error=model.error[:0], observations={})
    )
    tag(copy / "images" / min(made.images), 2, True)
    capture = load(copy, allow_no_points=True)
    np.testing.assert_array_equal(capture.frame(0).rgb, made.images[min(made.images)][:, ::-1])
    assert any("cannot tell" in line for line in capture.warnings)


def test_a_photograph_that_fits_only_turned_settles_it(made: Synthetic, copy: Path) -> None:
    """The colours would say otherwise: the first photograph is stored upright and has an
    orientation."""
    names = sorted(made.images)
    if made.images[names[0]].shape[0] == made.images[names[0]].shape[1]:
        pytest.skip("a square fits both ways")
    tag(copy / "images" / names[0], 3, False)
    tag(copy / "images" / names[1], 6, True)
    capture = load(copy)
    np.testing.assert_array_equal(capture.frame(0).rgb, made.images[names[0]][::-1, ::-1])
    np.testing.assert_array_equal(capture.frame(1).rgb, made.images[names[1]])
    assert any("as the others of the capture must be" in line for line in capture.warnings)


@pytest.mark.parametrize("store_turned", [True, False])
@pytest.mark.parametrize("make", [make_realitycapture, make_bundler])
def test_files_of_poses_that_do_not_state_a_size(tmp_path: Path, make: Callable[..., Synthetic], store_turned: bool) -> None:
    """The lens follows from the size of the photograph, which fits as it is stored and turned."""
    made = make(tmp_path, views=4, size=(40, 48), points=2000)
    for name, orientation in zip(sorted(made.images), (6, 8, 3)):
        tag(tmp_path / "images" / name, orientation, store_turned)
    capture = load(tmp_path)
    assert [source.turn for source in capture.images.sources] == [store_turned] * 3 + [False]
    for i, name in enumerate(sorted(made.images)) if make is make_realitycapture else ():  # the other has a distorted lens
        np.testing.assert_array_equal(capture.frame(i).rgb, made.images[name], err_msg=name)
    assert any("turned by it" if store_turned else "read as stored" in line for line in capture.warnings)


def test_points_that_are_not_finite_do_not_count(made: Synthetic, copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    tag(copy / "images" / min(made.images), 2, True)
    images = [PosedImage(i.name, copy / "images" / i.name, model.cameras[i.camera_id], i.world_to_cam()) for i in model.images]
    xyz = np.concatenate((model.xyz, [[np.nan] * 3, [np.inf, 0, 0]]))
    points = Points(torch.from_numpy(xyz), torch.from_numpy(np.concatenate((model.rgb, np.zeros((2, 3), np.uint8)))))
    headers = [probe(image.path) for image in images]
    with np.errstate(all="raise"):
        found = compare_colours(images, headers, [0], points)
    assert found == compare_colours(images, headers, [0], Points(points.xyz[:-2], points.rgb[:-2])) and found[1] < found[0]
