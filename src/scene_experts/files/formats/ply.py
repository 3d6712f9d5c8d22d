"""3DGS's PLY, exact; every viewer of Gaussians reads it.

Also the parts that other formats use: tables of vertices, and the note in a header. A file of this
family stores one float32 row per vertex in binary_little_endian, scales as logarithms and opacity
as a logit. 3DGS writes f_rest channel by channel. The layouts of anchors and graph points use the
same tables.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format

Columns = dict[str, NDArray[np.generic]]

HEADER_LIMIT = 1 << 20
NOTE_MARK = "scene-experts"
_NOTE_LIMIT = 1 << 16  # other readers hold header lines in small buffers
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}


# --- vertex tables ------------------------------------------------------------------------------------------------------------------------


def read_vertices(path: Path) -> Columns:
    """The scalar properties of the element `vertex`, by name, each [N] in the type of the file;
    ascii and both binary byte orders.

    Raises InputError for a file that is missing, no PLY, cut short, does not begin with vertices,
    or has list properties or unknown types.
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
            raise ValueError("its format, vertices or properties are missing or named twice")
    except KeyError as error:
        raise InputError(f"expected known PLY types in {path}, found {error}; write it again in binary_little_endian") from None
    except ValueError as error:
        raise InputError(f"expected a PLY file of points at {path}, found another header ({error}); write it again") from None
    return order, count, fields


def _read_ascii(path: Path, start: int, count: int, row: np.dtype[np.void]) -> NDArray[np.void]:
    lines = path.read_bytes()[start:].split(b"\n")[:count]
    try:
        values = np.array([line.split() for line in lines if line.strip()], dtype=np.float64).reshape(-1, len(row.names or ()))
    except ValueError:
        raise InputError(f"expected {len(row.names or ())} numbers per line in {path}, found another line; copy it again") from None
    if len(values) != count:
        raise InputError(f"expected {count:,} vertices in {path}, found {len(values):,}: the file was cut short; copy it again")
    table = np.empty(count, row)
    for i, name in enumerate(row.names or ()):
        table[name] = values[:, i]
    return table


