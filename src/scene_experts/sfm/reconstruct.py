"""Makes a capture from photographs or a video: images, camera poses, points, and a note about how
they were made."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import time
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.core.io import read_json, write_bytes, write_json
from scene_experts.core.progress import Progress
from scene_experts.data.equirectangular import find_place
from scene_experts.data.match import EXTENSIONS
from scene_experts.data.prepare import STRETCHED
from scene_experts.data.readers import is_capture
from scene_experts.data.views import typical_size
from scene_experts.native import library as native
from scene_experts.sfm import frames, photos, work
from scene_experts.sfm.attempts import find_poses, warn_of_mapper
from scene_experts.sfm.colmap import Say, run_worker
from scene_experts.sfm.copies import leave_copies_out
from scene_experts.sfm.drift import KEY, NOTE, measure_drift
from scene_experts.sfm.learned import attempt
from scene_experts.sfm.learned.photographs import Shots
from scene_experts.sfm.masks import write_masks
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.pairs import choose_pairs, find_alike
from scene_experts.sfm.panoramas import PanoramaRig, choose_held_out, cuts, take_photos
from scene_experts.sfm.photos import Photo

LOG, VIDEO, FRAMES = "colmap.log", "video.txt", "frames"
TEST = "test.txt"  # lists the views that a training holds out
LEARNED = "database/learned"  # features and matches of networks, removed with the database
ENOUGH_FOR_POSES = 3000  # features of a photograph; half of sceaux's, statue's or brighton's move no camera by 0.1 % of the extent


def reconstruct(
    source: Path,
    out: Path,
    options: SfmOptions,
    *,
    overwrite: bool = False,
    few: int = 0,
    say: Say = print,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """Make the capture `out` from the photographs in the folder `source`, or from the frames of the
    video `source`.

    An interrupted call is continued by the same call. Until it is complete, only a hidden folder in
    `out` changes.

    Args:
        overwrite: Replace an existing capture once the new one is complete.
        few: Number of photographs up to which the points are not needed, as a training starts from
            denser ones: the smallest features are then left out where there are enough others.
        say: Called with each message.
        progress: Called with the name of the work, how much is done and how much there is.

    Returns:
        The content of capture.json.

    Raises:
        InputError: if the photographs cannot be used or no poses are found, or if pycolmap is
            missing.
        RunError: if COLMAP fails.
    """
    check_request(source, out, overwrite)
    attempt.check_features(options.features)
    found = [] if source.is_file() else find_different(source, out, say)
    with work.open_work_folder(out) as folder:
        check_request(source, out, overwrite)  # again: results of a killed process may just have been published
        own = source.resolve() == (out / "images").resolve()
        images = out / "images" if own else folder / work.DONE / "images"
        if own:
            work.remove(folder / work.DONE)  # what an earlier call copied there would replace them
        place = source
        if source.is_file():
            found, place = take_frames(source, folder, images, options, say, progress)
        else:
            (folder / work.DONE / VIDEO).unlink(missing_ok=True)  # the images are no longer its frames
        found, rig = take_photos(found, place, images, options, say)
        names = [photo.name for photo in found]
        pairs = pairs_by_number(names, rig, options)
        groups = photos.group_by_camera(found)
        kind = "frames" if source.is_file() else "photographs"
        said = f"{len(found)} {kind}, {len(groups)} camera{'s' if len(groups) > 1 else ''}"
        say(f"{said}, {len(pairs):,} pairs to match" if pairs is not None else said)
        masks = write_masks(found, images, folder / "masks")
        enough = ENOUGH_FOR_POSES if len(found) <= few and options.features != "learned" else None
        if prepare_folder(folder, found, options, masks, enough):
            say("goes on from an earlier call with the same photographs: the features and matches that it found are kept")
        request = describe_request(folder, images, groups, rig, bool(masks), pairs, names, options)
        request |= {"enough": enough, "film": source.is_file() and rig is None}
        began = time.monotonic()
        spare: list[tuple[int, int]] = []
        if pairs is None:
            pairs, spare = pairs_by_features(request, names, folder, say, progress)
            asked = {"pairs": pairs, "spare": spare}
            request = {**request, **{name: [(names[i], names[j]) for i, j in some] for name, some in asked.items()}}
        shots = Shots(names, images, folder / "masks" if masks else None, folder / LEARNED, options.max_side, request["threads"])
        run = partial(run_worker, log=folder / LOG, say=say, progress=progress)
        result = find_poses(request, shots, pairs, spare, options, folder / "maps", run, say, progress)
        if not result["registered"]:
            raise InputError(
                f"expected overlapping photographs of one scene in {source}, found none that fit together; take more sharp photographs "
                f"from different places, each showing most of what the previous one shows (COLMAP's log: {folder / LOG})"
            )
        if warning := warn_of_mapper(result, options):
            say(warning)
        exhaustive = len(pairs) == every_pair([find_place(name) for name in names])
        note = describe_result(result, found, options, time.monotonic() - began, copied=not own, exhaustive=exhaustive)
        if not own:
            note[work.FILES] = sorted(path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
        write_facts(Path(request["model"]), images, rig, result, note, folder / work.DONE / NOTE)
        work.publish(out)
    shutil.rmtree(out / work.NAME, ignore_errors=True)
    return note


def find_different(source: Path, out: Path, say: Say) -> list[Photo]:
    """Return the photographs of a folder outside of `out`, without copies, which are told."""
    found, told = leave_copies_out(source, photos.find_photos(source, exclude=out, say=say))
    if told:
        say(told)
    return found


def write_facts(model: Path, images: Path, rig: PanoramaRig | None, result: dict[str, Any], note: dict[str, Any], place: Path) -> None:
    """Write what a training reads beside the model: which panoramas are held out, and the note, with
    how much the exposures differ."""
    if rig is not None:
        write_bytes(model / TEST, "\n".join(choose_held_out(result["registered"])).encode())
    drift = measure_drift(model, images)
    note[KEY] = None if drift is None else round(drift, 3)
    write_json(place, note)


def take_frames(video: Path, folder: Path, images: Path, options: SfmOptions, say: Say, progress: Progress) -> tuple[list[Photo], Path]:
    """Return the frames of a video, and the folder that they are in: `images`, unless views are cut
    out of them."""
    say(f"reading {video.name}: the sharpest of its frames are used")
    place = folder / FRAMES if (folder / FRAMES).is_dir() else images
    found = extract_photos(video, place, options, say, progress)
    if place == images and cuts(found, options):  # the frames are not the photographs of the capture
        os.replace(images, folder / FRAMES)
        os.replace(images.with_name(VIDEO), folder / VIDEO)
        place = folder / FRAMES
    return found, place


def pairs_by_number(names: list[str], rig: PanoramaRig | None, options: SfmOptions) -> list[tuple[int, int]] | None:
    """Return the pairs to match, as places in `names`; None: the features decide. Views of one
    panorama are not matched with each other."""
    pairs = choose_pairs(len(names), options.matching)
    if pairs is None or rig is None:
        return pairs
    return [(i, j) for i, j in pairs if find_place(names[i]) != find_place(names[j])]


def pairs_by_features(
    request: dict[str, Any], names: list[str], folder: Path, say: Say, progress: Progress
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Find the features, and return the pairs that look alike and those to spare, as places in
    `names`."""
    run_worker({**request, "poses": False}, folder / LOG, say, progress)
    pairs, spare = find_alike(Path(request["database"]), names, [find_place(name) for name in names], film=request["film"])
    every = every_pair([find_place(name) for name in names])
    say(f"{len(pairs):,} of {every:,} pairs to match: photographs that look alike, and each with those that follow it")
    return pairs, spare


