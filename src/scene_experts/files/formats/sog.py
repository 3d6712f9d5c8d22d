"""PlayCanvas's SOG, the smallest.

Version 2 is a zip of lossless WebP pictures with one or two bytes per value, and a palette for the
harmonics. Positions are 16 bits of sign(x) ln(1 + |x|) within the range of each axis. Log scales
and colours are indices into 256 levels. Rotations are the smallest three components in a byte each.
Harmonics above the constant are one of at most 65,536 rows of indices into 256 levels. Gaussians
are sorted along the Morton curve and fill the pictures row by row. Version 1 (SOGS), which is only
read, has even levels between the ends of each channel in place of codebooks. Both versions also
exist as a folder of meta.json and pictures.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.archives import open_zip, zip_names
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, expect_range, shown, whole_number
from scene_experts.core.reading.pictures import decode_picture
from scene_experts.core.reading.plain import JSON_STARTS, parse_json
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
_META, _STREAMED = "meta.json", "lod-meta.json"
_ENCODING = "quaternion_packed"  # of rotations, in version 1
_META_LIMIT, _FILE_LIMIT = 1 << 20, 1 << 30
Part = Callable[[Any], bytes]
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
    """The Gaussians of a file or a meta.json of version 1 or 2. Raises InputError for other or
    damaged files."""
    with _opened(path) as (source, meta, part):
        return _decode(source, meta, part).checked(path)


def is_antialiased(path: Path) -> bool:
    """Whether a file says that it is drawn with antialiasing. Raises InputError for a damaged
    file."""
    with _opened(path) as (_, meta, _):
        return meta.get("antialias") is True


def read_note(path: Path) -> dict[str, Any]:
    """The note in a file of ours. Raises InputError for a damaged file."""
    with _opened(path) as (_, meta, _):
        asset = meta.get("asset")
        note = asset.get("scene-experts") if isinstance(asset, dict) else None
        return note if isinstance(note, dict) else {}


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Source, Any, Part]]:
    """The description in a zip or in a meta.json, and what returns the files that it names."""
    with opening(path, budget.SOG) as source:
        if not source.head(2).startswith(b"PK"):
            if path.name == _STREAMED:
                raise _streamed_error(path)
            if source.size > _META_LIMIT:
                raise Damaged(f"a description of {source.size:,} bytes")
            meta = parse_json(source.read())
            if "lodLevels" in meta:
                raise _streamed_error(path)
            yield source, meta, lambda name: source.part(name, _FILE_LIMIT)
            return
        with open_zip(source) as archive:
            found = _descriptions(archive.names)
            if not found or found[0].endswith(_STREAMED):
                raise _streamed_error(path) if found else Damaged(f"no member {_META}")
            place = found[0].removesuffix(_META)
            yield source, parse_json(archive.read(found[0], _META_LIMIT)), lambda name: archive.read(f"{place}{name}", _FILE_LIMIT)


def _descriptions(names: list[str]) -> list[str]:
    """The descriptions among the members of a zip, the outermost first: some programs pack the
    folder around the files too."""
    found = [name for name in names if name.rpartition("/")[2] in (_META, _STREAMED) and not name.startswith("__MACOSX/")]
    return sorted(found, key=lambda name: (name.count("/"), name))


def _streamed_error(path: Path) -> InputError:
    return InputError(
        f"expected one SOG scene at {path}, found one in parts and levels of detail ({_STREAMED}); join the parts of its finest level "
        "first (splat-transform 0_*/meta.json scene.ply in that folder), or give the meta.json of one part"
    )


def _decode(source: Source, meta: dict[str, Any], file: Part) -> Splats:
    first = meta.get("version", 1) == 1 and "shape" in meta["means"]
    if not first and meta["version"] != 2:
        raise Damaged(f"version {shown(meta['version'])}")
    if meta["quats"].get("encoding", _ENCODING) != _ENCODING:
        raise Damaged(f"rotations in the encoding {shown(meta['quats']['encoding'])}")
    n = whole_number(meta["means"]["shape"][0] if first else meta["count"], "the number of Gaussians", 1, MAX_GAUSSIANS)
    rows, bands = _palette(meta["shN"], file, first) if meta.get("shN") else (np.zeros((1, 0, 4), np.uint8), 0)
    check_count(source, n, decoded_bytes(bands))

    def pixels(part: str, i: int = 0) -> Bytes:
        picture = _picture(file(meta[part]["files"][i]), 4 * n + 65536)
        source.check_time()
        if picture.shape[0] * picture.shape[1] < n:
            raise Damaged(f"a picture of {part} with too few pixels")
        return picture.reshape(-1, 4)[:n]

    def levels(part: str, index: Bytes, bits: int = 8) -> NDArray[Any]:
        """The values of indices [N, C]: from the codebook, or between the ends of each channel."""
        if not first:
            return np.array(meta[part]["codebook"], np.float64).reshape(-1)[index]
        low, high = (np.broadcast_to(np.array(meta[part][end], np.float64), index.shape[1]) for end in ("mins", "maxs"))
        return low + (high - low) * (index / float((1 << bits) - 1))

    mins, maxs = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    level = pixels("means", 0)[:, :3].astype(np.int64) + (pixels("means", 1)[:, :3].astype(np.int64) << 8)
    farthest = float(_squeeze(np.array(FARTHEST)))
    expect_range(np.stack([mins, maxs]), "ends of the positions", -farthest, farthest)
    means = _stretch(mins + (maxs - mins) * (level / 65535))
    rest, colors = pixels("quats"), pixels("sh0")
    if (rest[:, 3] < 252).any():
        raise Damaged("rotations of another kind")
    quats = from_smallest_three(rest[:, 3] - 252, (rest[:, :3] / 255 - 0.5) * np.sqrt(2))
    sh = np.empty((n, (bands + 1) ** 2, 3), np.float32)  # in place: most of the memory of a file is here
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        scales = levels("scales", pixels("scales")[:, :3])
        color = levels("sh0", colors if first else colors[:, :3])
        sh[:, 0] = color[:, :3]
        logits = color[:, 3].copy() if first else byte_logits(colors[:, 3])
        del color  # the harmonics take its memory
        if bands:
            bits = whole_number(meta["shN"].get("quantization", 8), "bits of the palette", 1, 8) if first else 8
            index = _labels(pixels("shN", 1), len(rows) if first else meta["shN"]["count"], len(rows))
            for i in range(sh.shape[1] - 1):
                sh[:, 1 + i] = levels("shN", rows[:, i, :3], bits).astype(np.float32)[index]
    if not all(np.isfinite(part).all() for part in (means, scales, sh, logits)):
        raise Damaged("values that are not finite")
    return Splats(tensor(means), tensor(scales), tensor(quats), tensor(logits), torch.from_numpy(sh))


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


def _palette(meta: dict[str, Any], file: Part, first: bool) -> tuple[Bytes, int]:
    """The palette's rows [M, C, 4] of levels, and the degree of the harmonics. Version 1 states the
    latter by the number of columns, if at all, and else the picture's width does."""
    picture = _picture(file(meta["files"][0]), PALETTE * _COEFFICIENTS[-1] + 65536)
    wide = picture.shape[1] // _COLUMNS
    if first:
        shape = meta.get("shape")
        stated = whole_number(shape[-1], "the columns of harmonics") // 3 if shape else wide
        bands = _COEFFICIENTS.index(min(wide, stated)) if min(wide, stated) in _COEFFICIENTS[1:] else 0
    else:
        bands = whole_number(meta["bands"], "the bands of harmonics", 1, 3)
    if not bands or picture.shape[1] % _COLUMNS or (wide != _COEFFICIENTS[bands] and not first):
        raise Damaged("a palette of another size")
    return picture.reshape(-1, wide, 4)[:, : _COEFFICIENTS[bands]], bands


