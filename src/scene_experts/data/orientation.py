"""Decides whether photographs are read as they are stored or turned by their EXIF orientation.

Programs that find poses differ: most work on the stored pixels, some turn them first. Where a
photograph has the size of its camera only after it is turned, that settles it. Otherwise one rule
holds for the capture, and the colours of the 3D points decide it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import PHOTOGRAPH
from scene_experts.core.reading.pictures import ORIENTATION, opening_picture
from scene_experts.core.types import Points
from scene_experts.data.colour import to_8_bit
from scene_experts.data.images import PhotoHeader, Size, fits
from scene_experts.data.lens import Lens
from scene_experts.data.readers.reader import PosedImage

LOOKED_AT = 8  # photographs whose colours are compared
MOST_POINTS = 20_000
SIDE = 640  # px; larger photographs are compared at this longest side
CLEAR = 0.97  # the better reading must differ from the points by less than this share of the other


def fit_lenses(
    images: Sequence[PosedImage], headers: Sequence[PhotoHeader], points: Points | None
) -> tuple[list[tuple[Lens, bool]], list[str]]:
    """Return for each photograph its lens at the size of its file, and whether the file must be
    turned by its EXIF orientation; and what a user should know about that.

    Raises InputError for a photograph that has not the aspect ratio of its camera, stored or
    turned.
    """
    both = [_which_fit(image, header) for image, header in zip(images, headers)]
    unclear = [i for i, fit in enumerate(both) if fit == (True, True) and headers[i].orientation != 1]
    turn, notes = _decide(images, headers, both, unclear, points) if unclear else (False, [])
    out, decided = [], set(unclear)
    for i, (image, header, (stored, _)) in enumerate(zip(images, headers, both)):
        turned = turn if i in decided else not stored
        size = header.turned if turned else header.size
        out.append((_lens_at(image, size, turned), turned))
    return out, notes


def _lens_at(image: PosedImage, size: Size, turned: bool) -> Lens:
    """Return the lens of a photograph that has `size` when it is read as it is stored or `turned`."""
    if turned and image.turned is not None:
        return image.turned.resize(*size)
    if image.lens is None:
        w, h = size
        f = 0.5 * w / np.tan(0.5 * image.angle)
        return Lens("SIMPLE_PINHOLE", w, h, (f, w / 2, h / 2))
    return image.lens.resize(*size)


def _which_fit(image: PosedImage, header: PhotoHeader) -> tuple[bool, bool]:
    """Return whether the camera fits the photograph as it is stored, and as it is turned."""
    if image.lens is None:
        return True, header.turned == header.size
    lens = image.turned or image.lens
    stored, turned = fits(header.size, (image.lens.width, image.lens.height)), fits(header.turned, (lens.width, lens.height))
    if not stored and not turned:
        raise InputError(
            f"expected {image.path} with the aspect ratio of its camera ({image.lens.width}x{image.lens.height}), found "
            f"{header.size[0]}x{header.size[1]}; use the photographs that the cameras were reconstructed from"
        )
    return stored, turned


def _decide(
    images: Sequence[PosedImage],
    headers: Sequence[PhotoHeader],
    both: Sequence[tuple[bool, bool]],
    unclear: Sequence[int],
    points: Points | None,
) -> tuple[bool, list[str]]:
    """Return whether photographs that fit stored and turned are turned, and why."""
    what = f"{len(unclear)} photographs fit their cameras with and without their EXIF orientation (first: {images[unclear[0]].name})"
    sure = [fit for image, fit in zip(images, both) if image.lens is not None]  # an angle of view fits as stored whatever is right
    only_turned, only_stored = (False, True) in sure, (True, False) in sure
    if only_turned != only_stored:
        way = "turned by it" if only_turned else "read as stored"
        return only_turned, [f"{what}: {way}, as the others of the capture must be"]
    stored, turned = compare_colours(images, headers, unclear, points)
    if min(stored, turned) < CLEAR * max(stored, turned):
        turn = turned < stored
        numbers = f"colours of the points differ by {stored:.0f} of 255 from the stored pixels and by {turned:.0f} from the turned ones"
        other = "to have them as stored, remove the orientation from the files" if turn else "to have them turned, store them upright"
        return turn, [f"{what}: {'turned by it' if turn else 'read as stored'}, because the {numbers}; {other}"]
    return False, [f"{what}: read as stored, which the points' colours cannot tell; if the render is upside down, store them upright"]


def compare_colours(
    images: Sequence[PosedImage], headers: Sequence[PhotoHeader], chosen: Sequence[int], points: Points | None
) -> tuple[float, float]:
    """Return the mean absolute difference, of 255, between the colours of the points and the pixels
    that they project to, as stored and as turned. Both are 0 without points in view."""
    if points is None or not len(points.xyz):
        return 0.0, 0.0
    step = max(1, len(points.xyz) // MOST_POINTS)
    xyz, rgb = points.xyz[::step].double().numpy(), points.rgb[::step].double().numpy()
    sums, count = np.zeros(2), 0
    for i in chosen[:: max(1, -(-len(chosen) // LOOKED_AT))]:
        image, header = images[i], headers[i]
        with opening_picture(image.path, PHOTOGRAPH) as picture:
            exif = picture.getexif()
            picture.draft(None, (SIDE, SIDE))
            small = to_8_bit(picture).convert("RGB")
        small.thumbnail((SIDE, SIDE))
        small.getexif()[ORIENTATION] = exif.get(ORIENTATION, 1)
        found = []
        for pixels, size, turned in ((small, header.size, False), (ImageOps.exif_transpose(small), header.turned, True)):
            uv, seen = _project(xyz, image, _lens_at(image, size, turned))
            found.append((_look_up(pixels, uv / np.asarray(size)), seen))
        seen = found[0][1] & found[1][1]
        sums += [float(np.abs(colours[seen] - rgb[seen]).mean(1).sum()) for colours, _ in found]
        count += int(seen.sum())
    return (float(sums[0] / count), float(sums[1] / count)) if count else (0.0, 0.0)


def _project(xyz: NDArray[np.float64], image: PosedImage, lens: Lens) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels [P, 2] that points project to, and which of them are in the photograph."""
    local = xyz @ image.world_to_cam[:3, :3].T + image.world_to_cam[:3, 3]
    local[~np.isfinite(local).all(1)] = -1.0  # behind the camera
    ahead = local[:, 2] > 1e-9
    x, y = (local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]).T
    u, v = lens.distort(x, y)
    uv = np.stack((u * lens.fx + lens.cx, v * lens.fy + lens.cy), 1).astype(np.float64)
    inside = (uv >= 0).all(1) & (uv < (lens.width, lens.height)).all(1)
    return uv, ahead & inside & ~lens.is_folded(x, y)


def _look_up(picture: Image.Image, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours [P, 3] of a picture at places in [0, 1)."""
    pixels = np.asarray(picture.convert("RGB"))
    column, row = np.clip(place * (picture.width, picture.height), 0, (picture.width - 1, picture.height - 1)).astype(int).T
    return pixels[row, column].astype(np.float64)
