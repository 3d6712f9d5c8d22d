"""`scene-experts export` to standard files: a run's Gaussians, baked where they depend on the camera, written, read again and measured."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, write_json
from scene_experts.data.capture import Capture
from scene_experts.data.views import World
from scene_experts.files.bake.bake import Bake, bake, explicit
from scene_experts.files.bake.measure import counted, nothing_counted, scores
from scene_experts.files.bake.refine import DRAWN_AT
from scene_experts.files.bake.sums import Tell
from scene_experts.files.export import moved, world_of
from scene_experts.files.formats.html_page import capture_notes
from scene_experts.files.formats.splats import Splats, from_scene, to_columns
from scene_experts.files.formats.standard import FORMATS, read_standard, write_standard
from scene_experts.render import Rasterizer, as_trained
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.scene.anchors.select import LevelSelector, capped
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.training import run_folder
from scene_experts.training.config import to_json
from scene_experts.training.progress import format_duration
from scene_experts.training.run_folder import OpenRun

SIDECAR_FORMAT = 1
WITHOUT_HARMONICS = ("splat",)  # formats that hold one colour a Gaussian: what is baked for them is fitted without harmonics


@dataclass(frozen=True)
class Options:
    """What a standard file is to hold, and what to say about it."""

    bake: Bake = Bake()
    frame: Literal["capture", "trained"] = "capture"
    levels: bool = False  # one file per level of detail
    measure: bool = True
    command: str = ""  # the command line, for the note


@dataclass(frozen=True)
class Made:
    """Gaussians for a file, and what there was on the way to them."""

    splats: Splats
    closed_form: GaussianScene | None
    contributing: int | None


def is_direct(run: OpenRun, how: Bake) -> bool:
    """Whether the run's rows are standard Gaussians already and go into the file as they are."""
    scene = run.scene
    if not isinstance(scene, GaussianScene):
        return False
    cut = 0 < how.max_gaussians < len(scene.table)
    return how.sh_degree >= scene.config.sh_degree and not how.prune and not cut


def export_standard(
    run: Path,
    format: str,
    out: Path | None,
    step: int | None,
    rasterize: Rasterizer,
    options: Options = Options(),
    data: Path | None = None,
    tell: Tell = lambda what, done, total: None,
) -> list[str]:
    """Write the newest checkpoint of a run (or the one at `step`) as standard Gaussians in one of `standard.FORMATS`; says what it wrote.

    out: file or folder, RUN/scene.SUFFIX by default; with levels, one file for each beside it. A description (FILE.json) goes beside each.
    data: where the capture is now, if it moved. Raises InputError where the format is unknown, the settings are impossible, or the
    capture is not where it was.
    """
    options.bake.check()
    if format not in FORMATS:
        raise InputError(f"expected a format among {', '.join(FORMATS)}, found '{format}'; choose one of those")
    opened = moved(run_folder.open_run(run, "cpu", step), data)
    if format in WITHOUT_HARMONICS and not isinstance(opened.scene, GaussianScene):
        options = replace(options, bake=replace(options.bake, sh_degree=0))
    name = "scene" + FORMATS[format].suffix
    path = run / name if out is None else out / name if out.is_dir() else out
    check_suffix(path, format)
    check_writable(path)
    rasterize = as_trained(rasterize, opened.cfg.antialias)
    lines: list[str] = []
    with opened_capture(opened, needed=not is_direct(opened, options.bake)) as capture:
        for level, file in files(opened, path, options.levels):
            with capped(opened.scene, level):
                lines += one_file(opened, format, file, capture, rasterize, options, level, tell)
    return lines


def check_suffix(path: Path, format: str) -> None:
    """Raises InputError for a name that says another format: programs go by it."""
    named = max((f for f in FORMATS if path.name.lower().endswith(FORMATS[f].suffix)), key=lambda f: len(FORMATS[f].suffix), default=format)
    if named != format and (named, format) != ("ply", "compressed-ply"):
        raise InputError(
            f"expected a name that ends in {FORMATS[format].suffix} for --format {format}, found {path.name}; correct --out or --format"
        )


@contextmanager
def opened_capture(run: OpenRun, needed: bool) -> Iterator[Capture | None]:
    """The capture of a run; None where it is gone and not needed. Raises InputError where it is gone and needed, or another."""
    data = run.config.data
    if not data.path.exists() and not needed:
        yield None
        return
    if not data.path.exists():
        raise InputError(
            f"expected the run's capture at {data.path}, whose cameras this file is made with, found none; give it with --data"
        )
    capture = run_folder.capture_of(run)
    try:
        yield capture
    finally:
        capture.images.close()


def files(run: OpenRun, path: Path, levels: bool) -> list[tuple[int | None, Path]]:
    """The files to write: (finest level, path) each, None for all levels. Raises InputError where there are no levels to split."""
    if not levels:
        return [(None, path)]
    select = run.scene.select if isinstance(run.scene, AnchorScene) else None
    if not isinstance(select, LevelSelector):
        raise InputError(f"expected a run with levels of detail for --levels, found one of '{run.config.train.recipe}'; leave --levels out")
    stem, dot, suffixes = path.name.partition(".")
    held = run.scene.table.facts["level"].unique().tolist()  # levels that growth never reached would repeat the one before
    return [(level, path.with_name(f"{stem}_level{level}{dot}{suffixes}")) for level in range(select.lattices.count) if level in held]