def write_vertices(path: Path, columns: Mapping[str, NDArray[np.generic]], comments: Sequence[str] = ()) -> None:
    """Write columns [N] as the element `vertex` in binary_little_endian, atomically. Raises
    RunError when the disk is full.

    comments: ASCII lines for the header, which readers skip.
    """
    codes = {name: value.dtype.newbyteorder("<").str[1:] for name, value in columns.items()}
    table = np.empty(len(next(iter(columns.values()))), np.dtype([(name, "<" + code) for name, code in codes.items()]))
    for name, value in columns.items():
        table[name] = value
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments), f"element vertex {len(table)}"]
    lines += [f"property {_NAMES[code]} {name}" for name, code in codes.items()] + ["end_header", ""]

    def write_table(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            stream.write("\n".join(lines).encode())
            stream.write(table.data)

    write_atomic(path, write_table)


def floats(value: Tensor) -> list[NDArray[np.float32]]:
    """The columns of a tensor [N, C]."""
    return list(value.detach().cpu().float().numpy().T)


def numbered_columns(prefix: str, value: Tensor) -> Columns:
    """The columns of a tensor [N, C] as prefix0, prefix1, ..."""
    return {f"{prefix}{i}": column for i, column in enumerate(floats(value))}


def numbered_names(columns: Columns, prefix: str) -> list[str]:
    """The columns called prefix + number, sorted by number."""
    return sorted((name for name in columns if re.fullmatch(re.escape(prefix) + r"\d+", name)), key=lambda name: int(name[len(prefix) :]))


def stack(columns: Columns, names: list[str], path: Path) -> Tensor:
    """The named columns as one tensor [N, C] float32. Raises InputError naming the missing ones."""
    absent = [name for name in names if name not in columns]
    if absent or not names:
        raise InputError(f"expected the columns {', '.join(absent) or 'of a scene'} in {path}, found none; write the file again")
    out = np.empty((len(columns[names[0]]), len(names)), np.float32)
    for i, name in enumerate(names):
        out[:, i] = columns[name]
    return torch.from_numpy(out)


# --- the note in a header -----------------------------------------------------------------------------------------------------------------


def note_comments(note: Mapping[str, Any]) -> list[str]:
    """The comment lines of a note on how a file was made: "scene-experts {...}" in JSON and ASCII,
    or none for an empty note.

    The longest entries are left out until the line has at most 64 KiB.
    """
    kept = dict(note)
    text = json.dumps(kept, allow_nan=False, default=str)
    while len(text) > _NOTE_LIMIT:
        del kept[max(kept, key=lambda name: len(json.dumps(kept[name], default=str)))]
        text = json.dumps(kept, allow_nan=False, default=str)
    return [f"{NOTE_MARK} {text}"] if kept else []


def read_note(path: Path) -> dict[str, Any]:
    """The note in the header of a PLY file; empty where there is none or it cannot be read."""
    start = f"comment {NOTE_MARK} ".encode()
    for line in header(Path(path)).splitlines():
        if line.startswith(start):
            try:
                found = json.loads(line[len(start) :])
            except ValueError:
                return {}
            return found if isinstance(found, dict) else {}
    return {}


def header(path: Path) -> bytes:
    """The header of a PLY file, without its end."""
    with path.open("rb") as stream:
        return stream.read(HEADER_LIMIT).split(b"\nend_header", 1)[0]


def property_names(path: Path) -> set[str]:
    """The names of all properties in the header of a PLY file; empty for other files."""
    head = header(path) if path.is_file() else b""
    names = re.findall(rb"^property\s+\S+\s+(\S+)", head, re.M) if head.startswith(b"ply") else []
    return {name.decode("ascii", "replace") for name in names}


# --- Gaussians ----------------------------------------------------------------------------------------------------------------------------


def write(path: Path, splats: Splats, note: Mapping[str, Any], normals: bool = True) -> None:
    """Write 3DGS's file, exact in float32 (248 bytes per Gaussian for degree 3); the note becomes a
    comment in the header."""
    n = len(splats)
    columns: Columns = dict(zip("xyz", floats(splats.means)))
    if normals:
        columns |= {name: np.zeros(n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= numbered_columns("f_dc_", splats.sh[:, 0])
    columns |= numbered_columns("f_rest_", splats.sh[:, 1:].transpose(1, 2).flatten(1))
    columns["opacity"] = floats(splats.opacity_logit[:, None])[0]
    columns |= numbered_columns("scale_", splats.log_scales) | numbered_columns("rot_", splats.quats)
    write_vertices(path, columns, note_comments(note))


def read(path: Path) -> Splats:
    """The Gaussians of 3DGS's file. Raises InputError for other or damaged files, and for anchors,
    whose networks are elsewhere."""
    columns = read_vertices(path)
    if "f_offset_0" in columns:
        raise InputError(
            f"expected Gaussians in {path}, found anchors without their networks; give the result folder with point_cloud/iteration_N"
        )
    if "f_dc_0" not in columns:
        raise InputError(f"expected Gaussians of 3DGS (f_dc_*) in {path}, found {', '.join(list(columns)[:8])}; give another file")
    rest_names = numbered_names(columns, "f_rest_")
    if len(rest_names) not in (0, 9, 24, 45):
        raise InputError(f"expected 0, 9, 24 or 45 f_rest columns in {path}, found {len(rest_names)}; write the file again")
    dc = stack(columns, ["f_dc_0", "f_dc_1", "f_dc_2"], path)[:, None]
    rest = stack(columns, rest_names, path) if rest_names else dc.new_zeros(len(dc), 0)
    return Splats(
        means=stack(columns, ["x", "y", "z"], path),
        sh=torch.cat([dc, rest.reshape(len(dc), 3, len(rest_names) // 3).transpose(1, 2)], dim=1),
        opacity_logit=stack(columns, ["opacity"], path)[:, 0],
        log_scales=stack(columns, [f"scale_{i}" for i in range(3)], path),
        quats=stack(columns, [f"rot_{i}" for i in range(4)], path),
    )


FORMAT = Format(
    suffix=".ply",
    write=write,
    read=read,
    marks=(b"ply",),
    looks_like=lambda path, head: b"\nelement chunk " not in header(path),
)
