"""Runs to files: the only entry is `export`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, write_bytes, write_json
from scene_experts.data.views import Capture, World
from scene_experts.files.accepted import FITTED, check_values, expect_drawn, expect_fitted, expect_unused, expect_used
from scene_experts.files.gaussians.read import forget_description
from scene_experts.files.measure import OF_THE_FORMAT, Tell, capture_if_there, cost
from scene_experts.files.options import DEFAULT, Options
from scene_experts.files.placed import AROUND, place_cameras
from scene_experts.files.registry import (
    GAUSSIANS,
    Family,
    Format,
    Note,
    family_named,
    format_named,
    format_names,
    formats_of,
    recognise,
)
from scene_experts.files.result_folder import is_result
from scene_experts.files.scene_folder import origin_note, origin_of, tell_origin, trained_in, width_in, world_of, write_scene_folder
from scene_experts.files.standard import NOTE_FORMAT, ExportTask, Made, Written, export_gaussians
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun

OF_THE_PRECISION = "its values are rounded too coarsely: ask for a smaller --quality or a larger --target-mb"
NAME = "scene"  # of files whose name the caller does not choose


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
        run: The run, or a file that `lone.open_scene` opened, on the CPU. `run_folder.with_capture`
            says where its capture is if it moved.
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
    """Write a trained scene in several formats. Standard files with harmonics of the same degree
    share one bake.

    out: with several formats, a folder. The other arguments, the result and the errors are those of
    `export`.
    """
    check_values(options)
    formats, notes = _formats_for(run, formats)
    _expect_for_file(run, formats, out, options)
    if len(formats) > 1 and out is not None:
        if not out.is_dir() and (out.exists() or out.suffix):
            raise InputError(f"expected a folder as --out for several formats, found {out}; name a folder")
        out.mkdir(parents=True, exist_ok=True)
    works = [ExportTask(run, name, format_named(name), options, rasterize, tell, command) for name in dict.fromkeys(formats)]
    expect_fitted([(work.name, work.format) for work in works], options)
    if options.photographs and not any(work.format.look for work in works):
        raise InputError(f"expected --photographs with --format html of a scene with networks, found {works[0].name}; leave it out")
    standard, places = [], []
    for work in works:
        if work.format.family == GAUSSIANS:
            if not work.is_direct:  # it will be baked
                work = replace(work, options=replace(options, sh_degree=min(options.sh_degree, work.format.sh_degree)))
            standard.append(work)
            places.append(place_of(run, work.name, work.format, out))
            check_writable(places[-1])
            if work.format.needs is not None:
                work.format.needs()
    expect_used(works)
    written = [_export_drawn(work, out) for work in works if work.format.draw is not None]
    rest = [work for work in works if work.format.draw is None and work.format.family != GAUSSIANS]
    for work in rest:  # the other options are those of the other files, if there are any
        own = Options(**{name: getattr(options, name) for name in ("measure", "photographs", *FITTED)})
        own = replace(own, title=options.title) if work.format.view_note is not None else own
        written.append(_export_scene(replace(work, options=options if len(rest) == len(works) else own), out))
    if standard:
        made: dict[tuple[int | None, int], Made] = {}
        selects = bool(options.crop) or options.floaters == "remove"
        with capture_if_there(run, needed=selects or not all(work.is_direct for work in standard)) as capture:
            for work, path in zip(standard, places):
                for level, file in _files(run, path, options.levels):
                    written.append(export_gaussians(work, file, level, capture, made))
    if notes:
        written[-1] = replace(written[-1], lines=(*written[-1].lines, *notes))
    return written


def _formats_for(run: OpenRun, formats: Sequence[str]) -> tuple[list[str], list[str]]:
    """The formats that write this run for those that were asked for, and sentences about others
    that take their places. Raises InputError for two that would write one file."""
    names, notes = [], list[str]()
    for name in dict.fromkeys(formats):
        format = format_named(name)
        if format.otherwise and run.scene.traits.family != format.family:
            name = format.otherwise
        elif format.otherwise and format.lacks is not None and (found := format.lacks(_contents_of(run, format)[0])):
            name = format.otherwise
            notes.append(f"the page holds baked Gaussians, because its script cannot decode {found}")
        names.append(name)
    names, suffixes = list(dict.fromkeys(names)), dict[str, str]()
    for name in names:
        suffix = format_named(name).suffix
        if suffix and (other := suffixes.setdefault(suffix, name)) != name:
            raise InputError(f"expected formats with files of their own, found {other} and {name}, both *{suffix}; export one at a time")
    return names, notes


def _contents_of(run: OpenRun, format: Format) -> tuple[Any, World]:
    """What a file of a format of the run's own family holds, and its frame."""
    family, trained = family_named(format.family), world_of(run)
    assert family is not None
    origin = origin_of(run, trained)
    world = trained.seen_from(origin)
    return family.contents(run, world, family.describe(run, trained) | trained_in(run) | origin_note(origin)), world


