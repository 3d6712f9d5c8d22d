"""Reads point clouds from PLY files: positions and colours, in the three encodings of the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return xyz [P, 3] float64 and rgb [P, 3] uint8 of the vertices in `path`. Without colours, rgb is 128 (grey).

    Raises InputError if the file is not a PLY file whose first element is `vertex` without list properties, or is truncated.
    """
    data = path.read_bytes()
    end = data.find(b"end_header")
    start = data.find(b"\n", end) + 1
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    elements = [line for line in lines if line[:1] == ["element"]]
    if not data.startswith(b"ply") or start == 0 or not elements or elements[0][1:2] != ["vertex"]:
        raise InputError(f"expected a PLY file with vertices at {path}, found something else; replace it or start with --init random")
    try:
        kind = next(line[1] for line in lines if line[:1] == ["format"])
        count = int(elements[0][2])
        first = lines.index(elements[0])
        last = lines.index(elements[1]) if len(elements) > 1 else len(lines)
        fields = [(line[2], _TYPES[line[1]]) for line in lines[first:last] if line[:1] == ["property"]]
        if kind == "ascii":
            rows = np.array([line.split() for line in data[start:].decode("ascii").splitlines()[:count]], dtype=np.float64)
            rows = rows if len(rows) else rows.reshape(0, len(fields))
            columns = {name: rows[:, i] for i, (name, _) in enumerate(fields)}
            if len(rows) != count:
                raise ValueError
        else:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}[kind]
            table = np.frombuffer(data, np.dtype([(name, order + code) for name, code in fields]), count, start)
            columns = {name: table[name] for name, _ in fields}
        xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
    except (StopIteration, ValueError, KeyError, IndexError):
        raise InputError(f"expected a complete PLY file of points at {path}, found a damaged one; copy it again") from None
    if not all(name in columns for name in ("red", "green", "blue")):
        return xyz, np.full((count, 3), 128, np.uint8)
    rgb = np.stack([columns[name] for name in ("red", "green", "blue")], 1)
    if rgb.dtype.kind == "f" and kind != "ascii":  # some tools write colours in [0, 1]
        rgb = rgb * 255
    return xyz, np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
