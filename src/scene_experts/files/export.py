"""Runs to files: the only entry is `export`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable
from scene_experts.files.measure import Tell, capture_if_there
from scene_experts.files.options import DEFAULT, MAX_DEGREE, Options
from scene_experts.files.own import export_scene
from scene_experts.files.registry import GAUSSIANS, format_named
from scene_experts.files.standard import Made, export_gaussians, files_of
from scene_experts.files.work import Work, Written, file_path, flag
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun


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
        out: File, or folder for it. Default: scene.SUFFIX in the run folder. With `options.levels`,
            one file per level of detail beside it.
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
        if out.is_file() or out.suffix:
            raise InputError(f"expected a folder as --out for several formats, found {out}; name a folder")
        out.mkdir(parents=True, exist_ok=True)
    works = [Work(run, name, format_named(name), options, rasterize, tell, command) for name in dict.fromkeys(formats)]
    standard, places = [], []
    for work in works:
        if work.format.family == GAUSSIANS:
            if run.scene.traits.sh_degree is None:  # it will be baked
                work = replace(work, options=replace(options, sh_degree=min(options.sh_degree, work.format.sh_degree)))
            standard.append(work)
            places.append(file_path(run.path, work.name, work.format, out))
            check_writable(places[-1])
            if work.format.needs is not None:
                work.format.needs()
    own = Options(measure=options.measure) if standard else options  # the other options are those of the standard files then
    written = [export_scene(replace(work, options=own), out) for work in works if work.format.family != GAUSSIANS]
    if standard:
        made: dict[tuple[int | None, int], Made] = {}
        selects = bool(options.crop) or options.floaters == "remove"
        with capture_if_there(run, needed=selects or not all(work.is_direct for work in standard)) as capture:
            for work, path in zip(standard, places):
                for level, file in files_of(run, path, options.levels):
                    written.append(export_gaussians(work, file, level, capture, made))
    return written


def _check(options: Options) -> None:
    """Raises InputError, naming the flag, for values out of range."""
    for name in ("sh_degree", "max_gaussians", "refine"):
        if getattr(options, name) < 0:
            raise InputError(f"expected {flag(name)} of at least 0, found {getattr(options, name)}; give a larger number")
    if options.sh_degree > MAX_DEGREE:
        raise InputError(f"expected --sh-degree of at most {MAX_DEGREE}, found {options.sh_degree}; give a lower degree")
    if options.crop:
        from scene_experts.files.select import parse_crop

        parse_crop(options.crop)
    if not 0 <= options.prune < 1:
        raise InputError(f"expected --prune as a share from 0 to below 1, found {options.prune}; correct it")
