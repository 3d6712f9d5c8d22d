"""Recipes with flags, for comparisons: "moe-gs --scene.hidden 8", or with a name for the tables,
"narrow=moe-gs --scene.hidden 8"."""

from __future__ import annotations

import functools
import shlex
from dataclasses import dataclass, fields, replace
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.parse import Command, HelpAsked, parse
from scene_experts.core.errors import InputError, nearest
from scene_experts.core.fields import flag_of
from scene_experts.data.fetch.catalog import Numbers
from scene_experts.data.settings import Data
from scene_experts.training.config import Train, with_numbers
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES

SET_HERE = ("--iterations", "--seed")
"""Flags that `reproduce` sets itself."""
OF_ALL_ROWS = frozenset(flag_of(f.name) for kind in (Data, TrainOptions) for f in fields(kind))
"""Other flags of `train` that no recipe has."""


@dataclass(frozen=True)
class _Holder:
    cfg: Annotated[Train, Option(name="")]


def split_name(text: str) -> tuple[str, str]:
    """Split "NAME=RECIPE FLAGS" into the name and the line "RECIPE FLAGS". Without a name, the name
    is the line."""
    name, found, line = text.partition("=")
    return (name.strip(), line.strip()) if found and name.strip() and "--" not in name else (text.strip(), text.strip())


def base(line: str) -> str:
    """Return the recipe of a line."""
    return line.split(maxsplit=1)[0]


def flags(line: str) -> list[str]:
    """Return the flags of a line as words. Raises InputError if its quotes do not match."""
    try:
        return shlex.split(line)[1:]
    except ValueError as error:
        raise InputError(f"expected a recipe and its flags, found {line!r} ({error}); close the quotes") from None


@functools.cache
def read_line(line: str, numbers: Numbers = ()) -> Train:
    """Return the settings of a recipe with flags; their recipe is the whole line. Raises InputError
    for unknown recipes and flags.

    numbers: Settings of a scene's protocol; flags have the last word.
    """
    words = line.split(maxsplit=1)
    if not words or words[0] not in RECIPES:
        name = words[0] if words else ""
        raise InputError(f"expected --recipes among {', '.join(RECIPES)}, found '{name}'{nearest(name, RECIPES)}; change it")
    cfg = with_numbers(RECIPES[words[0]][1], numbers)
    given = flags(line)
    if not given:
        return cfg
    if mine := next((word for word in given if word.partition("=")[0] in SET_HERE), None):
        raise InputError(f"expected flags of the recipe in --recipes, found {mine} in {line!r}; give it to `reproduce` instead")
    if other := next((word for word in given if word.partition("=")[0] in OF_ALL_ROWS), None):
        raise InputError(
            f"expected flags of the recipe in --recipes, found {other} in {line!r}, an option of the capture or of the run, which all rows "
            "share; leave it out, or train such runs with `scene-experts train` and set them beside each other with `scene-experts compare`"
        )
    try:
        return replace(parse(_Holder, Command(f"scene-experts train {words[0]}", defaults={"cfg": cfg}), given).cfg, recipe=line)
    except HelpAsked:
        raise InputError(
            f"expected flags of the recipe in --recipes, found {line!r}; `scene-experts train {words[0]} --help-all` lists them"
        ) from None
