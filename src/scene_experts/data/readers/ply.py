"""Reads point clouds from PLY files: positions and colours, in the three encodings of the
format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import POINTS
from scene_experts.core.reading.numbers import expect_range, usable_rows
from scene_experts.core.reading.source import opening
from scene_experts.core.reading.vertices import read_header, read_table


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return xyz [P, 3] float64 and rgb [P, 3] uint8 of the vertices in `path`. Without colours,
    rgb is 128 (grey).

    Colours are 0 to 255, floats in [0, 1], or 0 to 65535 of 16 bits; the largest value of the file
    tells which.

    Raises InputError if the file is not a PLY file whose first element is `vertex` without list
    properties, is truncated, or has colours that are not finite. Points without a usable position
    are dropped with a warning.
    """
    with opening(path, POINTS) as source:
        header = read_header(source)
        table = read_table(source, header)
        names = [name for name, _ in header.fields]
        columns = {name: table[:, i] if header.ascii else table[name] for i, name in enumerate(names)}
        xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
        kept = usable_rows(xyz, path)
        if not all(name in columns for name in ("red", "green", "blue")):
            return xyz[kept], np.full((int(kept.sum()), 3), 128, np.uint8)
        rgb = np.stack([columns[name] for name in ("red", "green", "blue")], 1)
        expect_range(rgb, "colours")
        kind, most = np.dtype(dict(header.fields)["red"]), rgb.max(initial=0)
        if kind.kind == "f" and most <= 1:  # some tools write colours in [0, 1]
            rgb = rgb * 255
        elif kind.kind == "u" and kind.itemsize == 2 and most > 255:  # others with 16 bits
            rgb = rgb / 257
        return xyz[kept], np.clip(np.rint(rgb), 0, 255).astype(np.uint8)[kept]
