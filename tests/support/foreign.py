"""Files as other programs write them, made without the package from the values of 3DGS's PLY."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

C0 = 0.28209479177387814


def gaussians(n: int = 300, degree: int = 0, seed: int = 0) -> dict[str, np.ndarray]:
    """Values like those of a trained scene: means, log_scales, quats (unit, w first), logits, sh [N, C, 3]."""
    g = np.random.default_rng(seed)
    quats = g.normal(size=(n, 4))
    return {
        "means": g.normal(size=(n, 3)).astype(np.float32),
        "log_scales": g.uniform(-6, -2, (n, 3)).astype(np.float32),
        "quats": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        "logits": g.uniform(-4, 4, n).astype(np.float32),
        "sh": np.concatenate([g.uniform(-1.5, 1.5, (n, 1, 3)), g.uniform(-0.9, 0.9, (n, (degree + 1) ** 2 - 1, 3))], 1).astype(np.float32),
    }


def ply(path: Path, columns: dict[str, np.ndarray], form: str = "binary_little_endian") -> None:
    """Columns [N] of a PLY file, each in its own type."""
    kinds = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "i4": "int"}
    lines = ["ply", f"format {form} 1.0", f"element vertex {len(next(iter(columns.values())))}"]
    lines += [f"property {kinds[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    head = "\n".join([*lines, "end_header", ""]).encode()
    if form == "ascii":
        rows = zip(*(values.tolist() for values in columns.values()))
        path.write_bytes(head + "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode())
        return
    order = ">" if form == "binary_big_endian" else "<"
    table = np.empty(len(next(iter(columns.values()))), [(name, values.dtype.newbyteorder(order)) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    path.write_bytes(head + table.tobytes())


def ply_columns(s: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of 3DGS's PLY."""
    out = {axis: s["means"][:, i] for i, axis in enumerate("xyz")} | {f"f_dc_{i}": s["sh"][:, 0, i] for i in range(3)}
    rest = s["sh"][:, 1:].transpose(0, 2, 1).reshape(len(s["means"]), -1)
    out |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])} | {"opacity": s["logits"]}
    return out | {f"scale_{i}": s["log_scales"][:, i] for i in range(3)} | {f"rot_{i}": s["quats"][:, i] for i in range(4)}


