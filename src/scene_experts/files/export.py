"""Runs to files: the only entry is `export`. `write_result_folder` writes what a training leaves
for other tools.

It stays one module: an export visits at most 12 modules (tests/system/test_rooms.py), and each part of this one is on the way.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, read_json, write_bytes, write_json
from scene_experts.core.plain import to_json
from scene_experts.core.version import __version__
from scene_experts.data.settings import Data
from scene_experts.data.views import Capture, World
from scene_experts.files.cameras import write_cameras
from scene_experts.files.formats.splats import Splats
from scene_experts.files.measure import Painter, Tell, capture_if_there, cost
from scene_experts.files.options import DEFAULT, MAX_DEGREE, Options
from scene_experts.files.registry import GAUSSIANS, Family, Format, family_named, format_named, format_names, formats_of
from scene_experts.render import Rasterizer
from scene_experts.scene import Scene
from scene_experts.training.progress import format_duration
from scene_experts.training.run_folder import OpenRun, capture_of

NAME = "scene"  # of files whose name the caller does not choose
DESCRIPTION = "scene.json"  # in a result folder
NOTE_FORMAT = 1


@dataclass(frozen=True)
class Written:
    """What `export` wrote."""

    path: Path
    """The file, or the folder point_cloud/iteration_N of a result folder."""
    bytes: int
    """Size of the file, or of the folder's files."""
    rows: int
    """Anchors, Gaussians or points in it."""
    lines: tuple[str, ...]
    """The same in sentences, for a terminal."""
    psnr: dict[str, float] = field(default_factory=dict)
    """Mean PSNR of the held-out views against the photographs, dB, drawn from the "run" and from
    the "file", for a baked scene also from its "closed_form" and its "bake"; empty where nothing
    was measured."""


@dataclass(frozen=True)
class _Work:
    """An export under way."""

    run: OpenRun
    name: str  # of the format
    format: Format
    options: Options
    rasterize: Rasterizer | None
    tell: Tell
    command: str

    @property
    def is_direct(self) -> bool:
        """Whether the run's rows are standard Gaussians already and are written as they are."""
        degree, how = self.run.scene.traits.sh_degree, self.options
        cut = 0 < how.max_gaussians < len(self.run.scene.table)
        return degree is not None and how.sh_degree >= degree and not how.prune and not cut


def export(
    run: OpenRun,
    format: str = "compact",
    out: Path | None = None,
    options: Options = DEFAULT,
    *,
    rasterize: Rasterizer | None = None,
    tell: Tell = lambda what, done, total: None,
    command: str = "",
) -> list[Written]:
    """Write a trained scene in a format of `registry.FORMATS`.

    A format that keeps scenes with their networks takes scenes of its own family only. A format of
    standard Gaussians takes every scene. Scenes whose Gaussians depend on the camera are baked for
    it, which takes minutes and needs the capture.

    Args:
        run: The run, on the CPU. `run_folder.with_capture` says where its capture is if it moved.
        format: Name of the format.
        out: File, or folder for it; a name without a suffix is a folder. Default: scene.SUFFIX in
            the run folder. With `options.levels`, one file per level of detail beside it.
        options: What to write, and whether to measure it.
        rasterize: Draws the views. Default: the fastest rasteriser on this CPU.
        tell: Called with the progress: what, done, total.
        command: The command line, kept in the file's note.

    Returns:
        One `Written` per file. Beside a standard file, FILE.json says how it was made.

    Raises:
        InputError: The format is unknown or cannot hold the scene, an option is out of range, or
            the capture is missing.
        RunError: The disk is full.
    """
    return export_several(run, (format,), out, options, rasterize=rasterize, tell=tell, command=command)