def place_of(run: OpenRun, name: str, format: Format, out: Path | None) -> Path:
    """`file_path` for a run; a scene of a file goes beside it under its name.

    Raises InputError also for the file that the scene was read from, and, unless it is named, for a
    file that `export` did not write.
    """
    if run.lone is None:
        return file_path(run.path, name, format, out)
    path = file_path(run.path, name, format, out, run.lone.name)
    if path.exists() and path.samefile(run.lone.source):
        raise InputError(f"expected another file to write than the one that is read, found {path} for both; name one with --out")
    if out is None and path.exists() and not _is_exported(path, format):
        raise InputError(f"expected no file at {path}, or one that export wrote, found another; name a file with --out")
    return path


def _is_exported(path: Path, format: Format) -> bool:
    """Return whether `export` wrote a file: it has a description beside it, or is one of its pages.
    Other files may be what a scene is read from."""
    if path.with_name(path.name + ".json").exists():
        return True
    try:
        return format.suffix == ".html" and recognise(path)[1].suffix == ".html"
    except InputError:
        return False


def file_path(run: Path, name: str, format: Format, out: Path | None, called: str = NAME) -> Path:
    """Where a file of a format goes: `out`, or CALLED.SUFFIX in the folder `out` or `run`. A name
    without a suffix is a folder.

    Raises InputError for a name with another suffix than the format's, because programs go by it,
    and for a file where the folder should be.
    """
    if out is None or out.is_dir() or not out.suffix:
        if out is not None and out.exists() and not out.is_dir():
            raise InputError(
                f"expected a folder, or a name that ends in {format.suffix}, as --out, found the file {out}; choose another name"
            )
        return (out or run) / f"{called}{format.suffix}"
    own = (format.suffix, *format.other_suffixes)
    every = (*own, *(format_named(other).suffix for other in format_names()))
    found = max((suffix for suffix in every if suffix and out.name.lower().endswith(suffix)), key=len, default=None)
    if found not in own:
        endings = " or ".join(own)
        raise InputError(f"expected a name that ends in {endings} for --format {name}, found {out.name}; correct --out or --format")
    return out


def _expect_for_file(run: OpenRun, formats: Sequence[str], out: Path | None, options: Options) -> None:
    """Raises InputError for what a scene of a file does not have: a folder for a result, and
    photographs that support its Gaussians."""
    if run.lone is None:
        return
    folders = [name for name in formats if format_named(name).is_folder]
    if folders and out is None:
        raise InputError(f"expected a folder for --format {folders[0]} of {run.lone.source}, found none; name one with --out")
    if folders and out is not None and out.resolve() in run.lone.source.resolve().parents and run.lone.source.is_dir():
        raise InputError(f"expected another folder to write than the one that is read, found {out} for both; name one with --out")
    if options.floaters == "remove" and run.cameras is not None and run.cameras.kind == AROUND:
        raise InputError("expected photographs' cameras for --floaters remove, found a scene without any; give its capture with --data")


