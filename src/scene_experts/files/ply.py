"""PLY files of anchors (Scaffold-GS, Octree-GS) and of Gaussians (3DGS), on a small reader and writer of vertex tables.

Both families store one float32 row per vertex in binary_little_endian, scales as logarithms and opacity as a logit. Scaffold-GS writes
offsets component by component: f_offset_{c * K + k} is component c of offset k.  3DGS writes f_rest channel by channel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic

Columns = dict[str, NDArray[np.generic]]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
HEADER_LIMIT = 1 << 20
MOST_LEVELS = 64  # of detail
ANCHOR_OPACITY = math.log(0.1 / 0.9)  # logit(0.1): Scaffold-GS stores it and never uses it


# --- vertex tables ------------------------------------------------------------------------------------------------------------------------


def read_vertices(path: Path) -> Columns:
    """The scalar properties of the PLY element `vertex`, by name, each [N] in the type of the file; ascii and both binary orders.

    Raises InputError: absent, not a PLY, no vertices first, list properties, an unknown type, or cut short.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a PLY file at {path}, found none; check the path")
    with path.open("rb") as stream:
        head = stream.read(HEADER_LIMIT)
    match = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or match is None:
        raise InputError(f"expected a PLY file at {path}, found something else; replace it")
    order, count, fields = _parse_header(head[: match.start()].decode("ascii", "replace"), path)
    row = np.dtype([(name, order + code) for name, code in fields])
    if b"\nformat ascii" in head[: match.start()]:
        table = _read_ascii(path, match.end(), count, row)
    else:
        room = (path.stat().st_size - match.end()) // max(row.itemsize, 1)
        if room < count:
            raise InputError(f"expected {count:,} vertices in {path}, found {room:,}: the file was cut short; copy it again")
        table = np.fromfile(path, row, count, offset=match.end())
    return {name: table[name] for name, _ in fields}


