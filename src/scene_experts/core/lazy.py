"""A mapping that is computed when somebody looks into it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TypeVar

V = TypeVar("V")


class LazyMapping(Mapping[str, V]):
    """The mapping that a function returns. It is called once, at the first look."""

    def __init__(self, find: Callable[[], Mapping[str, V]]) -> None:
        self._find: Callable[[], Mapping[str, V]] | None = find
        self._found: Mapping[str, V] = {}

    def _look(self) -> Mapping[str, V]:
        if self._find is not None:
            self._found, self._find = self._find(), None
        return self._found

    def __getitem__(self, name: str) -> V:
        return self._look()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._look())

    def __len__(self) -> int:
        return len(self._look())
