"""Finds the lists of training and test photographs that programs write beside a reconstruction."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scene_experts.core.reading.budget import LIST
from scene_experts.core.reading.plain import decode_text
from scene_experts.core.reading.source import opening
from scene_experts.data.match import NameIndex
from scene_experts.data.readers.reader import RawCapture

_TEST = ("test.txt", "test_list.txt")
_TRAIN = ("train.txt", "train_list.txt")


def apply_lists(root: Path, raw: RawCapture) -> RawCapture:
    """Return the capture with the split of test.txt, test_list.txt, train.txt and train_list.txt in
    the folder of the reconstruction, else in `root`.

    A list of test photographs holds those out. With a list of training photographs as well, those
    in neither are left out; alone, it holds out all others. A split that the capture's own files
    state is kept. What was decided, and names of no photograph, are told in the warnings.
    """
    folders = [folder for folder in dict.fromkeys((raw.model, root)) if folder is not None]
    test, train = (_find(folders, names) for names in (_TEST, _TRAIN))
    first = test or train
    if first is None:
        return raw
    if raw.states_split or any(image.test for image in raw.images):
        note = f"{first.name} is not used, because the capture's own file of poses states the split; choose another with --split"
        return replace(raw, warnings=[*raw.warnings, note])
    warnings: list[str] = []
    names = [image.name for image in raw.images]
    held = _read(test, names, warnings) if test else None
    kept = _read(train, names, warnings) if train else None
    if not held and (test or not kept):
        warnings.append(f"{first.name} names no photograph of the capture and is not used; choose the held-out ones with --split")
        return replace(raw, warnings=[*raw.warnings, *warnings])
    if held is None and kept is not None:
        held = set(names) - kept
    held = held or set()
    if kept and (both := held & kept):
        warnings.append(f"{len(both)} photographs are in both lists and are held out (first: {min(both)})")
    images = [replace(image, test=image.name in held) for image in raw.images if kept is None or image.name in held | kept]
    files = " and ".join(os.path.relpath(path, root).replace(os.sep, "/") for path in (test, train) if path)
    note = f"split as in {files}: holds out {len(held)} of {len(names)} photographs; choose others with --split"
    if len(images) < len(names):
        note += f"; {len(names) - len(images)} in neither list are left out"
    return replace(raw, images=images, states_split=True, warnings=[*raw.warnings, *warnings, note])


def _find(folders: Sequence[Path], names: Sequence[str]) -> Path | None:
    return next((folder / name for folder in folders for name in names if (folder / name).is_file()), None)


def _read(path: Path, names: Sequence[str], warnings: list[str]) -> set[str]:
    """Return the photographs that the lines of a list name, see `NameIndex.find`."""
    index = NameIndex(names)
    with opening(path, LIST) as source:
        lines = [line.strip() for line in decode_text(source.read()).splitlines()]
        lines = [line for line in lines if line and not line.startswith("#")]
        source.spend_items(len(lines))
    out: set[str] = set()
    unknown: list[str] = []
    for line in lines:
        found = index.find(line)
        out |= found if len(found) == 1 else set()
        unknown += [] if len(found) == 1 else [line]
    if unknown:
        warnings.append(f"{len(unknown)} of {len(lines)} names in {path.name} are of no photograph (first: {unknown[0]})")
    return out