def _labels(pixels: Bytes, count: Any, rows: int) -> NDArray[np.int64]:
    """The palette row [N] of each Gaussian."""
    index = pixels[:, 0].astype(np.int64) + (pixels[:, 1].astype(np.int64) << 8)
    if whole_number(count, "the rows of the palette", 1, PALETTE) > rows or index.max() >= count:
        raise Damaged("a palette of another size")
    return index


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
    """Pixels [H, W, 4] of a WebP or PNG picture of at most `limit` pixels."""
    return np.asarray(decode_picture(data, limit, "WEBP", "PNG").convert("RGBA"))


def _zip(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:  # stored: the pictures are already compressed
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)
    return stream.getvalue()


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a zip, or a JSON file, has the description of a SOG scene. A damaged zip counts as
    one, so that `read` explains the damage."""
    if head.startswith(JSON_STARTS):
        return path.name in (_META, _STREAMED) or b'"means"' in head or b'"lodLevels"' in head
    try:
        with opening(path, budget.SOG) as source:
            return bool(_descriptions(zip_names(source)))
    except InputError:
        return path.suffix.lower() != ".zip"


FORMAT = Format(
    suffix=".sog",
    write=write,
    read=read,
    marks=(b"PK\x03\x04", *JSON_STARTS),
    looks_like=looks_like,
    antialias=True,
    is_antialiased=is_antialiased,
    read_note=read_note,
)
