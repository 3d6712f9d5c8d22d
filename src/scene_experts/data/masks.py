"""Finds the masks of photographs, decides how their values are meant, and reads them.

A mask says which pixels count. Programs write it under many names, and with white, 1 or a label
where a pixel counts. Loading and structure from motion both use this module.
"""

from __future__ import annotations

import os
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops

from scene_experts.core.reading.budget import MASK
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.match import is_picture, list_pictures

FOLDERS = ("masks", "mask")
ENDINGS = (".mask", "_mask", "-mask")  # between the name of the photograph, with or without extension, and that of the mask
INVERTED = "dynamic_mask_"  # such masks are white where pixels do not count
PREFIXES = (INVERTED, "mask_")
SAMPLED = 6  # masks whose values decide how those of a capture are read
WHITE = 250  # a value from here on means that a pixel counts fully
FEWEST_LEVELS = 8  # a picture with at most so many values is one of labels if none of them is white
TINY = 0.05  # a smaller mean weight gets a warning


@dataclass(frozen=True)
class Mask:
    """The file of a mask and the meaning of its values."""

    path: Path
    inverted: bool = False  # a pixel that counts is black
    labels: bool = False  # a pixel counts if its value is not 0; otherwise its brightness is its weight


@dataclass(frozen=True)
class Found:
    """Masks by the name of their photograph, and what a user should know about them."""

    masks: dict[str, Mask] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    files: frozenset[Path] = frozenset()  # every file that is a mask or lies in a folder of masks


def find_masks(
    photographs: Mapping[str, Path], folders: Iterable[Path], maybe: Iterable[Path] = (), stated: Mapping[str, Path] | None = None
) -> Found:
    """Find the masks of photographs and decide how they are read.

    A mask lies in masks/ or mask/ in one of `folders` or in a folder of photographs, or beside its
    photograph. Its name there is NAME.png, or the name with or without extension between mask_ or
    dynamic_mask_ (which is white where pixels do not count) and .mask, _mask or -mask; in a folder
    of masks, also NAME or the name without extension. Every extension of photographs will do.
    Files in subfolders belong to photographs in the same subfolders, or to the only photograph of
    that name.

    Args:
        photographs: Files by name (relative, "/" between folders).
        maybe: Folders whose masks/ and mask/ may belong to something else.
        stated: Masks that the files of the capture name, which come first.

    Raises:
        InputError: if a mask that is looked at cannot be read.
    """
    index = _Index(photographs)
    found: dict[str, Mask] = {name: Mask(path) for name, path in (stated or {}).items()}
    said = set(found)
    taken, strange, twice = set[Path](), defaultdict[Path, list[str]](list), list[str]()
    own = set(map(str, photographs.values()))
    sure = {folder / name for folder in (*folders, *index.near) for name in FOLDERS}
    places = [place for place in sorted({*sure, *(folder / name for folder in maybe for name in FOLDERS)}) if place.is_dir()]
    lists = [(place, True, _without(own, place, list_pictures(place))) for place in places]
    lists += [(place, False, _without(own, place, list_pictures(place, deep=False))) for place in index.beside(places)]
    for place, only_masks, files in lists:
        for file, names, inverted in sorted(
            ((file, *index.owners(place, file, only_masks)) for file in files), key=lambda one: (not one[1], one[2], len(one[0]))
        ):
            if names:
                path = place / file
                taken.add(path)
                for name in names:
                    if name in found and name not in said:
                        twice.append(f"{_short(found[name].path)} is used, not {_short(path)}")
                    elif name not in found:
                        found[name] = Mask(path, inverted)
            elif only_masks and place in sure:
                strange[place].append(file)
    strange = {place: left for place, names in strange.items() if (left := index.without_others(place, names))}
    warnings = [_tell_strange(place, names, next(iter(photographs), "NAME.jpg")) for place, names in strange.items()]
    if twice:
        warnings.append(f"{len(twice)} photographs have two masks (first: {twice[0]}); remove one of them")
    if found and len(found) < len(photographs):
        whole = [name for name in photographs if name not in found]
        warnings.append(f"{len(whole)} of {len(photographs)} photographs have no mask and count fully (first: {whole[0]})")
    masks, notes = decide(found)
    used = [place for place in places if any(path.is_relative_to(place) for path in taken)]
    inside = {path for place, only_masks, files in lists if only_masks and place in used for path in (place / file for file in files)}
    return Found(masks, (*warnings, *notes), frozenset(taken | inside))


def _tell_strange(place: Path, names: Sequence[str], photograph: str) -> str:
    return (
        f"{place.name}/ holds {len(names)} files that match no photograph (first: {names[0]}); call the mask of {photograph} "
        f"{place.name}/{photograph}.png"
    )


