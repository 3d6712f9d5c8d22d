"""Reads point clouds from PLY files: positions and colours, in the three encodings of the
format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import POINTS
from scene_experts.core.reading.numbers import expect_range, usable_rows
from scene_experts.core.reading.source import opening
from scene_experts.core.reading.vertices import read_header, read_table
from scene_experts.data.readers.colours import to_bytes

_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


def count_points(path: Path) -> int | None:
    """Return how many points a PLY file declares, or None if it cannot be read."""
    try:
        with opening(path, POINTS) as source:
            return read_header(source).count
    except InputError:
        return None


def read_points(path: Path, notes: list[str] | None = None) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return xyz [P, 3] float64 and rgb [P, 3] uint8 of the vertices in `path`. Without colours,
    rgb is 128 (grey), and `notes` gets a sentence.

    Colours are 0 to 255, floats in [0, 1], or 0 to 65535 of 16 bits; the values of the file tell
    which.

    Raises InputError if the file is not a PLY file whose first element is `vertex` without list
    properties, is truncated, or has colours that are not finite. Points without a usable position
    are dropped with a warning.
    """
    notes = [] if notes is None else notes
    with opening(path, POINTS) as source:
        header = read_header(source)
        table = read_table(source, header)
        names = [name.lower() for name, _ in header.fields]
        columns = {name: table[:, i] if header.ascii else table[header.fields[i][0]] for i, name in enumerate(names)}
        xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
        kept = usable_rows(xyz, path)
        found = next((three for three in _COLOURS if all(name in columns for name in three)), None)
        if found is None:
            notes.append(f"{path.name} has no colours: its points start grey")
            return xyz[kept], np.full((int(kept.sum()), 3), 128, np.uint8)
        rgb = np.stack([columns[name] for name in found], 1)[kept]
        expect_range(rgb, "colours")
        kind, most = np.dtype(header.fields[names.index(found[0])][1]), rgb.max(initial=0)
        if kind.kind == "f":
            rgb, said = to_bytes(np.clip(rgb.astype(np.float64), 0, 255), path)
            notes += said if "mixed" in "".join(said) else []  # fractions are usual in PLY files
        elif kind.kind == "u" and kind.itemsize == 2 and most > 255:  # others with 16 bits
            rgb = rgb / 257
        return xyz[kept], np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
