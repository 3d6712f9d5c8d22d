"""PlayCanvas's SOG, the smallest.

Version 2 is a zip of lossless WebP pictures with one or two bytes per value, and a palette for the
harmonics. Positions are 16 bits of sign(x) ln(1 + |x|) within the range of each axis. Log scales
and colours are indices into 256 levels. Rotations are the smallest three components in a byte each.
Harmonics above the constant are one of at most 65,536 rows of indices into 256 levels. Gaussians
are sorted along the Morton curve and fill the pictures row by row.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.archives import Archive, open_zip, zip_names
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, expect_range, shown, whole_number
from scene_experts.core.reading.pictures import decode_picture
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import Source, opening
from scene_experts.files.formats.clusters import codebook, nearest_levels, palette
from scene_experts.files.formats.pack import (
    MAX_GAUSSIANS,
    Bytes,
    Floats,
    alphas,
    byte_logits,
    check_count,
    decoded_bytes,
    from_smallest_three,
    morton_order,
    smallest_three,
    tensor,
    to_bytes,
    unit_quats,
)
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format

PALETTE = 1 << 16
_COLUMNS = 64  # palette rows next to each other in a line of the picture
_COEFFICIENTS = (0, 3, 8, 15)
_META_LIMIT, _FILE_LIMIT = 1 << 20, 1 << 30
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a fixed date: equal scenes give equal bytes


def write(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the file; the note goes into the asset entry of meta.json, its entry `antialias` into
    that of the format."""
    write_bytes(path, sog_bytes(splats, note))