def _short(path: Path) -> str:
    return f"{path.parent.name}/{path.name}"


def _without(own: set[str], place: Path, files: list[str]) -> list[str]:
    """Return the `files` in `place` that are not photographs."""
    top = f"{place}{os.sep}"
    return [file for file in files if top + file.replace("/", os.sep) not in own]


class _Index:
    """Photographs by the ends of their paths, with and without extension."""

    def __init__(self, photographs: Mapping[str, Path]) -> None:
        self.files = photographs
        self.tails: dict[str, list[tuple[int, str]]] = defaultdict(list)  # dropped folders and name of the photograph, by end
        self.stems: dict[str, list[tuple[int, str]]] = defaultdict(list)
        self.near: dict[Path, dict[str, str]] = defaultdict(dict)  # names by name of file, by folder
        self.near_stems: dict[Path, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
        for name, path in photographs.items():
            parts = _key(name).split("/")
            for dropped in range(len(parts)):
                tail = "/".join(parts[dropped:])
                self.tails[tail].append((dropped, name))
                self.stems[_stem(tail)].append((dropped, name))
            self.near[path.parent][_key(path.name)] = name
            self.near_stems[path.parent][_stem(_key(path.name))].append(name)

    def beside(self, places: Sequence[Path]) -> list[Path]:
        """The folders of the photographs that are no folders of masks."""
        return [folder for folder in self.near if folder.is_dir() and not any(folder.is_relative_to(place) for place in places)]

    def without_others(self, place: Path, names: Sequence[str]) -> list[str]:
        """Return those of the masks `names` in `place` that belong to no picture at all, such as a
        photograph without a pose."""
        index = _Index({(folder / name).as_posix(): folder / name for folder in self.near for name in list_pictures(folder, deep=False)})
        return [name for name in names if not index.owners(place, name, True)[0]]

    def owners(self, place: Path, file: str, only_masks: bool) -> tuple[list[str], bool]:
        """Return the names of the photographs that the picture `file` in `place` is a mask of, and
        whether it is inverted."""
        key = _key(file)
        tries = [(key, False), *_readings(key)] if only_masks else [one for one in _readings(key) if one[0] != _stem(key)]
        if not only_masks and key.lower().endswith(".png") and _stem(key) in self.near[place]:
            return [self.near[place][_stem(key)]], False  # NAME.png, as COLMAP calls it
        folder = place.parent if only_masks else place
        here, stems = self.near.get(folder, {}), self.near_stems.get(folder, {})
        for name, inverted in tries:
            names = [here[name]] if name in here else stems.get(name, [])
            if not names and only_masks:
                names = self._anywhere(name) or (self._anywhere(name.partition("/")[2], name) if "/" in name else [])
            if names:
                return names, inverted
        return [], False

    def _anywhere(self, name: str, end: str = "") -> list[str]:
        """Return the photographs of this relative path, or of the end of their own, whose files lie
        at a path that ends in `end`."""
        names = _nearest(self.tails.get(name, ())) or _nearest(self.stems.get(name, ()))
        return [one for one in names if not end or _key(self.files[one].as_posix()).rpartition(".")[0].endswith(f"/{_stem(end)}")]


def may_be_mask(name: str) -> bool:
    """Return whether the picture of this relative path may be a mask by its name."""
    key = _key(name)
    words = _readings(key)[1:] or (key.lower().endswith(".png") and _stem(_stem(key)) != _stem(key))
    return bool(words) or any(part in FOLDERS for part in key.split("/")[:-1])


def _readings(key: str) -> list[tuple[str, bool]]:
    """Return what a mask's path may say about the path of its photograph, and whether it is
    inverted: the path without extension, and without the words that make it a mask."""
    folder, slash, name = _stem(key).rpartition("/")
    out, lower = [(name, False)], name.lower()
    if "mask" not in lower:
        return [(folder + slash + name, False)]
    for prefix in ("", *PREFIXES):
        for ending in ("", *ENDINGS):
            if (prefix or ending) and lower.startswith(prefix) and lower.endswith(ending) and len(name) > len(prefix + ending):
                out.append((name[len(prefix) : len(name) - len(ending)], prefix == INVERTED))
    return [(folder + slash + rest, inverted) for rest, inverted in out]


def _nearest(owners: Sequence[tuple[int, str]]) -> list[str]:
    """Return the photographs with the fewest dropped folders, if they lie in one folder."""
    if not owners:
        return []
    least = min(dropped for dropped, _ in owners)
    names = [name for dropped, name in owners if dropped == least]
    return names if len({name.rpartition("/")[0] for name in names}) == 1 else []


def _key(name: str) -> str:
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def _stem(name: str) -> str:
    """Return a path without the extension of a picture."""
    return name[: name.rfind(".")] if is_picture(name) else name


def decide(masks: Mapping[str, Mask]) -> tuple[dict[str, Mask], list[str]]:
    """Return the masks with the meaning of their values, and what a user should know about it.

    One rule holds for all masks of a capture: where none of a sample of them has a white pixel and
    all are dark or have few values, every value but 0 counts, as in COLMAP. Otherwise the
    brightness is the weight.
    """
    names = sorted(masks)
    step = max(1, -(-len(names) // SAMPLED))
    counts = np.zeros(256, np.int64)
    levels = []
    for name in names[::step]:
        with opening_picture(masks[name].path, MASK) as image:
            one = np.asarray(to_levels(image).histogram(), np.int64)
        counts += one
        levels.append(int((one > 0).sum()))
    inverted = any(mask.inverted for mask in masks.values())
    if not counts[1:].any():
        black = [f"the masks are black: no pixel counts (first: {masks[names[0]].path.name})"] if names and not inverted else []
        return dict(masks), black
    most = int(counts.nonzero()[0].max())
    labels = most < 128 or (most < WHITE and max(levels) <= FEWEST_LEVELS)
    out = {name: replace(mask, labels=labels) for name, mask in masks.items()}
    weights = (np.arange(256) > 0) if labels else np.arange(256) / 255
    mean, dark = float((counts * weights).sum() / counts.sum()), float(counts[1:128].sum() / counts[1:].sum())
    mean = 1 - mean if inverted else mean
    notes = []
    if labels:
        notes.append("the masks have no white pixel: every value but 0 counts; to weigh pixels, write 255 where they count fully")
    elif most < WHITE:
        notes.append(
            f"the masks have no white pixel: their brightness is the weight, at most {most / 255:.2f}; write 255 where pixels count fully"
        )
    elif dark > 0.5:
        notes.append(f"{dark:.0%} of the pixels in the masks that are not black count less than half: brightness is weight, 255 is 1")
    if mean < TINY:
        notes.append(f"the masks let only {mean:.1%} of the pixels count: white counts, black does not")
    return out, notes


def read_mask(mask: Mask) -> Image.Image:
    """Read a mask as L (255 = counts) at its own size, with its own EXIF data. Raises InputError if
    it cannot be read."""
    with opening_picture(mask.path, MASK) as image:
        exif = image.getexif()
        out = to_levels(image)
    if mask.labels:
        out = out.point(_whiten)
    out = ImageChops.invert(out) if mask.inverted else out
    out.getexif()[0x0112] = exif.get(0x0112, 1)
    return out


def _whiten(value: int) -> int:
    return 255 if value else 0


def to_levels(image: Image.Image) -> Image.Image:
    """Convert a mask's picture to L without turning a value above 0 into 0.

    Alpha is used where every colour is black. A palette that is not grey is one of labels: 255
    where the label is not 0. 16-bit values above 255 are divided by 257, and floats up to 1 are
    multiplied by 255.
    """
    if image.mode == "P" and "transparency" not in image.info:
        colours = np.asarray(image.convert("RGB"))
        grey = bool((colours == colours[..., :1]).all()) and bool(colours.any())
        return image.convert("L") if grey else Image.fromarray(np.where(np.asarray(image) > 0, np.uint8(255), np.uint8(0)))
    if image.mode in ("PA", "LA", "La", "RGBa") or image.mode == "P":
        image = image.convert("RGBA")
    if image.mode == "RGBA":
        colours = image.convert("L")
        return image.getchannel("A") if colours.getextrema() == (0, 0) else colours
    if image.mode.startswith("I") or image.mode == "F":
        return Image.fromarray(_to_bytes(np.asarray(image)))
    return _brightest(image) if image.mode == "RGB" else image.convert("L")


def _brightest(image: Image.Image) -> Image.Image:
    """Return the brightness of a colour picture, at least 1 where it is not black."""
    grey = image.convert("L")
    anything = ImageChops.lighter(ImageChops.lighter(image.getchannel(0), image.getchannel(1)), image.getchannel(2))
    return ImageChops.lighter(grey, anything.point(lambda value: 1 if value else 0))


def _to_bytes(values: NDArray[np.generic]) -> NDArray[np.uint8]:
    deep = np.nan_to_num(values.astype(np.float32), posinf=65535.0)
    most = float(deep.max())
    scale = 255.0 if values.dtype.kind == "f" and most <= 1 else 1.0 if most <= 255 else 1 / 257
    return np.where(deep > 0, np.clip(np.rint(deep * scale), 1, 255), 0).astype(np.uint8)
