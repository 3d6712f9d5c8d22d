"""From photographs or a video to a capture: images, poses, points, and how they were made."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import read_json, write_json
from scene_experts.data.match import EXTENSIONS
from scene_experts.data.readers import is_capture
from scene_experts.native import library as native
from scene_experts.sfm import frames, masks, photos, work, worker
from scene_experts.sfm.pairs import Matching, pairs
from scene_experts.sfm.photos import Photo

LOG, NOTE = "colmap.log", "capture.json"
INSTALL = "pip install 'scene-experts[sfm]'"

CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE"
]
Mapper = Literal["auto", "incremental", "global"]
Say = Callable[[str], None]
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Options:
    """How a capture is made."""

    frames: int = 150  # of a video
    matching: Matching = "auto"
    camera_model: CameraModel = "OPENCV"
    mapper: Mapper = "auto"
    max_side: int = 1600  # px at which features are sought
    threads: int = 0  # 0: all that this process may use
    seed: int = 0


def make(
    source: Path, out: Path, options: Options, *, overwrite: bool = False, say: Say = print, progress: Told = lambda *_: None
) -> dict[str, Any]:
    """Make the capture `out` of the photographs in folder `source`, or of the frames of video `source`; returns what capture.json holds.

    The same call goes on where an interrupted one stopped; before all is done nothing in `out` changes but a hidden folder.
    Raises InputError for photographs that give no poses, RunError where COLMAP fails.
    """
    check(source, out, overwrite)
    found = [] if source.is_file() else photos.find(source, but=out)
    with work.opened(out) as desk:
        check(source, out, overwrite)  # a killed process's poses may just have come to their place
        own = source.resolve() == (out / "images").resolve()
        images = out / "images" if own else desk / work.DONE / "images"
        if source.is_file():
            found = taken(source, images, options, progress)
        else:
            found = photos.in_place(found, source) if own else photos.copy(found, source, images)
        groups = photos.by_camera(found)
        say(f"{len(found)} photographs, {len(groups)} camera{'s' if len(groups) > 1 else ''}")
        names = [photo.name for photo in found]
        matched = pairs(len(names), options.matching)
        masked = masks.write(found, images, desk / "masks")
        prepare(desk, found, options, masked)
        request = {
            "database": str(desk / "database" / "colmap.db"),
            "images": str(images),
            "masks": str(desk / "masks") if masked else "",
            "maps": str(desk / "maps"),
            "model": str(desk / work.DONE / "model"),
            "groups": groups,
            "pairs": [(names[i], names[j]) for i, j in matched],
            "threads": options.threads or native.count_cores(),
            "max_side": options.max_side,
            "camera_model": options.camera_model,
            "mapper": options.mapper,
            "seed": options.seed,
        }
        began = time.monotonic()
        result = reconstructed(request, desk / LOG, say, progress)
        if not result["registered"]:
            raise InputError(
                f"expected photographs of one scene that overlap, found none that fit together in {source}; take more, sharp ones, each "
                f"from another place and showing most of what the one before shows (COLMAP's words: {desk / LOG})"
            )
        note = noted(
            result, found, options, time.monotonic() - began, copied=not own, every=len(matched) == len(names) * (len(names) - 1) // 2
        )
        write_json(desk / work.DONE / NOTE, note)
        work.publish(out)
    shutil.rmtree(out / work.NAME, ignore_errors=True)
    return note


def check(source: Path, out: Path, overwrite: bool) -> None:
    """Raises InputError for what cannot be made a capture of, or would take the place of what is somebody's."""
    if not source.exists():
        raise InputError(f"expected a folder of photographs or a video at {source}, found nothing; correct the path")
    if source.is_file() and source.suffix.lower() in EXTENSIONS:
        raise InputError(f"expected a folder of photographs or a video, found one photograph at {source}; give its folder")
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(f"expected pycolmap to find poses, found none; {INSTALL}")
    here, images = source.resolve(), (out / "images").resolve()
    if here == out.resolve():
        raise InputError(
            f"expected a folder of its own for the capture, found {out} for it and the photographs; choose another --out "
            f"(or move the photographs into {out / 'images'} and give that)"
        )
    for ours in (out / "sparse", out / work.NAME, images):
        if here != images and here.is_relative_to(ours.resolve()):
            raise InputError(f"expected photographs outside of {ours}, which a capture is made of, found {source}; move them")
    if is_capture(out) and not overwrite:
        raise InputError(
            f"expected no capture in {out} yet, found one; train on it, choose another --out, or give --overwrite for new poses"
        )
    note = read_json(out / NOTE, "note of a capture") if (out / NOTE).is_file() else None
    if here != images and images.exists() and not (isinstance(note, dict) and note.get("copied")):
        raise InputError(f"expected no images at {out / 'images'} but those of an earlier `capture`, found others; choose another --out")