def every_pair(places: list[str]) -> int:
    """Return the number of pairs of photographs whose places (`find_place`) differ."""
    return (len(places) ** 2 - sum(n * n for n in Counter(places).values())) // 2


def describe_request(
    folder: Path,
    images: Path,
    groups: list[list[str]],
    rig: PanoramaRig | None,
    masked: bool,
    pairs: list[tuple[int, int]] | None,
    names: list[str],
    options: SfmOptions,
) -> dict[str, Any]:
    """Return what the worker is asked for. groups: names by camera. pairs: of places in `names`; None:
    the features decide."""
    return {
        "database": str(folder / "database" / "colmap.db"),
        "images": str(images),
        "masks": str(folder / "masks") if masked else "",
        "maps": str(folder / "maps"),
        "model": str(folder / work.DONE / "model"),
        "groups": groups,
        "rig": None if rig is None else rig.plain(),
        "pairs": None if pairs is None else [(names[i], names[j]) for i, j in pairs],
        "spare": [],
        "learned": "",
        "poses": True,
        "threads": options.threads or native.count_cores(),
        "max_side": options.max_side,
        "camera_model": options.camera_model,
        "mapper": options.mapper,
        "stretched": STRETCHED,
        "seed": options.seed,
    }


def check_request(source: Path, out: Path, overwrite: bool) -> None:
    """Raise InputError if no capture can be made from `source`, or if `out` contains files that
    must not be replaced."""
    if not source.exists():
        raise InputError(f"expected a folder of photographs or a video at {source}, found nothing; correct the path")
    if source.is_file() and source.suffix.lower() in EXTENSIONS:
        raise InputError(f"expected a folder of photographs or a video, found the single photograph {source}; give its folder")
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(f"finding camera poses requires pycolmap: {install_line('sfm')}")
    if source.is_file():
        frames.import_ffmpeg()
    if out.exists() and not out.is_dir():
        raise InputError(f"expected a folder for --out, found the file {out}; choose another name")
    if (source / "config.json").is_file() and ((source / "checkpoints").is_dir() or (source / "test").is_dir()):
        raise InputError(f"expected a folder of photographs, found the run {source}, with renders and error maps; give its photographs")
    if (source / "images").is_dir() and source.resolve() != out.resolve() and is_capture(source):
        raise InputError(f"expected a folder of photographs, found the capture {source}; train on it, or give {source / 'images'}")
    here, images = source.resolve(), (out / "images").resolve()
    if here == out.resolve():
        raise InputError(
            f"expected a capture folder that is not the folder of the photographs, found {out} for both; choose another --out, or move the "
            f"photographs into {out / 'images'} and give that folder"
        )
    for ours in (out / "sparse", out / work.NAME, images):
        if here != images and here.is_relative_to(ours.resolve()):
            raise InputError(f"expected photographs outside {ours}, which belongs to the capture, found {source}; move them")
    if is_capture(out) and not overwrite:
        raise InputError(f"there is already a capture in {out}; train on it, choose another --out, or find new poses with --overwrite")
    note = read_json(out / NOTE, "note of a capture") if (out / NOTE).is_file() else None
    if here != images and images.exists() and not (isinstance(note, dict) and note.get("copied")):
        raise InputError(f"{out / 'images'} holds images that `capture` did not copy there; choose another --out")