def sog_bytes(splats: Splats, note: dict[str, Any]) -> bytes:
    """The bytes of a file. Raises InputError without Gaussians: a picture cannot be empty."""
    if not len(splats):
        raise InputError("expected Gaussians to write as SOG, found none; choose another format or keep more of them")
    s = splats.rows(morton_order(splats.means))
    n = len(s)
    width = -(-int(np.ceil(np.sqrt(n))) // 4) * 4
    height = -(-n // (4 * width)) * 4
    files: dict[str, bytes] = {}

    def save(name: str, pixels: NDArray[Any]) -> str:
        files[name] = _webp(pixels, width, height)
        return name

    place = _squeeze(s.means.double().numpy())
    mins, maxs = place.min(0), place.max(0)
    level = np.rint((place - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(np.uint16)
    largest, rest = smallest_three(unit_quats(s))
    quats = np.concatenate([to_bytes(rest * np.sqrt(0.5) + 0.5), (252 + largest)[:, None]], 1)
    scales, dc = s.log_scales.double().numpy(), s.sh[:, 0].double().numpy()
    scale_book, color_book = codebook(scales), codebook(dc)
    colors = np.concatenate([nearest_levels(dc, color_book), to_bytes(alphas(s))[:, None]], 1)
    meta: dict[str, Any] = {
        "version": 2,
        "antialias": bool(note.get("antialias", False)),
        "asset": {"generator": "scene-experts", **({"scene-experts": note} if note else {})},
        "count": n,
        "means": {
            "mins": mins.tolist(),
            "maxs": maxs.tolist(),
            "files": [save("means_l.webp", level & 255), save("means_u.webp", level >> 8)],
        },
        "scales": {"codebook": scale_book.tolist(), "files": [save("scales.webp", nearest_levels(scales, scale_book))]},
        "quats": {"files": [save("quats.webp", quats)]},
        "sh0": {"codebook": color_book.tolist(), "files": [save("sh0.webp", colors)]},
    }
    if s.degree:
        meta["shN"], centroids, labels = _harmonics(s)
        save("shN_labels.webp", labels)
        files["shN_centroids.webp"] = centroids
    return _zip({"meta.json": json.dumps(meta, allow_nan=False, default=str).encode()} | files)


def read(path: Path) -> Splats:
    """The Gaussians of a file of version 2. Raises InputError for other or damaged files."""
    with opening(path, budget.SOG) as source, open_zip(source) as archive:
        return _decode(source, archive).checked(path)


def is_antialiased(path: Path) -> bool:
    """Whether a file says that it is drawn with antialiasing. Raises InputError for a damaged
    file."""
    with opening(path, budget.SOG) as source, open_zip(source) as archive:
        return parse_json(archive.read("meta.json", _META_LIMIT)).get("antialias") is True


def _decode(source: Source, archive: Archive) -> Splats:
    meta = parse_json(archive.read("meta.json", _META_LIMIT))
    n = whole_number(meta["count"], "the number of Gaussians", 1, MAX_GAUSSIANS)
    if meta["version"] != 2:
        raise Damaged(f"version {shown(meta['version'])}")
    bands = whole_number(meta["shN"]["bands"], "the bands of harmonics", 1, 3) if meta.get("shN") else 0
    check_count(source, n, decoded_bytes(bands))

    def pixels(part: str, i: int = 0) -> Bytes:
        picture = _picture(archive.read(meta[part]["files"][i], _FILE_LIMIT), 4 * n + 65536)
        source.check_time()
        if picture.shape[0] * picture.shape[1] < n:
            raise Damaged(f"a picture of {part} with too few pixels")
        return picture.reshape(-1, 4)[:n]

    book = lambda part: np.array(meta[part]["codebook"], np.float64).reshape(-1)  # noqa: E731
    mins, maxs = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    level = pixels("means", 0)[:, :3].astype(np.int64) + (pixels("means", 1)[:, :3].astype(np.int64) << 8)
    farthest = float(_squeeze(np.array(FARTHEST)))
    expect_range(np.stack([mins, maxs]), "ends of the positions", -farthest, farthest)
    means = _stretch(mins + (maxs - mins) * (level / 65535))
    rest, colors = pixels("quats"), pixels("sh0")
    if (rest[:, 3] < 252).any():
        raise Damaged("rotations of another kind")
    quats = from_smallest_three(rest[:, 3] - 252, (rest[:, :3] / 255 - 0.5) * np.sqrt(2))
    scales = book("scales")[pixels("scales")[:, :3]]
    sh = np.empty((n, (bands + 1) ** 2, 3), np.float32)  # in place: most of the memory of a file is here
    with np.errstate(over="ignore"):  # refused below
        sh[:, 0] = book("sh0")[colors[:, :3]]
        if bands:
            _read_harmonics(meta["shN"], pixels("shN", 1), archive, book("shN").astype(np.float32), sh[:, 1:])
    if not all(np.isfinite(part).all() for part in (means, scales, sh)):
        raise Damaged("values that are not finite")
    return Splats(tensor(means), tensor(scales), tensor(quats), tensor(byte_logits(colors[:, 3])), torch.from_numpy(sh))


def _harmonics(splats: Splats) -> tuple[dict[str, Any], bytes, NDArray[Any]]:
    """The entry of meta.json, the picture of the palette, and the palette row of each Gaussian in
    two bytes."""
    n, coefficients = len(splats), _COEFFICIENTS[splats.degree]
    size = min(PALETTE, max(1, int(1024 * 2.0 ** np.floor(np.log2(n / 1024)))))
    rows, label = palette(splats.sh[:, 1:].reshape(n, -1), size)
    book = codebook(rows.numpy())
    pixels = nearest_levels(rows.numpy(), book).reshape(-1, 3)
    lines = -(-len(rows) // _COLUMNS)
    index = label.numpy()
    meta = {
        "count": len(rows),
        "bands": splats.degree,
        "codebook": book.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    return meta, _webp(pixels, _COLUMNS * coefficients, lines), np.stack([index & 255, index >> 8, np.zeros_like(index)], 1)


def _read_harmonics(meta: dict[str, Any], labels: Bytes, archive: Archive, book: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Write the harmonics above the constant into `out` [N, C, 3]."""
    coefficients, count = _COEFFICIENTS[meta["bands"]], whole_number(meta["count"], "the rows of the palette", 1, PALETTE)
    picture = _picture(archive.read(meta["files"][0], _FILE_LIMIT), PALETTE * coefficients + 65536)
    rows = picture.shape[0] * _COLUMNS
    index = labels[:, 0].astype(np.int64) + (labels[:, 1].astype(np.int64) << 8)
    if picture.shape[1] != _COLUMNS * coefficients or count > rows or index.max() >= count:
        raise Damaged("a palette of another size")
    levels = picture.reshape(rows, coefficients, 4)
    for i in range(coefficients):
        out[:, i] = book[levels[:, i, :3][index]]


def _squeeze(x: Floats) -> Floats:
    return np.sign(x) * np.log1p(np.abs(x))


def _stretch(x: Floats) -> Floats:
    return np.sign(x) * np.expm1(np.abs(x))


def _webp(values: NDArray[Any], width: int, height: int) -> bytes:
    """Values [N, 3 or 4], row by row in a lossless picture; alpha is opaque for three channels and
    in pixels beyond N."""
    pixels = np.zeros((width * height, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    stream = io.BytesIO()
    Image.fromarray(pixels.reshape(height, width, 4), "RGBA").save(stream, "WEBP", lossless=True, exact=True, quality=75, method=4)
    return stream.getvalue()


def _picture(data: bytes, limit: int) -> Bytes:
    """Pixels [H, W, 4] of a WebP picture of at most `limit` pixels."""
    return np.asarray(decode_picture(data, limit, "WEBP").convert("RGBA"))


def _zip(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:  # stored: the pictures are already compressed
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return stream.getvalue()


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a zip has the description of a SOG file. A damaged zip counts as one, so that `read`
    explains the damage."""
    try:
        with opening(path, budget.SOG) as source:
            return "meta.json" in zip_names(source)
    except InputError:
        return True


FORMAT = Format(
    suffix=".sog",
    write=write,
    read=read,
    marks=(b"PK\x03\x04",),
    looks_like=looks_like,
    antialias=True,
    is_antialiased=is_antialiased,
)
