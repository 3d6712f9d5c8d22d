"""Recipes by name: those of this package and those of other packages, which are imported on first
use."""

from __future__ import annotations

import logging
import sysconfig
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from scene_experts.training.config import Train

GROUP = "scene_experts.recipes"
Recipe = tuple[str, Train]
"""A one-sentence description of the recipe, and its value."""

log: logging.Logger = logging.getLogger(__name__)


class RecipeBook(Mapping[str, Recipe]):
    """Recipes by name. Other packages add recipes with entry points of the group
    `scene_experts.recipes` in their pyproject.toml:

        [project.entry-points."scene_experts.recipes"]
        my-method = "my_package.recipes:my_method"

    The object is a `Train` value, a pair of a description and a `Train` value, or a dictionary of
    these by name. Packages that cannot be loaded are skipped with one warning.
    """

    broken: dict[str, str]
    """What is wrong with the recipes that could not be loaded, by name."""

    def __init__(self, own: Mapping[str, Recipe]) -> None:
        """Create the book.

        Args:
            own: Recipes that are available without imports.
        """
        self._own = own
        self.broken = {}
        self._others: dict[str, Recipe] | None = None

    def load(self) -> dict[str, Recipe]:
        """Return the recipes of other packages. The first call imports these packages, which also
        registers their parts."""
        if self._others is None:
            self._others = {}
            for entry in entry_points(group=GROUP):
                try:
                    found = read_entry(entry)
                    if taken := [name for name in found if name in self._own or name in self._others]:
                        raise ValueError(f"there already is a recipe {taken[0]!r}")
                    self._others |= found
                except Exception as error:  # an error in another package must not affect our own recipes
                    self.broken[entry.name] = f"{error} ({locate(error)})"
                    where = f"{entry.name!r} ({entry.value})"
                    why = self.broken[entry.name]
                    log.warning("cannot use the recipe %s of another package: %s; correct, update or uninstall that package", where, why)
        return self._others

    def __getitem__(self, name: str) -> Recipe:
        return self._own[name] if name in self._own else self.load()[name]

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self.load()

    def __len__(self) -> int:
        return len(self._own) + len(self.load())


def locate(error: BaseException) -> str:
    """Return the file and line where an error was raised, "my_package.py:12"; of several, the
    innermost outside this package and Python."""
    places = traceback.extract_tb(error.__traceback__)
    skip = (str(Path(__file__).parents[1]), sysconfig.get_paths()["stdlib"], "<")
    theirs = [place for place in places if not place.filename.startswith(skip)] or list(places)
    return f"{Path(theirs[-1].filename).name}:{theirs[-1].lineno}" if theirs else type(error).__name__


def read_entry(entry: EntryPoint) -> dict[str, Recipe]:
    """Return the recipes of an entry point. Raises TypeError for an object of another type. Errors
    of the import are passed on."""
    value = entry.load()
    recipes = value if isinstance(value, Mapping) else {entry.name: value}
    out: dict[str, Recipe] = {}
    for name, recipe in recipes.items():
        text, cfg = recipe if isinstance(recipe, tuple) and len(recipe) == 2 else (f"from {entry.value.partition(':')[0]}", recipe)
        if not isinstance(cfg, Train):
            raise TypeError(f"expected a Train value for {name!r}, found {cfg!r}")
        out[name] = (str(text), replace(cfg, recipe=name))
    return out