def one_file(
    run: OpenRun, format: str, path: Path, capture: Capture | None, rasterize: Rasterizer, options: Options, level: int | None, tell: Tell
) -> list[str]:
    """Make, write, read and measure one file; says what it holds."""
    began = time.perf_counter()
    world = World() if options.frame == "trained" else world_of(run) if capture is None else capture.world
    made = gaussians(run, capture, world, rasterize, options.bake, tell)
    seconds = time.perf_counter() - began
    about = description(run, made, options, level)
    page = capture_notes(capture, world, run.cfg.antialias) if capture is not None else {}
    write_standard(path, made.splats, format, about | page)
    size = path.stat().st_size
    frame = "the capture's own frame" if options.frame == "capture" else "the trained world"
    count = f"{len(made.splats):,} Gaussians, {size / 1e6:.2f} MB, harmonics of degree {made.splats.degree}, in {frame}"
    lines = [f"wrote {path}", count + ("" if is_direct(run, options.bake) else f"; baked in {format_duration(seconds)}")]
    measured: dict[str, Any] = {}
    views = counted(capture) if options.measure and capture is not None else []
    if views and capture is not None:
        measured, line = measure(run, made, path, world, capture, views, rasterize, options.bake.refine.iterations > 0, tell)
        lines.append(line)
    elif options.measure:
        absent = "the capture is gone" if capture is None else nothing_counted(capture)
        lines.append(f"{absent}: what the file costs in PSNR was not measured")
    write_json(
        path.with_name(path.name + ".json"),
        about | {"file": path.name, "bytes": size, "seconds": round(seconds, 1), "psnr": measured},
    )
    return lines


def gaussians(run: OpenRun, capture: Capture | None, world: World, rasterize: Rasterizer, how: Bake, tell: Tell) -> Made:
    """The Gaussians of a file: the run's own where nothing is asked of them, else baked."""
    if is_direct(run, how):
        assert isinstance(run.scene, GaussianScene)
        return Made(from_scene(run.scene, world), None, None)
    assert capture is not None
    baked = bake(run.scene, run.step, capture, rasterize, how, tell)
    return Made(from_scene(baked.scene, world), baked.closed_form, baked.contributing)


def measure(
    run: OpenRun,
    made: Made,
    path: Path,
    world: World,
    capture: Capture,
    views: list[int],
    rasterize: Rasterizer,
    refined: bool,
    tell: Tell,
) -> tuple[dict[str, Any], str]:
    """PSNR of the held-out `views` from the run, the closed form, the bake and the file as it is read again; and the line that says it."""
    scenes: dict[str, Any] = {"run": (run.scene.frozen(run.step), run.step)}
    if made.closed_form is not None:
        scenes |= {"closed_form": (made.closed_form, DRAWN_AT)} if refined else {}
        scenes["bake"] = (scene_of(made.splats, world, run.scene.extent), DRAWN_AT)
    scenes["file"] = (scene_of(read_standard(path), world, run.scene.extent), DRAWN_AT)
    found = scores(scenes, capture, views, rasterize, tell)
    before, after = found["run"].photographs, found["file"].photographs
    words = {"closed_form": "means over the views", "bake": "refined" if refined else "means over the views"}
    middle = "".join(f"{words[name]} {found[name].photographs:.3f}, " for name in words if name in found)
    line = f"PSNR of {len(views)} held-out views: run {before:.3f} dB, {middle}this file {after:.3f} dB ({after - before:+.3f})"
    if made.closed_form is not None:
        line += f"; its pictures against the run's {found['file'].first:.2f} dB"
    plain: dict[str, Any] = {name: {"photographs": round(s.photographs, 6), "run": round(s.first, 6)} for name, s in found.items()}
    return plain | {"views": len(views)}, line


def scene_of(splats: Splats, world: World, extent: float) -> GaussianScene:
    """The scene that a file's Gaussians make, in the trained world."""
    return explicit(to_columns(splats, world), extent)


def description(run: OpenRun, made: Made, options: Options, level: int | None) -> dict[str, Any]:
    """How a file was made, as plain values."""
    direct = is_direct(run, options.bake)
    return {
        "format": SIDECAR_FORMAT,
        "made_by": f"scene-experts {run_folder.versions()['scene-experts']}",
        "command": options.command,
        "recipe": run.config.train.recipe,
        "step": run.step,
        "capture": run.capture,
        "frame": options.frame,
        "antialias": run.cfg.antialias,
        "gaussians": len(made.splats),
        "sh_degree": made.splats.degree,
        **({} if level is None else {"level": level}),
        **({} if direct else {"bake": to_json(options.bake), "contributing": made.contributing}),
    }
