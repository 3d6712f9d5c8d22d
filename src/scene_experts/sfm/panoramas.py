"""Cuts the perspective views out of 360 degree panoramas. A rig ties the poses of the views of one
panorama together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from scene_experts.core.errors import InputError, few
from scene_experts.core.io import read_json, write_atomic, write_json
from scene_experts.core.reading.budget import CAPTURED
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.colour import is_deep, lift, to_8_bit
from scene_experts.data.equirectangular import FIELD, FOLDERS, VIEWS, find_place, find_places, mask_nadir, sample, view_side
from scene_experts.data.masks import Mask
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.photos import ORIENTATION, Photo, check_in_place, copy_photos, natural_key, read_stored_mask, turn_upright

CUT = "cut.json"


@dataclass(frozen=True)
class PanoramaRig:
    """Views that were cut out of panoramas."""

    side: int
    """Of a view in pixels."""

    @property
    def params(self) -> list[float]:
        """The parameters of COLMAP's PINHOLE camera of every view."""
        focal = self.side / 2 / math.tan(math.radians(FIELD / 2))
        return [focal, focal, self.side / 2, self.side / 2]

    def plain(self) -> dict[str, Any]:
        """Return what the worker needs: the lens of all views, and the rotation view-from-rig by
        the folder of each."""
        return {"model": "PINHOLE", "params": self.params, "views": {view.folder: view.rig_from_view.T.tolist() for view in VIEWS}}


def cuts(found: list[Photo], options: SfmOptions) -> bool:
    """Return whether views are cut out of some of the photographs."""
    return options.panoramas == "cut" and any(photo.round for photo in found)


def take_photos(
    found: list[Photo], source: Path, images: Path, options: SfmOptions, say: Callable[[str], None]
) -> tuple[list[Photo], PanoramaRig | None]:
    """Copy the photographs of the folder `source` into the folder `images` of a capture, unless they
    lie there, and cut panoramas into views. Returns what lies there, and the rig of the views."""
    turned = [photo for photo in found if photo.round]
    flat = f"warning: {len(turned)} photographs look like 360 degree panoramas and are taken as perspective pictures"
    if source.resolve() == images.resolve():
        if turned and options.panoramas == "cut":
            say(f"{flat}, because they lie in the capture; copy them into another folder and give that one")
        return check_in_place(found, source), None
    if not cuts(found, options):
        if turned:
            say(flat)
        if options.nadir:
            say(f"warning: --nadir {options.nadir:g} has no effect, because no panorama is cut into views")
        wide = [photo.name for photo in found if photo.size[0] == 2 * photo.size[1] and not photo.round]
        if wide:
            say(f"{len(wide)} photographs of 2:1 are taken as perspective pictures, because their edges do not meet ({few(wide)})")
        return copy_photos(found, source, images), None
    plain = [photo for photo in found if not photo.round]
    copied = copy_photos(plain, source, images, FOLDERS) if plain else []
    views, rig = cut_panoramas(turned, source, images, options.nadir)
    made = f"{len(VIEWS)} views of {FIELD:g} degrees and {rig.side} px are cut out of each"
    below = f", without {options.nadir:g} degrees around straight down" if options.nadir else ""
    instead = "--panoramas keep takes them as perspective pictures"
    say(f"{len(turned)} of {len(found)} photographs are 360 degree panoramas: {made}{below} ({instead})")
    return [*copied, *views], rig


def choose_held_out(names: Sequence[str]) -> list[str]:
    """Return the views that are held out: those of every 8th panorama. The views of one place show
    the same, so that one alone would be no test."""
    places = sorted({find_place(name) for name in names if find_place(name) != name}, key=natural_key)
    return [name for name in names if find_place(name) != name and find_place(name) in places[::8]]