def _export_scene(work: ExportTask, out: Path | None) -> Written:
    """Write the run's scene as it is, in a format of its own family."""
    run, format, traits = work.run, work.format, work.run.scene.traits
    family = family_named(format.family)
    if traits.family != format.family or family is None:
        own = formats_of(traits.family) if family_named(traits.family) is not None else {}
        raise InputError(
            f"expected a scene of {format.family} for --format {work.name}, found {traits.rows} (a run of '{run.config.train.recipe}'); "
            f"use --format {next(iter(own), 'ply')}"
        )
    expect_unused(work.options, work.name)
    trained = world_of(run)
    if format.is_folder:
        return _export_folder(work, family, trained, out or run.path)
    path = place_of(run, work.name, format, out)
    (contents, world), fitted, note = _contents_of(run, format), [], {}
    if format.fit is not None or format.view_note is not None:
        with capture_if_there(run, needed=False) as capture:
            if format.fit is not None:
                contents, fitted = format.fit(run, contents, trained, work.options, capture, work.rasterize, work.tell)
            note = _view_note(work, capture, world)
    detail = format.write(path, contents, note)  # type: ignore[misc]
    forget_description(path)
    rows, size = len(run.scene.positions), path.stat().st_size if format.size is None else format.size(path)
    said = f"{rows:,} {traits.rows}, {size / 1e6:.2f} MB with networks"
    said += "" if detail is None else f"{', ' if format.size is None else ': '}{detail}"
    written = Written(path, size, rows, (f"wrote {path}", said, *fitted), work.name)
    if not work.options.measure or format.read is None:
        return written
    with capture_if_there(run, needed=False) as capture:
        found = cost(run, lambda: {"file": family.scene(run, format.read(path), world)}, capture, work.rasterize, work.tell)  # type: ignore[misc]
    mend = OF_THE_PRECISION if format.fit is not None else OF_THE_FORMAT
    lines = [line.replace(OF_THE_FORMAT, mend) for line in found.lines]
    return replace(written, lines=(*written.lines, *lines), psnr=found.psnr)


def _export_drawn(work: ExportTask, out: Path | None) -> Written:
    """Write what the pictures of a run show."""
    run, format = work.run, work.format
    assert format.draw is not None and format.write is not None
    expect_drawn(work.options, work.name)
    path = place_of(run, work.name, format, out)
    check_writable(path)
    if format.needs is not None:
        format.needs()
    with capture_if_there(run, needed=True) as capture:
        contents, note = format.draw(run, capture, work.options, work.rasterize, work.tell)
    format.write(path, contents, note)
    size, said = path.stat().st_size, str(contents)
    write_json(path.with_name(path.name + ".json"), {"format": NOTE_FORMAT, "recipe": run.config.train.recipe, "step": run.step, **note})
    said = f"{said}, {size / 1e6:.2f} MB, in the capture's own frame"
    said += f", {tell_origin(note['origin'])}" if "origin" in note else ""
    return Written(path, size, len(contents), (f"wrote {path}", said), work.name)


def _view_note(work: ExportTask, capture: Capture | None, world: World) -> Note:
    """The entries of a note about the views of a run's scene, and its title."""
    if work.format.view_note is None:
        return {}
    run = work.run
    views = capture or place_cameras(run.path, run.scene.positions.detach().cpu().double(), world, background=run.config.data.background)
    note = work.format.view_note(views, world)
    if views.kind == AROUND:
        note.pop("cameras", None)  # nothing was photographed from there
    if work.format.look is not None and (views.kind != AROUND or work.options.photographs):
        note |= work.format.look(run, views, world, work.options, work.rasterize)
    return note | ({} if work.options.title is None else {"title": work.options.title})


def _export_folder(work: ExportTask, family: Family, world: World, out: Path) -> Written:
    run = work.run
    cameras = run.path / "cameras.json"
    if out != run.path and not is_result(out) and (out / cameras.name).exists():
        raise InputError(f"expected no {cameras.name} in {out}, which is no result folder, found one; name another folder with --out")
    folder = write_scene_folder(run, family, world, out, width_in(cameras) if cameras.is_file() else None)
    if out != run.path and cameras.is_file():
        write_bytes(out / "cameras.json", cameras.read_bytes())
    size, rows = sum(p.stat().st_size for p in folder.iterdir()), len(run.scene.positions)
    said = f"{rows:,} {run.scene.traits.rows}, {size / 1e6:.2f} MB with networks, in the capture's own frame"
    origin = origin_of(run, world)
    said += f", {tell_origin(origin)}" if any(origin) else ""
    return Written(folder, size, rows, (f"wrote {folder}", said, *family.warnings(run)), work.name)


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
