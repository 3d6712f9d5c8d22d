"""Finds photographs that are copies of others: a copy adds nothing to the poses, and would be held
out beside its original."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from pathlib import Path

from scene_experts.core.errors import InputError, few
from scene_experts.sfm.photos import FEWEST, Photo


def find_copies(folder: Path, photos: Sequence[Photo]) -> dict[str, str]:
    """Return the names of photographs in `folder` whose bytes equal those of one with a shorter name,
    or of an earlier one, with the name of that one. Photographs with different masks are no
    copies."""
    firsts: dict[object, list[Photo]] = {}
    copies = {}
    for photo in sorted(photos, key=lambda photo: len(photo.name)):  # 1.jpg before 1 (copy).jpg
        alike = firsts.setdefault((photo.stamp[0], photo.mask), [])
        original = next((one for one in alike if filecmp.cmp(folder / one.name, folder / photo.name, shallow=False)), None)
        if original is None:
            alike.append(photo)
        else:
            copies[photo.name] = original.name
    return copies


def leave_copies_out(folder: Path, photos: Sequence[Photo]) -> tuple[list[Photo], str]:
    """Return the photographs that are no copies of others, and a sentence about the copies, ""
    for none.

    Raises InputError if too few are left.
    """
    copies = find_copies(folder, photos)
    kept = [photo for photo in photos if photo.name not in copies]
    told = few([f"{name} (of {original})" for name, original in copies.items()], 3)
    if copies and len(kept) < FEWEST:
        raise InputError(f"expected at least {FEWEST} different photographs in {folder}, found {len(kept)} and copies: {told}; take more")
    how = "photograph is a copy of another" if len(copies) == 1 else "photographs are copies of others"
    return kept, f"{len(copies)} {how} and left out: {told}" if copies else ""