def _smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the largest component, and the others in order, [0, 1] for -sqrt(1/2) to sqrt(1/2)."""
    largest = np.abs(quats).argmax(1)
    rest = np.array([np.delete(q if q[i] >= 0 else -q, i) for q, i in zip(quats, largest)])
    return largest, rest * np.sqrt(0.5) + 0.5


def compressed_ply_before_2(path: Path, s: dict[str, np.ndarray]) -> None:
    """SuperSplat 1's compressed PLY: ranges of position and log scale only, colours and opacity as bytes."""
    n = len(s["means"])
    ranges, words = [], np.zeros((n, 4), np.uint32)
    for name, column, (bx, by, bz) in (("means", 0, (11, 10, 11)), ("log_scales", 2, (11, 10, 11))):
        values = s[name].astype(np.float64)
        for start in range(0, n, 256):
            part = values[start : start + 256]
            low, high = part.min(0), part.max(0)
            t = (part - low) / np.where(high > low, high - low, 1)
            x, y, z = (np.rint(t[:, i] * ((1 << b) - 1)).astype(np.uint32) for i, b in enumerate((bx, by, bz)))
            words[start : start + 256, column] = x << 21 | y << 11 | z
            ranges.append((name, start, low, high))
    largest, rest = _smallest_three(s["quats"].astype(np.float64))
    a, b, c = (np.rint(rest[:, i] * 1023).astype(np.uint32) for i in range(3))
    words[:, 1] = largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c
    color = np.concatenate([s["sh"][:, 0] * C0 + 0.5, 1 / (1 + np.exp(-s["logits"][:, None]))], 1)
    r, g, b, a = (np.clip(np.rint(color[:, i] * 255), 0, 255).astype(np.uint32) for i in range(4))
    words[:, 3] = r << 24 | g << 16 | b << 8 | a
    chunks = [start for name, start, *_ in ranges if name == "means"]
    table = [np.concatenate([v for name, at, low, high in ranges if at == start for v in (low, high)]) for start in chunks]
    names = [f"{end}_{prefix}{axis}" for prefix in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}", *(f"property float {name}" for name in names)]
    lines += [f"element vertex {n}", *(f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color"))]
    rest = s["sh"][:, 1:].transpose(0, 2, 1).reshape(n, -1)
    if rest.shape[1]:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    head = "\n".join([*lines, "end_header", ""]).encode()
    harmonics = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    path.write_bytes(head + np.array(table, "<f4").tobytes() + words.astype("<u4").tobytes() + harmonics.tobytes())


def picture(rows: np.ndarray, width: int, kind: str = "WEBP") -> bytes:
    """Rows [N, C] of bytes in a picture, line by line."""
    height = -(-len(rows) // width)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(rows), : rows.shape[1]] = rows
    stream = io.BytesIO()
    Image.fromarray(pixels.reshape(height, width, 4)).save(stream, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return stream.getvalue()


def sogs_1(s: dict[str, np.ndarray], kind: str = "WEBP", bits: int = 8) -> dict[str, bytes]:
    """SOGS of the first version: even levels between the ends of each channel, opacity as a logit, harmonics by a palette that has
    one row per Gaussian."""
    n, end = len(s["means"]), kind.lower()
    width = int(np.ceil(np.sqrt(n)))
    files: dict[str, bytes] = {}

    def channels(name: str, values: np.ndarray, shape: list[int]) -> dict[str, Any]:
        low, high = values.min(0), values.max(0)
        files[f"{name}.{end}"] = picture(np.rint((values - low) / (high - low) * 255).astype(np.uint8), width, kind)
        return {"shape": shape, "dtype": "float32", "mins": low.tolist(), "maxs": high.tolist(), "files": [f"{name}.{end}"]}

    place = np.sign(s["means"]) * np.log1p(np.abs(s["means"].astype(np.float64)))
    low, high = place.min(0), place.max(0)
    level = np.rint((place - low) / (high - low) * 65535).astype(np.uint16)
    files[f"means_l.{end}"], files[f"means_u.{end}"] = (picture((level >> shift & 255).astype(np.uint8), width, kind) for shift in (0, 8))
    largest, rest = _smallest_three(s["quats"].astype(np.float64))
    packed = np.concatenate([np.rint(rest * 255), (252 + largest)[:, None]], 1).astype(np.uint8)
    files[f"quats.{end}"] = picture(packed, width, kind)
    names = [f"means_l.{end}", f"means_u.{end}"]
    meta: dict[str, Any] = {
        "means": {"shape": [n, 3], "dtype": "float32", "mins": low.tolist(), "maxs": high.tolist(), "files": names},
        "scales": channels("scales", s["log_scales"].astype(np.float64), [n, 3]),
        "quats": {"shape": [n, 4], "dtype": "uint8", "encoding": "quaternion_packed", "files": [f"quats.{end}"]},
        "sh0": channels("sh0", np.concatenate([s["sh"][:, 0], s["logits"][:, None]], 1).astype(np.float64), [n, 1, 4]),
    }
    coefficients = s["sh"].shape[1] - 1
    if coefficients:
        values = s["sh"][:, 1:].astype(np.float64)
        least, most = float(values.min()), float(values.max())
        rows = np.rint((values - least) / (most - least) * ((1 << bits) - 1)).astype(np.uint8)  # [N, C, 3], 64 rows to a line
        files[f"shN_centroids.{end}"] = picture(rows.reshape(-1, 3), 64 * coefficients, kind)
        index = np.arange(n)
        files[f"shN_labels.{end}"] = picture(np.stack([index & 255, index >> 8], 1).astype(np.uint8), width, kind)
        meta["shN"] = {"shape": [n, 3 * coefficients], "dtype": "float32", "mins": least, "maxs": most, "quantization": bits}
        meta["shN"]["files"] = [f"shN_centroids.{end}", f"shN_labels.{end}"]
    return {"meta.json": json.dumps(meta).encode()} | files


def zipped(files: dict[str, bytes], deflate: bool = False) -> bytes:
    """A zip archive of files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED if deflate else zipfile.ZIP_STORED)
    return stream.getvalue()


def folder(place: Path, files: dict[str, bytes]) -> Path:
    """Files in a folder."""
    place.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (place / name).write_bytes(data)
    return place


def ksplat(s: dict[str, np.ndarray], level: int, per: int = 32, edge: float = 8.0, sections: int = 1) -> bytes:
    """GaussianSplats3D's file: all but the last third of a section in full buckets, the others in buckets of 7 at most."""
    degree = int(np.sqrt(s["sh"].shape[1])) - 1
    low, high = -1.25, 1.25
    heads, bodies = b"", b""
    for part in np.array_split(np.arange(len(s["means"])), sections):
        n, full = len(part), 2 * len(part) // 3 // per
        lengths = [per] * full
        while sum(lengths) < n:
            lengths.append(min(7, n - sum(lengths)))
        ends = np.cumsum([0, *lengths])
        xyz = s["means"][part].astype(np.float64)
        centres = np.array([(xyz[a:b].min(0) + xyz[a:b].max(0)) / 2 for a, b in pairwise(ends)], np.float32)
        bucket = np.repeat(np.arange(len(lengths)), lengths)
        half = "<f4" if level == 0 else "<f2"
        bands = [s["sh"][part, d * d : (d + 1) ** 2].transpose(0, 2, 1).reshape(n, -1) for d in range(1, degree + 1)]
        harmonics = np.concatenate([np.zeros((n, 0)), *bands], 1)
        rgba = np.concatenate([s["sh"][part, 0] * C0 + 0.5, 1 / (1 + np.exp(-s["logits"][part, None]))], 1)
        packed = np.rint((xyz - centres[bucket]) / (edge / 2 / 32767) + 32767)
        columns = [
            xyz.astype("<f4") if level == 0 else packed.astype("<u2"),
            np.exp(s["log_scales"][part]).astype(half),
            s["quats"][part].astype(half),
            np.clip(np.rint(rgba * 255), 0, 255).astype(np.uint8),
            np.clip(np.rint((harmonics - low) / (high - low) * 255), 0, 255).astype(np.uint8) if level == 2 else harmonics.astype(half),
        ]
        rows = np.concatenate([np.ascontiguousarray(c).view(np.uint8).reshape(n, -1) for c in columns], 1).tobytes()
        if level:
            partial = np.array(lengths[full:], "<u4")
            body = partial.tobytes() + centres.astype("<f4").tobytes() + rows
            head = (n, n, per, len(lengths), edge, 12, 32767, len(body), full, len(partial), degree)
        else:
            body, head = rows, (n, n, 0, 0, 0.0, 0, 0, len(rows), 0, 0, degree)
        heads, bodies = heads + struct.pack("<4IfH2x4IH", *head).ljust(1024, b"\0"), bodies + body
    n = len(s["means"])
    return struct.pack("<BB2x4IH2x5f", 0, 1, sections, sections, n, n, level, 0, 0, 0, low, high).ljust(4096, b"\0") + heads + bodies


def gltf_of(scene: dict[str, Any], body: bytes, uri: str | None = None) -> bytes:
    """A text glTF with one buffer, at `uri`; a binary one without."""
    scene = scene | {"buffers": [{"byteLength": len(body)} | ({"uri": uri} if uri is not None else {})]}
    text = json.dumps(scene).encode()
    if uri is not None:
        return text
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def with_spz(count: int, size: int, extension: str) -> dict[str, Any]:
    """The JSON of a glTF whose Gaussians are an SPZ file of `size` bytes in buffer view 0."""
    entry = {extension: {"bufferView": 0}}
    inside = extension.startswith("KHR_gaussian_splatting_")
    extensions = {"KHR_gaussian_splatting": {"kernel": "ellipse", "extensions": entry}} if inside else entry
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": [extension],
        "extensionsRequired": [extension],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {"POSITION": 0}, "extensions": extensions}]}],
        "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": size}],
    }