def export_several(
    run: OpenRun,
    formats: Sequence[str],
    out: Path | None = None,
    options: Options = DEFAULT,
    *,
    rasterize: Rasterizer | None = None,
    tell: Tell = lambda what, done, total: None,
    command: str = "",
) -> list[Written]:
    """Write a trained scene in several formats. Standard files with harmonics of the same degree share one bake.

    out: with several formats, a folder. The other arguments, the result and the errors are those of `export`.
    """
    _check(options)
    if len(formats) > 1 and out is not None:
        if not out.is_dir() and (out.exists() or out.suffix):
            raise InputError(f"expected a folder as --out for several formats, found {out}; name a folder")
        out.mkdir(parents=True, exist_ok=True)
    works = [_Work(run, name, format_named(name), options, rasterize, tell, command) for name in dict.fromkeys(formats)]
    standard, places = [], []
    for work in works:
        if work.format.family == GAUSSIANS:
            if not work.is_direct:  # it will be baked
                work = replace(work, options=replace(options, sh_degree=min(options.sh_degree, work.format.sh_degree)))
            standard.append(work)
            places.append(file_path(run.path, work.name, work.format, out))
            check_writable(places[-1])
            if work.format.needs is not None:
                work.format.needs()
    own = Options(measure=options.measure) if standard else options  # the other options are those of the standard files then
    written = [_export_scene(replace(work, options=own), out) for work in works if work.format.family != GAUSSIANS]
    if standard:
        made: dict[tuple[int | None, int], _Made] = {}
        selects = bool(options.crop) or options.floaters == "remove"
        with capture_if_there(run, needed=selects or not all(work.is_direct for work in standard)) as capture:
            for work, path in zip(standard, places):
                for level, file in _files(run, path, options.levels):
                    written.append(_export_gaussians(work, file, level, capture, made))
    return written


def write_result_folder(run: OpenRun, capture: Capture, out: Path | None = None) -> Path:
    """Write the result folder of the run's family (point_cloud/iteration_N, cfg_args) and
    cameras.json below `out`, the run by default.

    Returns the iteration's folder; `out` for a family without files of its own. Raises RunError
    when the disk is full.
    """
    out = out or run.path
    family = family_named(run.scene.traits.family)
    width = capture.views[0].camera.width
    folder = out if family is None else write_scene_folder(run, family, capture.world, out, width)
    write_cameras(out / "cameras.json", capture)
    return folder


def result_warnings(run: OpenRun) -> list[str]:
    """What other readers of the result folder get wrong about a run; empty in most cases."""
    family = family_named(run.scene.traits.family)
    return [] if family is None else family.warnings(run)


def file_path(run: Path, name: str, format: Format, out: Path | None) -> Path:
    """Where a file of a format goes: `out`, or scene.SUFFIX in the folder `out` or `run`. A name without a suffix is a folder.

    Raises InputError for a name with another suffix than the format's, because programs go by it, and for a file where the folder
    should be.
    """
    if out is None or out.is_dir() or not out.suffix:
        if out is not None and out.exists() and not out.is_dir():
            raise InputError(
                f"expected a folder, or a name that ends in {format.suffix}, as --out, found the file {out}; choose another name"
            )
        return (out or run) / f"{NAME}{format.suffix}"
    own = (format.suffix, *format.other_suffixes)
    every = (*own, *(format_named(other).suffix for other in format_names()))
    found = max((suffix for suffix in every if suffix and out.name.lower().endswith(suffix)), key=len, default=None)
    if found not in own:
        endings = " or ".join(own)
        raise InputError(f"expected a name that ends in {endings} for --format {name}, found {out.name}; correct --out or --format")
    return out


def world_of(run: OpenRun) -> World:
    """The world that a run was trained in: from a description in its result folder, else from its capture."""
    data = _trained(run)["data"]
    for path in sorted((run.path / "point_cloud").glob(f"iteration_*/{DESCRIPTION}"), key=lambda p: p.stat().st_mtime, reverse=True):
        try:
            found = read_json(path, "scene description")
            if found["data"] == data:
                x, y, z = (float(v) for v in found["world"]["shift"])
                return World(float(found["world"]["scale"]), (x, y, z))
        except (InputError, KeyError, TypeError, ValueError):
            continue  # the capture says it too
    capture = capture_of(run)
    capture.images.close()
    return capture.world