def extract_photos(video: Path, images: Path, options: SfmOptions, say: Say, progress: Progress) -> list[Photo]:
    """Extract the frames of a video into `images` and return them. Frames of an earlier call with
    the same video are reused."""
    note, mark = images.with_name(VIDEO), f"{video.name} {video.stat().st_size} {video.stat().st_mtime_ns} {options.frames}"
    if not note.is_file() or note.read_text() != mark:
        work.remove(images)
        for old in (note, images.with_name(photos.COPIED)):
            old.unlink(missing_ok=True)
        names, still = frames.extract_frames(video, images, options.frames, progress)
        if still:
            say(f"{still} frames show the same as the one before and are left out")
        if len(names) < photos.FEWEST:
            raise InputError(f"expected a video of at least {photos.FEWEST} frames at {video}, found {len(names)}; use a longer video")
        note.write_text(mark)
    return photos.find_photos(images)


def prepare_folder(folder: Path, found: list[Photo], options: SfmOptions, masks: list[str], enough: int | None) -> bool:
    """Empty the work folder for this request. The database is kept if it holds features of the same
    photographs and masks. Returns whether there is one.

    masks: Checksums of the masks. enough: Features of a photograph without the smallest ones.
    """
    facts = [
        [(photo.name, photo.size, photo.camera, photo.stamp) for photo in found],
        options.camera_model,
        options.max_side,
        masks,
        enough,
    ]
    mark = hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    database, note = folder / "database", folder / "database" / "of.txt"
    kept = note.is_file() and note.read_text() == mark
    if not kept:
        work.remove(database)
        database.mkdir(parents=True)
        note.write_text(mark)
    for left in (folder / "maps", folder / work.DONE / "model"):
        work.remove(left)
    return kept and (database / "colmap.db").is_file()


def describe_result(
    result: dict[str, Any], found: list[Photo], options: SfmOptions, seconds: float, *, copied: bool, exhaustive: bool
) -> dict[str, Any]:
    """Return the content of capture.json.

    copied: Whether the capture's images are copies. exhaustive: Whether all photographs were
    matched with each other.
    """
    registered = set(result["registered"])
    facts = {k: v for k, v in result.items() if k not in ("step", "registered", "lacking", "version")}
    return {
        "format": 1,
        "copied": copied,
        "photographs": len(found),
        "size": list(typical_size(photo.size for photo in found)),
        "with_pose": len(registered),
        "without_pose": [photo.name for photo in found if photo.name not in registered],
        "all_compared": exhaustive,
        **facts,
        "options": asdict(options),
        "seconds": round(seconds, 1),
        "pycolmap": result.get("version"),
    }
