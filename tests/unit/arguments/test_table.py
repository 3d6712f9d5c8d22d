"""The options of a dataclass, and the value that given options make."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from typing import Annotated

from scene_experts.arguments.option import Option
from scene_experts.arguments.table import make, rows


@dataclass(frozen=True)
class Big:
    size: int = 9
    fast: bool = True


@dataclass(frozen=True)
class Small:
    edge: float = 0.5


@dataclass(frozen=True)
class Near:
    folder: Annotated[str, Option(name="data", short="-s")]
    max_views: int | None = None


@dataclass(frozen=True)
class Whole:
    near: Annotated[Near, Option(name="")]
    part: Big | Small = Small()
    extra: Big | None = None
    secret: Annotated[int, Option(hidden=True)] = 3
    made: int = field(default=0, init=False)


def test_names_defaults_and_places():
    table = {row.flag: row for row in rows(Whole, {})}
    assert list(table) == ["--data", "--max-views", "--part.edge"]  # an optional part that is absent has no options
    assert table["--data"].required and table["--data"].default is MISSING and table["--data"].names == ("--data", "-s")
    assert table["--part.edge"].place == ("part", "edge") and table["--part.edge"].default == 0.5 and table["--part.edge"].owner is Small


def test_the_default_decides_which_of_several_classes_gives_the_options():
    table = {row.flag: row for row in rows(Whole, {"part": Big(7), "near.max_views": 4, "extra": Big()})}
    assert table["--part.size"].default == 7 and table["--max-views"].default == 4 and "--extra.size" in table
    assert table["--part.fast"].negative == "--part.no-fast" and table["--data"].negative == ""


def test_given_values_make_the_value_and_the_rest_is_the_default():
    made = make(Whole, {("near", "folder"): "x", ("part", "size"): 2}, {"part": Big(7, False)})
    assert made == Whole(Near("x"), Big(2, False))
    part = Big(7)
    assert make(Whole, {("near", "folder"): "x"}, {"part": part}).part == part