def cut_panoramas(photos: Sequence[Photo], source: Path, target: Path, nadir: float = 0.0) -> tuple[list[Photo], PanoramaRig]:
    """Cut the views out of panoramas in the folder `source`, into FOLDER/NAME.jpg in `target`, and
    return them with their masks. Views of an earlier call from the same files are kept; other files
    in these folders are removed.

    nadir: Degrees around the direction straight down that masks leave out, for who or what carries
    the camera; 0: no masks, unless a panorama has one.
    """
    rig, note = PanoramaRig(view_side(min(photo.size[0] for photo in photos))), target.with_name(CUT)
    kept: dict[str, list[float]] = read_json(note, "list of views") if note.is_file() else {}  # type: ignore[assignment]
    stamps = {photo.stored: [*photo.stamp, float(rig.side), nadir] for photo in photos}
    views = {photo.stored: name_views(photo, rig, target, nadir) for photo in photos}
    by_view: dict[str, Photo] = {}
    for photo in photos:
        other = by_view.setdefault(views[photo.stored][0].name, photo)
        if other is not photo:
            raise InputError(
                f"expected panoramas in {source} that differ not only in extension, found '{other.name}' and '{photo.name}'; rename one"
            )
    wanted = {target / view.name for found in views.values() for view in found}
    wanted |= {view.mask.path for found in views.values() for view in found if view.mask}
    for path in [path for name in FOLDERS for path in (target / name).rglob("*") if path.is_file() and path not in wanted]:
        path.unlink()
    done: dict[str, list[float]] = {}
    for photo in photos:
        if kept.get(photo.stored) != stamps[photo.stored] or not all((target / view.name).is_file() for view in views[photo.stored]):
            cut(photo, source / photo.name, views[photo.stored], target, nadir)
        done[photo.stored] = stamps[photo.stored]
        write_json(note, done)
    return sorted((view for found in views.values() for view in found), key=lambda view: natural_key(view.name)), rig


def name_views(photo: Photo, rig: PanoramaRig, target: Path, nadir: float) -> list[Photo]:
    """Return the views of a panorama, in the order of VIEWS, as photographs of `target`."""
    found = []
    for view in VIEWS:
        path = PurePosixPath(view.folder) / PurePosixPath(photo.stored).with_suffix(".jpg")
        mask = Mask(target / path.with_name(f"{path.stem}_mask.png")) if photo.mask or nadir > 0 else None
        found.append(Photo(str(path), (rig.side, rig.side), (view.folder,), stamp=(*photo.stamp, float(rig.side), nadir), mask=mask))
    return found


def cut(photo: Photo, file: Path, views: Sequence[Photo], target: Path, nadir: float) -> None:
    """Write the views of a panorama and their masks."""
    orientation = photo.orientation if photo.orientation in (2, 3, 4) else 1  # others would not be panoramas
    with opening_picture(file, CAPTURED, heic=True) as image:
        exif, profile = image.getexif(), image.info.get("icc_profile")
        lifted = turn_upright(lift(image, photo.white), orientation)
        pixels = np.asarray((to_8_bit(lifted, photo.white) if is_deep(lifted.mode) else lifted).convert("RGB"))
    exif.pop(ORIENTATION, None)
    counts = np.asarray(turn_upright(read_stored_mask(photo), orientation).convert("L")) if photo.mask else None
    for view, made in zip(VIEWS, views):
        side = made.size[0]
        picture = Image.fromarray(sample(pixels, find_places(view, side, pixels.shape[1::-1])))
        options = {"quality": 96, "subsampling": 0, "exif": exif, "icc_profile": profile}
        path = target / made.name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, lambda temporary: picture.save(temporary, "JPEG", **options))  # noqa: B023
        if made.mask is not None:
            mask = mask_nadir(view, side, nadir)
            if counts is not None:
                mask &= sample(counts, find_places(view, side, counts.shape[::-1]), nearest=True)
            write_atomic(made.mask.path, lambda temporary: Image.fromarray(mask).save(temporary, "PNG"))  # noqa: B023
