"""From photographs or a video to a capture: images, poses, points, and how they were made."""

from __future__ import annotations

import hashlib
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

from scene_experts.errors import InputError, RunError
from scene_experts.io import check_writable, write_json
from scene_experts.sfm import frames, photos, worker
from scene_experts.sfm.pairs import Matching, pairs
from scene_experts.sfm.photos import Photo

WORK, MODEL, LOG, NOTE = "sfm", "sparse/0", "colmap.log", "capture.json"
FRAMES = ".frames"  # beside the frames of a video: of which, and how many were asked for
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

    The same call goes on where an interrupted one stopped. `out` has the poses whole or not at all.
    Raises InputError for photographs that give no poses, RunError where COLMAP fails.
    """
    model, work = out / MODEL, out / WORK
    if model.exists() and not overwrite:
        raise InputError(f"expected no poses at {model} yet, found some; train on {out}, choose another --out, or give --overwrite")
    check_writable(out / NOTE)
    found = gathered(source, out, options, progress)
    groups = photos.by_camera(found)
    say(f"{len(found)} photographs, {len(groups)} camera{'s' if len(groups) > 1 else ''}")
    names = [photo.name for photo in found]
    request = {
        "database": str(work / "database.db"),
        "images": str(out / "images"),
        "sparse": str(work / "model"),
        "groups": groups,
        "pairs": [(names[i], names[j]) for i, j in pairs(len(names), options.matching)],
        "threads": options.threads or usable(),
        "max_side": options.max_side,
        "camera_model": options.camera_model,
        "mapper": options.mapper,
        "seed": options.seed,
    }
    prepare(work, found, options)
    began = time.monotonic()
    result = reconstructed(request, work / LOG, say, progress)
    note = noted(result, found, options, time.monotonic() - began)
    if not result["registered"]:
        raise InputError(
            f"expected photographs of one scene that overlap, found none that fit together in {source}; take more, sharp ones, each from "
            f"another place and showing most of what the one before shows (COLMAP's words: {work / LOG})"
        )
    publish(work / "model", model)
    write_json(out / NOTE, note)
    shutil.rmtree(work, ignore_errors=True)
    return note


def gathered(source: Path, out: Path, options: Options, progress: Told) -> list[Photo]:
    """The photographs, in `out`/images."""
    images, note = out / "images", out / "images" / FRAMES
    if not frames.is_video(source):
        found = photos.find(source)
        return photos.copy(found, source, images)
    mark = f"{source.name} {source.stat().st_size} {options.frames}"
    if not note.is_file() or note.read_text() != mark:
        if images.exists():
            raise InputError(
                f"expected no pictures at {images} but the {options.frames} frames of {source.name}, found some; choose another --out"
            )
        part = out / "images.part"
        shutil.rmtree(part, ignore_errors=True)
        frames.take(source, part, options.frames, progress)
        (part / FRAMES).write_text(mark)
        part.rename(images)
    return photos.find(images)


def prepare(work: Path, found: list[Photo], options: Options) -> None:
    """The working folder of exactly this request: what another one left there goes."""
    mark = hashlib.sha256(json.dumps([[asdict(photo) for photo in found], options.camera_model, options.max_side]).encode()).hexdigest()
    note = work / "request.txt"
    if not note.is_file() or note.read_text() != mark:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        note.write_text(mark)


def reconstructed(request: dict[str, Any], log: Path, say: Say, progress: Told) -> dict[str, Any]:
    """What the worker says at its end. Raises InputError where pycolmap is missing, RunError where the worker fails."""
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
            with suppress(BrokenPipeError), process.stdin as pipe:  # a worker that died at once: its exit code says so
                pipe.write(json.dumps(request))
            for line in process.stdout:
                last = json.loads(line)
                if "total" in last:
                    progress(last["step"], last["done"], last["total"])
                elif last["step"] == "failed":
                    say(f"the {last['mapper']} mapper gave up: {last['why']}")
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    if last.get("step") == "missing":
        raise InputError(f"expected pycolmap to find poses, found none that works ({last['why']}); {INSTALL}")
    if code != 0 or last.get("step") != "done":
        raise RunError(f"expected COLMAP to end well, found exit code {code} after '{last.get('step', 'nothing')}'; its words are in {log}")
    return last


def noted(result: dict[str, Any], found: list[Photo], options: Options, seconds: float) -> dict[str, Any]:
    """What capture.json keeps."""
    registered = set(result["registered"])
    facts = {k: v for k, v in result.items() if k not in ("step", "registered", "version")}
    return {
        "format": 1,
        "photographs": len(found),
        "with_pose": len(registered),
        "without_pose": [photo.name for photo in found if photo.name not in registered],
        **facts,
        "options": asdict(options),
        "seconds": round(seconds, 1),
        "pycolmap": result.get("version"),
    }


def publish(made: Path, model: Path) -> None:
    """Move the model to its place; one that was there goes when the new one is whole."""
    old = model.with_name(f"{model.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    model.parent.mkdir(parents=True, exist_ok=True)
    if model.exists():
        model.rename(old)
    made.rename(model)
    shutil.rmtree(old, ignore_errors=True)


def usable() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