def _trained(run: OpenRun) -> dict[str, Any]:
    """The entries of a description about the training: recipe and reading of the capture, without
    the capture's path."""
    plain = to_json(run.config)
    del plain["data"]["path"]
    return {"train": plain["train"], "data": plain["data"]}


def _check(options: Options) -> None:
    """Raises InputError, naming the flag, for values out of range."""
    for name in ("sh_degree", "max_gaussians", "refine"):
        if getattr(options, name) < 0:
            raise InputError(f"expected {_flag(name)} of at least 0, found {getattr(options, name)}; give a larger number")
    if options.sh_degree > MAX_DEGREE:
        raise InputError(f"expected --sh-degree of at most {MAX_DEGREE}, found {options.sh_degree}; give a lower degree")
    if options.crop:
        from scene_experts.files.select import parse_crop

        parse_crop(options.crop)
    if not 0 <= options.prune < 1:
        raise InputError(f"expected --prune as a share from 0 to below 1, found {options.prune}; correct it")


def _expect_unused(options: Options, format: str) -> None:
    """Raises InputError for options of standard files with a format that is none."""
    for f in fields(options):
        if f.name != "measure" and getattr(options, f.name) != f.default:
            raise InputError(f"expected {_flag(f.name)} with a standard file (ply, spz, html, ...), found --format {format}; leave it out")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


# --- scenes with their networks -----------------------------------------------------------------------------------------------------------


def _export_scene(work: _Work, out: Path | None) -> Written:
    """Write the run's scene as it is, in a format of its own family."""
    run, format, traits = work.run, work.format, work.run.scene.traits
    family = family_named(format.family)
    if traits.family != format.family or family is None:
        own = formats_of(traits.family) if family_named(traits.family) is not None else {}
        raise InputError(
            f"expected a scene of {format.family} for --format {work.name}, found {traits.rows} (a run of '{run.config.train.recipe}'); "
            f"use --format {next(iter(own), 'ply')}"
        )
    _expect_unused(work.options, work.name)
    world = world_of(run)
    if format.is_folder:
        return _export_folder(work, family, world, out or run.path)
    path = file_path(run.path, work.name, format, out)
    about = family.describe(run, world) | _trained(run)
    detail = format.write(path, family.contents(run, world, about), {})  # type: ignore[misc]
    rows, size = len(run.scene.positions), path.stat().st_size
    said = f"{rows:,} {traits.rows}, {size / 1e6:.2f} MB with networks" + (f", {detail}" if detail is not None else "")
    written = Written(path, size, rows, (f"wrote {path}", said))
    if not work.options.measure or format.read is None:
        return written
    with capture_if_there(run, needed=False) as capture:
        found = cost(run, lambda: {"file": family.scene(run, format.read(path), world)}, capture, work.rasterize, work.tell)  # type: ignore[misc]
    return replace(written, lines=(*written.lines, *found.lines), psnr=found.psnr)


def _export_folder(work: _Work, family: Family, world: World, out: Path) -> Written:
    run = work.run
    cameras = run.path / "cameras.json"
    folder = write_scene_folder(run, family, world, out, width_in(cameras) if cameras.is_file() else None)
    if out != run.path and cameras.is_file():
        write_bytes(out / "cameras.json", cameras.read_bytes())
    size, rows = sum(p.stat().st_size for p in folder.iterdir()), len(run.scene.positions)
    said = f"{rows:,} {run.scene.traits.rows}, {size / 1e6:.2f} MB with networks, in the capture's own frame"
    return Written(folder, size, rows, (f"wrote {folder}", said, *family.warnings(run)))


def write_scene_folder(run: OpenRun, family: Family, world: World, out: Path, width: int | None) -> Path:
    """Write point_cloud/iteration_N with the scene and its description, and cfg_args above it; return
    the iteration's folder. The description comes last: a folder that has it is complete.

    width: Of the views trained on, in px; None if it is unknown.
    """
    folder = out / "point_cloud" / f"iteration_{run.step}"
    about = family.describe(run, world) | _trained(run)
    settings = family.write(run, world, folder, about)
    if settings:
        every = settings | capture_settings(run.config.data, width)
        text = ", ".join(f"{name}={value!r}" for name, value in every.items())
        write_bytes(out / "cfg_args", f"Namespace({text})".encode())
    write_json(folder / DESCRIPTION, about)
    return folder


