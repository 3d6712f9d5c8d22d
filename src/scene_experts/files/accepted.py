"""Which options an export accepts, and which values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING

from scene_experts.core.errors import InputError
from scene_experts.files.options import DEFAULT, MAX_DEGREE, Options
from scene_experts.files.registry import GAUSSIANS, Format, format_named

if TYPE_CHECKING:
    from scene_experts.files.standard import ExportTask

DRAWN_OPTIONS = ("measure", "crop", "cells")  # of formats that hold what pictures show
FITTED = ("quality", "target_mb")  # options of formats that choose a precision


def expect_fitted(formats: Sequence[tuple[str, Format]], options: Options) -> None:
    """Raises InputError for a precision that none of the formats, by name, has."""
    unused = [name for name in FITTED if getattr(options, name) != getattr(DEFAULT, name)]
    if unused and formats and not any(format.fit for _, format in formats):
        name, first = formats[0]
        instead = "; --max-gaussians, --prune and --sh-degree make this file smaller" if first.family == GAUSSIANS else ""
        raise InputError(f"expected {_flag(unused[0])} with --format compact or html, found --format {name}; leave it out{instead}")


def check_values(options: Options) -> None:
    """Raises InputError, naming the flag, for values out of range."""
    for name in ("sh_degree", "max_gaussians", "refine"):
        if (getattr(options, name) or 0) < 0:
            raise InputError(f"expected {_flag(name)} of at least 0, found {getattr(options, name)}; give a larger number")
    if options.sh_degree > MAX_DEGREE:
        raise InputError(f"expected --sh-degree of at most {MAX_DEGREE}, found {options.sh_degree}; give a lower degree")
    if options.crop:
        from scene_experts.files.select import parse_crop

        parse_crop(options.crop)
    if not 0 < options.quality < math.inf:
        raise InputError(f"expected --quality above 0 dB, found {options.quality}; 0.2 is usual")
    if not 0 <= options.target_mb < math.inf:
        raise InputError(f"expected --target-mb as megabytes, 0 for none, found {options.target_mb}; correct it")
    if options.target_mb and options.quality != DEFAULT.quality:
        raise InputError("expected --quality or --target-mb, found both; leave one out")
    if not 0 <= options.prune < 1:
        raise InputError(f"expected --prune as a share from 0 to below 1, found {options.prune}; correct it")


def expect_unused(options: Options, format: str) -> None:
    """Raises InputError for options of standard files with a format that is none, and for those of
    formats with a precision with another one."""
    for f in fields(options):
        if f.name == "measure" or getattr(options, f.name) == f.default or (f.name == "title" and format_named(format).view_note):
            continue
        if f.name == "photographs" and format_named(format).look is not None:
            continue
        if f.name in FITTED:
            if format_named(format).fit is None:
                raise InputError(f"expected {_flag(f.name)} with --format compact or html, found --format {format}; leave it out")
        else:
            which = "--format mesh" if f.name == "cells" else "a standard file (ply, spz, baked-html, ...)"
            raise InputError(f"expected {_flag(f.name)} with {which}, found --format {format}; leave it out")


def expect_used(works: Sequence[ExportTask]) -> None:
    """Raises InputError for an option of the exports that none of them has."""
    options, formats = works[0].options, [work.format for work in works]
    names = ", ".join(work.name for work in works)
    if options.cells != DEFAULT.cells and all(format.family == GAUSSIANS for format in formats):
        raise InputError(f"expected --cells with --format mesh, found --format {names}; leave it out")
    if options.title is not None and not any(format.view_note for format in formats):
        raise InputError(f"expected --title with --format html, found --format {names}; leave it out")
    standard = [work for work in works if work.format.family == GAUSSIANS]
    if options.refine and standard and all(work.is_direct for work in standard):
        rows = "the Gaussians are written as they are"
        raise InputError(f"expected --refine with a scene that is baked, found {rows} in --format {names}; leave it out, or train longer")


def expect_drawn(options: Options, format: str) -> None:
    """Raises InputError for options that a format of what pictures show does not have."""
    for f in fields(options):
        if f.name not in DRAWN_OPTIONS and getattr(options, f.name) != f.default:
            raise InputError(f"expected {_flag(f.name)} with another format, found --format {format}; leave it out")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
