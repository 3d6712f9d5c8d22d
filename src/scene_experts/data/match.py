"""Finds the photographs that the files of a capture name. Files are matched by name,
never by sorted position."""

from __future__ import annotations

import os
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from scene_experts.core.errors import InputError

EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")


@dataclass(frozen=True)
class Match:
    """Files by name, the names without a file, and warnings about inexact matches."""

    found: dict[str, Path]
    absent: tuple[str, ...]
    warnings: tuple[str, ...]


def to_relative_name(name: str) -> str:
    """Turn `name` into a path that stays inside any folder: "/" between its parts, without root,
    drive, "." or "..".

    Results are written under the names of views, and a capture may name "../photos/a.png" or an
    absolute path of another machine.
    """
    parts = name.replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..") and not part.endswith(":"))


def match_images(folder: Path, names: Sequence[str]) -> Match:
    """Find the file in `folder` for each of `names` (relative, "/" between folders).

    The exact path is tried first, then the path with slashes for backslashes (Windows) and under
    Unicode's composed form (macOS unpacks names decomposed), then the only file with the same stem
    and another extension, then the only file anywhere in `folder` with that base name. The last two
    require that no other name shares the stem or base name. `warnings` reports every match that is
    not exact.
    """
    there = list_pictures(folder)
    exact = set(there)
    by_name, by_stem, by_base = defaultdict(list), defaultdict(list), defaultdict(list)
    for file in there:
        name = _compose(file)
        stem = _stem(name)
        by_name[name].append(file)
        by_stem[stem].append(file)
        by_base[stem.rpartition("/")[2]].append(file)
    stems, bases = defaultdict(int), defaultdict(int)
    for stem in map(_stem, map(_compose, names)):
        stems[stem] += 1
        bases[stem.rpartition("/")[2]] += 1
    found, absent, other, moved = {}, [], [], []
    for name in names:
        composed = _compose(name)
        stem = _stem(composed)
        base = stem.rpartition("/")[2]
        same_stem, same_base = by_stem[stem], by_base[base]
        if name in exact or (folder / name).is_file():
            found[name] = folder / name
        elif len(by_name[composed]) == 1:
            found[name] = folder / by_name[composed][0]
        elif len(same_stem) == 1 and stems[stem] == 1:
            found[name] = folder / same_stem[0]
            other.append(f"{name} -> {same_stem[0].rpartition('/')[2]}")
        elif not same_stem and len(same_base) == 1 and bases[base] == 1:
            found[name] = folder / same_base[0]
            moved.append(f"{name} -> {same_base[0]}")
        else:
            absent.append(name)
    notes = []
    if other:
        notes.append(f"{len(other)} images have another extension than named (first: {other[0]})")
    if moved:
        notes.append(f"{len(moved)} images are in another folder than named (first: {moved[0]})")
    return Match(found, tuple(absent), tuple(notes))


def list_pictures(folder: Path, deep: bool = True) -> list[str]:
    """Return the paths of the pictures in `folder`, and if `deep` in its subfolders, relative to it
    with "/" between folders, sorted; empty if there is no such folder. Symbolic links are
    followed."""
    top, out, seen = str(folder), [], set()
    for place, folders, files in os.walk(top, followlinks=deep):
        if folders or seen:  # links may lead back
            real = os.path.realpath(place)
            if real in seen:
                folders.clear()
                continue
            seen.add(real)
        inner = place[len(top) :].replace(os.sep, "/").strip("/")
        out += [f"{inner}/{name}" if inner else name for name in files if is_picture(name)]
        if not deep:
            folders.clear()
    return sorted(out)


def is_picture(name: str) -> bool:
    """Return whether a file is a picture by its name."""
    return name[name.rfind(".") :].lower() in EXTENSIONS


def _stem(name: str) -> str:
    """Return a relative path without its last extension."""
    dot = name.rfind(".")
    return name[:dot] if dot > name.rfind("/") + 1 else name


class NameIndex:
    """Finds names of photographs as people and other programs write them."""

    def __init__(self, names: Iterable[str]) -> None:
        self._exact: dict[str, str] = {}
        self._keys: dict[str, set[str]] = defaultdict(set)
        self._folders: dict[str, tuple[str, ...]] = {}  # below the folder that all are in
        for name in names:
            pure = PurePosixPath(_plain(name))
            self._folders[name] = pure.parent.parts
            self._exact[str(pure)] = name
            for key in {str(pure), str(pure.with_suffix("")), pure.name, pure.stem}:
                self._keys[key].add(name)
        first, last = (min(self._folders.values()), max(self._folders.values())) if self._folders else ((), ())
        common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(first, last)))  # between them lie all others
        self._folders = {name: parts[common:] for name, parts in self._folders.items()}

    def find(self, written: str) -> set[str]:
        """Return the names that `written` may stand for: by path, by the end of one with another or
        no extension, or by a base name. Folders may differ above those in which the names differ.

        The set has one name if `written` is unambiguous, and none if it is unknown.
        """
        pure = PurePosixPath(_plain(written))
        if str(pure) in self._exact:
            return {self._exact[str(pure)]}
        bare = pure.with_suffix("") if pure.suffix.lower() in EXTENSIONS else pure
        tries = [str(each) for path in (pure, bare) for each in (path, PurePosixPath(*path.parts[1:]), path.name)]
        groups = [group for key in tries if (group := self._alike(self._keys.get(key, set()), pure.parent.parts))]
        return next((group for group in groups if len(group) == 1), groups[0] if groups else set())

    def _alike(self, names: set[str], folders: tuple[str, ...]) -> set[str]:
        """Return the names whose folders end as these do. Without any: all, if one has no folder that
        contradicts them, else none."""
        if not folders:
            return names
        ends = {name: self._folders[name][-len(folders) :] for name in names}
        alike = {name for name, end in ends.items() if end and end == folders[-len(end) :]}
        return alike or (names if any(not self._folders[name] for name in names) else set())


def _plain(name: str) -> str:
    return _compose(name.strip().replace("\\", "/").removeprefix("./"))


def find_file(root: Path, name: str) -> Path | None:
    """Return the file `name` in `root`, or None. A name beyond ASCII may be written in another form
    of Unicode on the disk."""
    if (root / name).is_file():
        return root / name
    if name.isascii():
        return None
    folder = (root / name).parent
    for part in PurePosixPath(name).parent.parts if not folder.is_dir() else ():
        root = next((p for p in _list(root) if _compose(p.name) == _compose(part)), root / part)
    folder = folder if folder.is_dir() else root
    wanted = _compose(PurePosixPath(name).name)
    return next((p for p in _list(folder) if _compose(p.name) == wanted and p.is_file()), None)


def _list(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _compose(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/"))


def absent_error(folder: Path, names: Sequence[str], absent: Sequence[str]) -> InputError:
    """Return the error for images that are absent."""
    return InputError(
        f"expected {len(names)} images in {folder}, but {len(absent)} are absent (first: {absent[0]}); copy them there, name their folder "
        f"with --images, or train without them with --missing drop (--leave-out NAME leaves out photographs that are there)"
    )