def width_in(path: Path) -> int | None:
    """Return the width in px of the first view of a cameras.json, or None if the file does not say it."""
    try:
        width = read_json(path, "list of views")[0]["width"]
    except (InputError, LookupError, TypeError):
        return None
    return width if type(width) is int and width > 0 else None


def capture_settings(data: Data, width: int | None = None) -> dict[str, Any]:
    """Return the settings for cfg_args that say where the capture is and how the published tools
    read it, as closely as their settings can express ours.

    source_path is the path that the run was given. resolution: -1 limits the width to 1600 px, 1, 2,
    4 and 8 divide the sides, other numbers are the width in px: `width`, that of the views trained on.
    Where it is unknown, -1 stands for a width that only the photographs tell. eval holds out every 8th
    view; with lod, from 1 to 49, the views 0 to lod instead.
    """
    kind, _, number = data.resolution.partition(":")
    held = data.split.removeprefix("first:")
    first = int(held) if held != data.split and held.isdecimal() else 0
    # NeRF-synthetic captures are white by default; the published tools recognise them by this file too.
    synthetic = (data.path / "transforms_train.json").is_file()
    white = (data.background is None and synthetic) or data.background == (1.0, 1.0, 1.0)
    if kind in ("cap1600", "inria"):
        resolution = -1
    elif kind == "as-is":
        resolution = 1
    elif kind == "factor" and float(number) in (1, 2, 4, 8):
        resolution = int(float(number))
    else:
        resolution = width or -1
    return {
        "source_path": str(data.path),
        "images": data.images or (f"images_{number}" if kind == "inria" else "images"),
        "resolution": resolution,
        "white_background": white,
        "data_device": "cuda",
        "eval": data.split != "none",
        "lod": first - 1 if 2 <= first <= 50 else 0,
    }


# --- standard Gaussians -------------------------------------------------------------------------------------------------------------------


def _files(run: OpenRun, path: Path, levels: bool) -> list[tuple[int | None, Path]]:
    """The files to write: (finest level, path) each, None for all levels. Raises InputError for
    --levels without levels."""
    if not levels:
        return [(None, path)]
    if not run.scene.traits.levels:
        raise InputError(f"expected a run with levels of detail for --levels, found one of '{run.config.train.recipe}'; leave --levels out")
    held = run.scene.rows_by_level()  # levels without rows would repeat the level before
    stem, dot, suffixes = path.name.partition(".")
    return [(level, path.with_name(f"{stem}_level{level}{dot}{suffixes}")) for level, count in enumerate(held) if count]


@dataclass(frozen=True)
class _Made:
    """Standard Gaussians of a run, which several formats may share."""

    contents: Splats  # of the file
    whole: Splats  # before Gaussians were left out
    about: dict[str, Any]  # how they were baked and selected
    before: dict[str, tuple[Scene, int]]  # scenes to measure too
    seconds: float  # of the bake
    lines: tuple[str, ...]  # what was left out


def _make_gaussians(work: _Work, world: World, capture: Capture | None) -> _Made:
    """Bake the run's scene where that is needed, and leave out what the options say."""
    options, gaussians = work.options, family_named(GAUSSIANS)
    assert gaussians is not None
    began = time.perf_counter()
    made, about, before = (work.run, {}, {}) if work.is_direct else _bake(work, capture)
    whole = contents = gaussians.contents(made, world, {})
    seconds, lines = time.perf_counter() - began, []
    whole.expect_finite("the scene")
    if options.floaters == "remove":
        from scene_experts.files.select import find_floaters

        assert capture is not None
        painter = Painter.of(*gaussians.scene(work.run, whole, world), work.rasterize, work.run.config.train.antialias)
        out = find_floaters(whole, painter, [capture.views[i].camera for i in capture.train], work.tell)
        contents, about = whole.rows(~out), about | {"floaters": int(out.sum())}
        lines.append(f"removed {int(out.sum()):,} floaters ({float(out.float().mean()):.1%})")
    if options.crop:
        from scene_experts.files.select import crop, parse_crop

        assert capture is not None
        count = len(contents)
        contents, about = crop(contents, parse_crop(options.crop), capture, world), about | {"crop": options.crop}
        lines.append(f"cropped to {options.crop}: {len(contents):,} of {count:,} Gaussians; PSNR is not measured without the rest")
    return _Made(contents, whole, about, before, seconds, tuple(lines))


