"""Runs to files of standard Gaussians: baked where the scene depends on the camera, written, read
again and measured."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scene_experts.core.io import write_json
from scene_experts.core.version import __version__
from scene_experts.data.views import Capture, World
from scene_experts.files.formats.splats import Splats
from scene_experts.files.measure import Painter, Tell, cost
from scene_experts.files.options import Options
from scene_experts.files.placed import AROUND
from scene_experts.files.registry import GAUSSIANS, Format, family_named
from scene_experts.files.scene_folder import origin_note, origin_of, tell_origin, world_of
from scene_experts.render import Rasterizer
from scene_experts.scene import Scene
from scene_experts.training.progress import format_duration
from scene_experts.training.run_folder import OpenRun

NOTE_FORMAT = 1


@dataclass(frozen=True)
class Written:
    """What `export` wrote."""

    path: Path
    """The file, or the folder point_cloud/iteration_N of a result folder."""
    bytes: int
    """Size of the file with its parts, or of the folder's files."""
    rows: int
    """Anchors, Gaussians or points in it."""
    lines: tuple[str, ...]
    """The same in sentences, for a terminal."""
    format: str = ""
    """Name of the format."""
    psnr: dict[str, float] = field(default_factory=dict)
    """Mean PSNR of the held-out views against the photographs, dB, drawn from the "run" and from
    the "file", for a baked scene also from its "closed_form" and its "bake"; empty where nothing
    was measured."""


@dataclass(frozen=True)
class ExportTask:
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


@dataclass(frozen=True)
class Made:
    """Standard Gaussians of a run, which several formats may share."""

    contents: Splats  # of the file
    whole: Splats  # before Gaussians were left out
    about: dict[str, Any]  # how they were baked and selected
    before: dict[str, tuple[Scene, int]]  # scenes to measure too
    seconds: float  # of the bake; 0 for one that the run had kept
    lines: tuple[str, ...]  # what was left out


def _make_gaussians(work: ExportTask, world: World, capture: Capture | None, level: int | None) -> Made:
    """Bake the run's scene where that is needed, and leave out what the options say."""
    options, gaussians = work.options, family_named(GAUSSIANS)
    assert gaussians is not None
    made, about, before, seconds = (work.run, {}, {}, 0.0) if work.is_direct else _bake(work, capture, whole=level is None)
    whole = contents = gaussians.contents(made, world, {})
    lines = []
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
    return Made(contents, whole, about, before, seconds, tuple(lines))


def export_gaussians(
    work: ExportTask, path: Path, level: int | None, capture: Capture | None, made: dict[tuple[int | None, int], Made]
) -> Written:
    """Make, write, read again and measure one file. made: what earlier files made, by level and
    degree of the harmonics."""
    run, options, format, gaussians = work.run, work.options, work.format, family_named(GAUSSIANS)
    assert gaussians is not None and format.write is not None
    world = World() if options.frame == "trained" else world_of(run) if capture is None else capture.world
    origin = (0.0, 0.0, 0.0) if options.frame == "trained" else origin_of(run, world)
    world, key = world.seen_from(origin), (level, options.sh_degree)
    with nullcontext() if level is None else run.scene.at_level(level):
        fresh = key not in made
        if fresh:
            made[key] = _make_gaussians(work, world, capture, level)
        one = made[key]
        contents, bake = one.contents.up_to_degree(format.sh_degree), not work.is_direct
        about = _describe(work, contents, level) | one.about | origin_note(origin)
        note = {name: value for name, value in about.items() if name != "antialias" or format.antialias}
        views = {} if format.view_note is None or capture is None else format.view_note(capture, world)
        around = run.cameras is not None and run.cameras.kind == AROUND
        if around:
            views.pop("cameras", None)  # nothing was photographed from there
        titled = {} if options.title is None else {"title": options.title}
        told = format.write(path, contents, note | views | titled)
        facts: dict[str, Any] = {"file": path.name, "bytes": path.stat().st_size, "seconds": round(one.seconds, 1), "psnr": {}}
        whose = "the capture's" if run.lone is None else "the file's"
        frame = f"{whose} own frame" if options.frame == "capture" else "the trained world"
        frame += f", {tell_origin(origin)}" if any(origin) else ""
        said = f"{len(contents):,} Gaussians, {facts['bytes'] / 1e6:.2f} MB, harmonics of degree {contents.degree}, in {frame}"
        how = "; of the same bake" if not fresh else f"; baked in {format_duration(one.seconds)}" if one.seconds else "; of the run's bake"
        how += " from cameras around the scene" if around else ""
        lines = (f"wrote {path}", said + (how if bake else ""), *one.lines, *([str(told)] if told is not None else []))
        written = Written(path, facts["bytes"], len(contents), lines, work.name)
        if options.measure and format.read is not None and not options.crop:

            def scenes() -> dict[str, tuple[Scene, int]]:
                baked = {"bake": gaussians.scene(run, one.whole, world)} if bake else {}
                return {**one.before, **baked, "file": gaussians.scene(run, format.read(path), world)}  # type: ignore[misc]

            found = cost(run, scenes, capture, work.rasterize, work.tell)
            facts["psnr"], written = found.plain, replace(written, lines=(*lines, *found.lines), psnr=found.psnr)
    write_json(path.with_name(path.name + ".json"), about | facts)
    return written


def _bake(work: ExportTask, capture: Capture | None, *, whole: bool) -> tuple[OpenRun, dict[str, Any], dict[str, tuple[Scene, int]], float]:
    """The run with baked Gaussians, the entries of its description about the bake, the scene before
    its refinement to measure too, and the seconds it took.

    whole: All levels of detail; the run keeps that bake.
    """
    from scene_experts.files.bake import kept
    from scene_experts.files.bake.bake import DRAWN_AT, Bake, Refine, bake

    assert capture is not None
    options, began = work.options, time.perf_counter()
    how = Bake(options.sh_degree, options.max_gaussians, options.prune, Refine(options.refine))
    baked = kept.load(work.run, capture, how) if whole else None
    seconds = 0.0
    if baked is None:
        baked = bake(work.run, capture, how, work.rasterize, work.tell)
        seconds = time.perf_counter() - began
        if whole:
            kept.keep(work.run, capture, how, baked)
    refined = options.refine != 0 and baked.closed_form is not None
    before: dict[str, tuple[Scene, int]] = {"closed_form": (baked.closed_form, DRAWN_AT)} if refined else {}  # type: ignore[dict-item]
    return replace(work.run, scene=baked.scene), baked.about, before, seconds


def _describe(work: ExportTask, contents: Any, level: int | None) -> dict[str, Any]:
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
        **({} if run.lone is None else run.lone.note),
    }