def _parse_header(text: str, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Byte order, number of vertices, and (name, type) of their properties."""
    order, count, fields, element = "", -1, [], ""
    try:
        for words in (line.split() for line in text.splitlines()):
            match words:
                case ["format", kind, *_]:
                    order = _ORDERS[kind]
                case ["element", name, number]:
                    if not element and name != "vertex":
                        raise ValueError("its first element is not 'vertex'")
                    element = name
                    count = int(number) if name == "vertex" else count
                case ["property", "list", *_] if element == "vertex":
                    raise ValueError("its vertices have lists")
                case ["property", kind, name] if element == "vertex":
                    fields.append((name, _TYPES[kind]))
        if not order or count < 0 or not fields or len({name for name, _ in fields}) != len(fields):
            raise ValueError("format, vertices or properties are missing or named twice")
    except KeyError as error:
        raise InputError(f"expected known PLY types in {path}, found {error}; write it again in binary_little_endian") from None
    except ValueError as error:
        raise InputError(f"expected a PLY file of points at {path}, found a header that does not fit ({error}); write it again") from None
    return order, count, fields


def _read_ascii(path: Path, start: int, count: int, row: np.dtype[np.void]) -> NDArray[np.void]:
    lines = path.read_bytes()[start:].split(b"\n")[:count]
    try:
        values = np.array([line.split() for line in lines if line.strip()], dtype=np.float64).reshape(-1, len(row.names or ()))
    except ValueError:
        raise InputError(f"expected {len(row.names or ())} numbers a line in {path}, found another line; copy it again") from None
    if len(values) != count:
        raise InputError(f"expected {count:,} vertices in {path}, found {len(values):,}: the file was cut short; copy it again")
    table = np.empty(count, row)
    for i, name in enumerate(row.names or ()):
        table[name] = values[:, i]
    return table


def write_vertices(path: Path, columns: Mapping[str, NDArray[np.generic]], comments: Sequence[str] = ()) -> None:
    """Write columns [N] as the element `vertex` in binary_little_endian, atomically. Raises RunError when the disk is full.

    comments: lines of ASCII for the header, which readers skip.
    """
    codes = {name: value.dtype.newbyteorder("<").str[1:] for name, value in columns.items()}
    table = np.empty(len(next(iter(columns.values()))), np.dtype([(name, "<" + code) for name, code in codes.items()]))
    for name, value in columns.items():
        table[name] = value
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments), f"element vertex {len(table)}"]
    lines += [f"property {_NAMES[code]} {name}" for name, code in codes.items()] + ["end_header", ""]

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            stream.write("\n".join(lines).encode())
            stream.write(table.data)

    write_atomic(path, write)


# --- anchors ------------------------------------------------------------------------------------------------------------------------------


def write_anchor_ply(
    path: Path, xyz: Tensor, offsets: Tensor, feature: Tensor, log_scaling: Tensor, levels: dict[str, Tensor] | None = None
) -> None:
    """Write anchors in Scaffold-GS's layout: 79 float32 (316 bytes) an anchor for K = 10, F = 32.

    xyz [N, 3], offsets [N, K, 3], feature [N, F], log_scaling [N, 6]. Normals are 0, the inert opacity logit(0.1), rotation the identity.
    levels: level, extra_level and info [N] take the place of the normals, as in Octree-GS's layout.
    """
    n = len(xyz)
    zero, one = np.zeros(n, np.float32), np.ones(n, np.float32)
    columns: Columns = dict(zip("xyz", _floats(xyz)))
    columns |= {k: _floats(v[:, None])[0] for k, v in levels.items()} if levels else dict.fromkeys(("nx", "ny", "nz"), zero)
    columns |= _numbered("f_offset_", offsets.transpose(1, 2).flatten(1))
    columns |= _numbered("f_anchor_feat_", feature)
    columns["opacity"] = np.full(n, ANCHOR_OPACITY, np.float32)
    columns |= _numbered("scale_", log_scaling)
    columns |= {"rot_0": one, "rot_1": zero, "rot_2": zero, "rot_3": zero}
    write_vertices(path, columns)


def read_anchor_ply(path: Path) -> dict[str, Tensor]:
    """Anchors of a Scaffold-GS or Octree-GS file: xyz [N, 3], offsets [N, K, 3], feature [N, F], log_scaling [N, 6], opacity [N],
    rotation [N, 4], all float32; from Octree-GS also level [N] int64, extra_level [N] and info [N].

    Raises InputError for files without such columns, and for values that are not finite.
    """
    columns = read_vertices(path)
    if "f_offset_0" not in columns:
        what = "Gaussians of 3DGS" if "f_dc_0" in columns else f"only {', '.join(list(columns)[:8])}"
        raise InputError(f"expected anchors (x, f_offset_*, f_anchor_feat_*, scale_*) in {path}, found {what}; give a Scaffold-GS result")
    out = {"xyz": _stack(columns, ["x", "y", "z"], path)}
    flat = _stack(columns, _names(columns, "f_offset_"), path)
    if flat.shape[1] % 3:
        raise InputError(f"expected three f_offset columns per Gaussian in {path}, found {flat.shape[1]} in all; write the file again")
    out["offsets"] = flat.reshape(len(flat), 3, flat.shape[1] // 3).transpose(1, 2).contiguous()
    out["feature"] = _stack(columns, _names(columns, "f_anchor_feat_"), path)
    out["log_scaling"] = _stack(columns, [f"scale_{i}" for i in range(6)], path)
    out["opacity"] = _stack(columns, ["opacity"], path)[:, 0]
    out["rotation"] = _stack(columns, [f"rot_{i}" for i in range(4)], path)
    if "level" in columns:
        out |= {name: _stack(columns, [name], path)[:, 0] for name in ("level", "extra_level", "info") if name in columns}
        levels = [out[name] for name in ("level", "extra_level", "info") if name in out]
        if not all(value.isfinite().all() for value in levels) or not ((levels[0] >= 0) & (levels[0] <= MOST_LEVELS)).all():
            raise InputError(f"expected finite levels between 0 and {MOST_LEVELS} in {path}, found others; export the result again")
        out["level"] = out["level"].round().long()
    for name in ("xyz", "offsets", "feature", "log_scaling"):
        bad = int((~out[name].isfinite()).flatten(1).any(1).sum())
        if bad:
            raise InputError(f"expected finite {name} in {path}, found {bad:,} anchors with others; export the result again")
    return out


# --- Gaussians ----------------------------------------------------------------------------------------------------------------------------


def write_gaussian_ply(
    path: Path,
    means: Tensor,
    sh: Tensor,
    opacity_logit: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    normals: bool = True,
    comments: Sequence[str] = (),
) -> None:
    """Write Gaussians in 3DGS's layout (248 bytes for degree 3), which standard viewers read; comments are lines for the header.

    means [N, 3], sh [N, (degree + 1)^2, 3] (coefficient, channel), opacity_logit [N], log_scales [N, 3], quats [N, 4] (w, x, y, z).
    """
    n = len(means)
    columns: Columns = dict(zip("xyz", _floats(means)))
    if normals:
        columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= _numbered("f_dc_", sh[:, 0])
    columns |= _numbered("f_rest_", sh[:, 1:].transpose(1, 2).flatten(1))
    columns["opacity"] = _floats(opacity_logit[:, None])[0]
    columns |= _numbered("scale_", log_scales) | _numbered("rot_", quats)
    write_vertices(path, columns, comments)


def read_gaussian_ply(path: Path) -> dict[str, Tensor]:
    """Gaussians of a 3DGS file: means [N, 3], sh [N, C, 3] with C in 1, 4, 9, 16, opacity_logit [N], log_scales [N, 3], quats [N, 4]."""
    columns = read_vertices(path)
    if "f_dc_0" not in columns:
        raise InputError(f"expected Gaussians of 3DGS (f_dc_*) in {path}, found {', '.join(list(columns)[:8])}; give another file")
    rest_names = _names(columns, "f_rest_")
    if len(rest_names) not in (0, 9, 24, 45):
        raise InputError(f"expected 0, 9, 24 or 45 f_rest columns in {path}, found {len(rest_names)}; write the file again")
    dc = _stack(columns, ["f_dc_0", "f_dc_1", "f_dc_2"], path)[:, None]
    rest = _stack(columns, rest_names, path) if rest_names else dc.new_zeros(len(dc), 0)
    return {
        "means": _stack(columns, ["x", "y", "z"], path),
        "sh": torch.cat([dc, rest.reshape(len(dc), 3, len(rest_names) // 3).transpose(1, 2)], dim=1),
        "opacity_logit": _stack(columns, ["opacity"], path)[:, 0],
        "log_scales": _stack(columns, [f"scale_{i}" for i in range(3)], path),
        "quats": _stack(columns, [f"rot_{i}" for i in range(4)], path),
    }


# --- columns and tensors ------------------------------------------------------------------------------------------------------------------


def _floats(value: Tensor) -> list[NDArray[np.float32]]:
    """The columns of a tensor [N, C]."""
    return list(value.detach().cpu().float().numpy().T)


def _numbered(prefix: str, value: Tensor) -> Columns:
    return {f"{prefix}{i}": column for i, column in enumerate(_floats(value))}


def _names(columns: Columns, prefix: str) -> list[str]:
    """The columns called prefix + number, by number whatever their order in the file."""
    return sorted((name for name in columns if re.fullmatch(re.escape(prefix) + r"\d+", name)), key=lambda name: int(name[len(prefix) :]))


def _stack(columns: Columns, names: list[str], path: Path) -> Tensor:
    """[N, C] float32. Raises InputError naming the columns that are absent."""
    absent = [name for name in names if name not in columns]
    if absent or not names:
        raise InputError(f"expected the columns {', '.join(absent) or 'of an anchor file'} in {path}, found none; write the file again")
    out = np.empty((len(columns[names[0]]), len(names)), np.float32)
    for i, name in enumerate(names):
        out[:, i] = columns[name]
    return torch.from_numpy(out)