def _export_gaussians(
    work: _Work, path: Path, level: int | None, capture: Capture | None, made: dict[tuple[int | None, int], _Made]
) -> Written:
    """Make, write, read again and measure one file. made: what earlier files made, by level and degree of the harmonics."""
    run, options, format, gaussians = work.run, work.options, work.format, family_named(GAUSSIANS)
    assert gaussians is not None and format.write is not None
    world = World() if options.frame == "trained" else world_of(run) if capture is None else capture.world
    key = (level, options.sh_degree)
    with nullcontext() if level is None else run.scene.at_level(level):
        fresh = key not in made
        if fresh:
            made[key] = _make_gaussians(work, world, capture)
        one = made[key]
        contents, bake = one.contents.up_to_degree(format.sh_degree), not work.is_direct
        about = _describe(work, contents, level) | one.about
        note = {name: value for name, value in about.items() if name != "antialias" or format.antialias}
        views = {} if format.view_note is None or capture is None else format.view_note(capture, world)
        titled = {} if options.title is None else {"title": options.title}
        told = format.write(path, contents, note | views | titled)
        facts: dict[str, Any] = {"file": path.name, "bytes": path.stat().st_size, "seconds": round(one.seconds, 1), "psnr": {}}
        frame = "the capture's own frame" if options.frame == "capture" else "the trained world"
        said = f"{len(contents):,} Gaussians, {facts['bytes'] / 1e6:.2f} MB, harmonics of degree {contents.degree}, in {frame}"
        how = f"; baked in {format_duration(one.seconds)}" if fresh else "; of the same bake"
        lines = (f"wrote {path}", said + (how if bake else ""), *one.lines, *([str(told)] if told is not None else []))
        written = Written(path, facts["bytes"], len(contents), lines)
        if options.measure and format.read is not None and not options.crop:

            def scenes() -> dict[str, tuple[Scene, int]]:
                baked = {"bake": gaussians.scene(run, one.whole, world)} if bake else {}
                return {**one.before, **baked, "file": gaussians.scene(run, format.read(path), world)}  # type: ignore[misc]

            found = cost(run, scenes, capture, work.rasterize, work.tell)
            facts["psnr"], written = found.plain, replace(written, lines=(*lines, *found.lines), psnr=found.psnr)
    write_json(path.with_name(path.name + ".json"), about | facts)
    return written


def _bake(work: _Work, capture: Capture | None) -> tuple[OpenRun, dict[str, Any], dict[str, tuple[Scene, int]]]:
    """The run with baked Gaussians, the entries of its description about the bake, and the scene
    before its refinement to measure too."""
    from scene_experts.files.bake.bake import DRAWN_AT, Bake, Refine, bake

    assert capture is not None
    options = work.options
    how = Bake(options.sh_degree, options.max_gaussians, options.prune, Refine(options.refine))
    baked = bake(work.run, capture, how, work.rasterize, work.tell)
    before: dict[str, tuple[Scene, int]] = {"closed_form": (baked.closed_form, DRAWN_AT)} if options.refine else {}
    return replace(work.run, scene=baked.scene), baked.about, before


def _describe(work: _Work, contents: Any, level: int | None) -> dict[str, Any]:
    """How a file was made, as JSON values."""
    run = work.run
    return {
        "format": NOTE_FORMAT,
        "made_by": f"scene-experts {__version__}",
        "command": work.command,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "capture": run.capture,
        "frame": work.options.frame,
        "antialias": run.config.train.antialias,
        "gaussians": len(contents),
        "sh_degree": contents.degree,
        **({} if level is None else {"level": level}),
    }