def taken(video: Path, images: Path, options: Options, progress: Told) -> list[Photo]:
    """The frames of a video, in `images`; those of the same video are there already where an earlier call took them."""
    note, mark = images.with_name("video.txt"), f"{video.name} {video.stat().st_size} {video.stat().st_mtime_ns} {options.frames}"
    if not note.is_file() or note.read_text() != mark:
        work.remove(images)
        note.unlink(missing_ok=True)
        names = frames.take(video, images, options.frames, progress)
        if len(names) < photos.FEWEST:
            raise InputError(f"expected a video of at least {photos.FEWEST} frames at {video}, found {len(names)}; film for longer")
        note.write_text(mark)
    return photos.find(images)


def prepare(desk: Path, found: list[Photo], options: Options, masked: list[str]) -> None:
    """Room for this request, with the database of the same photographs, looked at the same way, if there is one.

    masked: what says that masks are the same.
    """
    facts = [[(photo.name, photo.size, photo.camera, photo.stamp) for photo in found], options.camera_model, options.max_side, masked]
    mark = hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    database, note = desk / "database", desk / "database" / "of.txt"
    if not note.is_file() or note.read_text() != mark:
        work.remove(database)
        database.mkdir(parents=True)
        note.write_text(mark)
    for left in (desk / "maps", desk / work.DONE / "model"):
        work.remove(left)


def reconstructed(request: dict[str, Any], log: Path, say: Say, progress: Told) -> dict[str, Any]:
    """What the worker says at its end. Raises InputError where pycolmap cannot be used, RunError where the worker fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(request["threads"])}
    with log.open("w") as stream:
        # -P: the worker's folder is not searched for modules. In a session of its own: Ctrl-C is ours to pass on.
        process = subprocess.Popen(
            [sys.executable, "-P", worker.__file__],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stream, text=True, env=environment, start_new_session=True,
        )  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        last: dict[str, Any] = {}
        try:
            with suppress(BrokenPipeError):  # a worker that died at once: its exit code says so
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()  # and stays open: the worker ends when this process does, however it ends
            for line in process.stdout:
                last = json.loads(line)
                if "total" in last:
                    progress(last["step"], last["done"], last["total"])
                elif last["step"] == "failed":
                    say(f"the {last['mapper']} mapper gave up: {last['why']}")
                elif last["step"] == "unread":
                    say(f"warning: COLMAP cannot read {', '.join(last['names'])}")
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            with suppress(BrokenPipeError):
                process.stdin.close()
    if last.get("step") == "missing":
        raise InputError(f"expected pycolmap to find poses, found one that does not work ({last['why']}); {INSTALL}")
    if code != 0 or last.get("step") != "done":
        raise RunError(
            f"expected COLMAP to end well, found that it did not (exit code {code}): {last_words(log)}; all of its words are in {log}"
        )
    return last


def last_words(log: Path) -> str:
    """The last line that COLMAP wrote, without the time and place in its code."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    lines = [line for line in lines if not line.startswith(("@", "***", "PC:"))]  # a trace of the stack
    return lines[-1].rpartition("] ")[2] if lines else "it said nothing"


def noted(result: dict[str, Any], found: list[Photo], options: Options, seconds: float, *, copied: bool, every: bool) -> dict[str, Any]:
    """What capture.json keeps. copied: whether `images` is ours.  every: whether all photographs were compared with all."""
    registered = set(result["registered"])
    facts = {k: v for k, v in result.items() if k not in ("step", "registered", "version")}
    return {
        "format": 1,
        "copied": copied,
        "photographs": len(found),
        "with_pose": len(registered),
        "without_pose": [photo.name for photo in found if photo.name not in registered],
        "all_compared": every,
        **facts,
        "options": asdict(options),
        "seconds": round(seconds, 1),
        "pycolmap": result.get("version"),
    }
