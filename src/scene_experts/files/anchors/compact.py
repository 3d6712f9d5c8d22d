"""One small file of this package, networks included: about a megabyte for a scene of 22,000 anchors.

Positions are exact; other values are rounded to steps that follow from what a rounding does to the
pictures (`precision`), and entropy coded with models that were fitted to the scene (`codec`).
docs/compact-file.md states every byte. Rows come back in another order, which does not change
pictures.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, LARGEST, number, whole_number
from scene_experts.core.reading.source import Source, opening
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.places import MOST_LATTICES, AnchorPlaces, Lattice, find_places, read_places, write_places
from scene_experts.files.anchors.precision import rows_of
from scene_experts.files.anchors.quality import choose_precision
from scene_experts.files.anchors.rounding import FURTHER, WholeScene, restore, round_scene
from scene_experts.files.anchors.sensitivity import prepare
from scene_experts.files.codec import container
from scene_experts.files.codec.fit import fit_models
from scene_experts.files.codec.groups import EXTRA, FEATURE, OFFSETS, ORDER, SCALING, SLOTS, ChannelGroup, Walk, anchor_groups
from scene_experts.files.codec.numbers import Rounded, code_models, code_rounded, reading, writing
from scene_experts.files.codec.order import CodingOrder, choose_boxes
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter
from scene_experts.files.measure import Tell
from scene_experts.files.options import Options
from scene_experts.files.registry import Format
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun

VERSION = 2
MOST_ANCHORS, MOST_CHANNELS, MOST_SLOTS = 1 << 28, 1024, 256  # of a file; F and K
MOST_TENSORS, MOST_VALUES = 1000, 1 << 28
BYTES_PER_VALUE = 16  # in memory, while a file is read
POSITIONS, MODELS, NETWORKS, EXACT = "positions", "models", "networks", "exact"  # names of parts, beside those of the groups
_SAID = {"class": "classes", "feature": "features", "scaling": "scalings", "slots": "masks", "models": "context models", "exact": "routers"}


@dataclass(frozen=True)
class Sizes:
    """Bytes of a compact file."""

    total: int
    parts: dict[str, int]
    """By part; the rest of the total is the header."""
    anchors: int  # their number

    @property
    def per_anchor(self) -> float:
        """Bytes of an anchor, with its share of everything else."""
        return self.total / max(self.anchors, 1)

    def __str__(self) -> str:
        parts = {_SAID.get(name, name): size for name, size in self.parts.items() if size}
        parts["header"] = self.total - sum(self.parts.values())
        return f"{self.per_anchor:.1f} bytes per anchor: " + ", ".join(f"{name} {size:,}" for name, size in parts.items())


def write(path: Path, data: AnchorData, note: dict[str, Any]) -> Sizes:
    """Write a scene to one file, atomically. The note has no place in it: the description says
    more.

    Raises InputError for anchors on no known lattice, for values that are not finite or too large,
    and for cells that span more than 2^21 voxels; RunError when the disk is full.
    """
    encoded, sizes = encode(data)
    write_bytes(Path(path), encoded)
    return sizes


@dataclass(frozen=True)
class Arranged:
    """A scene as whole numbers, in the order in which its file codes them."""

    places: AnchorPlaces
    rows: NDArray[np.int64]
    """[N], of the scene"""
    way: CodingOrder
    boxes: tuple[int, int]
    whole: WholeScene
    groups: tuple[ChannelGroup, ...]


def arrange(data: AnchorData) -> Arranged:
    """The whole numbers of a scene. Raises InputError as `write`."""
    places, along = find_places(data)
    F, K = data.columns["feature"].shape[1], data.columns["offsets"].shape[1]
    if F > MOST_CHANNELS or K > MOST_SLOTS:
        raise InputError(f"expected at most {MOST_CHANNELS} channels and {MOST_SLOTS} Gaussians for a compact file, found {F} and {K}")
    boxes = choose_boxes(places.keys)
    way = CodingOrder.of(places.keys, boxes, places.fine)
    rows = along[way.rows]
    whole = round_scene(data, rows)
    return Arranged(places.ordered(way.rows), rows, way, boxes, whole, anchor_groups(F, K, SLOTS in whole.values, len(whole.extra)))


def encode(data: AnchorData) -> tuple[bytes, Sizes]:
    """The bytes of a scene's file, and their sizes. Raises InputError as `write`."""
    return encode_arranged(data, arrange(data))


def encode_arranged(data: AnchorData, found: Arranged) -> tuple[bytes, Sizes]:
    """The bytes of the file of a scene of which `arrange` found the whole numbers, and their sizes."""
    places, way, whole, groups = found.places, found.way, found.whole, found.groups
    models = fit_models(groups, way, whole.values)
    cells, numbers, weights = SymbolWriter(), SymbolWriter(), SymbolWriter()
    write_places(places, cells)
    models = code_models(writing(numbers), groups, models)
    for rounded in whole.networks.values():
        code_rounded(writing(weights), (len(rounded.values), *rounded.values.shape[1:]), rounded)
    parts = {POSITIONS: cells.pack(), MODELS: numbers.pack()}
    parts |= {name: stream.pack() for name, stream in Walk(groups, way, models).write(whole.values).items()}
    exact = zlib.compress(b"".join(value.astype("<f4").tobytes() for value in whole.exact.values()), 9)
    parts |= {NETWORKS: weights.pack(), EXACT: exact}
    header = {
        "version": VERSION,
        "N": len(found.rows),
        "F": data.columns["feature"].shape[1],
        "K": data.columns["offsets"].shape[1],
        "slots": SLOTS in whole.values,
        "extra": whole.extra,
        "steps": whole.steps,
        "levels": bool(data.edges),
        "lattices": [lattice.plain() for lattice in places.lattices],
        "origin": list(data.origin),
        "voxel": data.voxel,
        "boxes": list(found.boxes),
        "networks": [[name, list(data.networks[name].shape)] for name in (*whole.networks, *whole.exact)],
        "rounded": len(whole.networks),
        "integers": checksum(places, whole),
        "scene": data.about,
    }
    encoded = container.join(header, parts)
    told = {name: len(part) for name, part in parts.items() if name != EXACT or whole.exact}
    return encoded, Sizes(len(encoded), told, len(found.rows))


def checksum(places: AnchorPlaces, whole: WholeScene) -> int:
    """CRC-32 of all numbers, 32 bits each, low byte first: fine cells [N, 3], the groups [C, N], values
    [E, R, C] and exponents [R] of each network, then the tensors that are held as they are."""
    found = 0
    for array in (
        places.fine,
        *(whole.values[name] for name in ORDER if name in whole.values),
        *(a for r in whole.networks.values() for a in (r.values, r.exponents)),
    ):
        found = zlib.crc32(np.ascontiguousarray(array, "<i4").data, found)
    for array in whole.exact.values():
        found = zlib.crc32(np.ascontiguousarray(array, "<f4").data, found)
    return found


def read(path: Path) -> AnchorData:
    """The scene in a file. Raises InputError for a missing, damaged or other file and for one of
    another version."""
    with opening(path, budget.COMPACT) as source:
        head = source.head(4096)
        older = head[8:9] == b"{" and b"compact scene" in head
        if not head.startswith(container.MARK) and (older or head.startswith(container.MARK[:6])):
            found = "1" if older else head[6:7].decode(errors="replace")
            raise InputError(f"expected a compact file of version {VERSION} at {path}, found version {found}; export its run again")
        return decode(source.read(), source)


@dataclass(frozen=True)
class CompactScene:
    """What a file holds, in coding order."""

    header: dict[str, Any]
    places: AnchorPlaces
    origin: tuple[float, float, float]
    whole: WholeScene
    shapes: dict[str, tuple[int, ...]]
    """Of the networks' tensors."""

    def restored(self) -> AnchorData:
        """The scene. Raises Damaged for numbers that are no scene."""
        header, about = self.header, self.about
        columns = self.places.columns(self.origin)
        has_levels = header["levels"] is True
        columns |= {"level": self.places.levels()} if has_levels else {}
        voxel = number(header["voxel"], "the edge of a cell", 0, FARTHEST)
        step = whole_number((about or {}).get("step", 0), "the iteration")
        add_dist = tuple(a for a, used in (about or {}).get("add_dist", {}).items() if used)
        found = AnchorData(columns, {}, about, None, voxel, self.origin, add_dist, step)  # type: ignore[arg-type]
        found = restore(self.whole, found, self.shapes)
        if not has_levels:
            found = replace(found, cells=torch.from_numpy(self.places.cells))
        return found.checked()

    @property
    def about(self) -> dict[str, Any] | None:
        """The description of the scene."""
        return dict(self.header["scene"]) if self.header["scene"] is not None else None


def decode(data: bytes, source: Source) -> AnchorData:
    """The scene in the bytes of a file, which were read from `source`. Raises CutShort and Damaged
    for damaged ones."""
    return decode_whole(data, source).restored()


def decode_whole(data: bytes, source: Source) -> CompactScene:
    """The whole numbers in the bytes of a file. Raises as `decode`."""
    header, parts = container.part(data)
    if header["version"] != VERSION:
        raise Damaged(f"version {header['version']!r} of the format, not {VERSION}")
    n = whole_number(header["N"], "the number of anchors", 0, MOST_ANCHORS)
    F, K = whole_number(header["F"], "F", 1, MOST_CHANNELS), whole_number(header["K"], "K", 1, MOST_SLOTS)
    source.spend_bytes(n * BYTES_PER_VALUE * (3 * K + F + 18))
    extra = [str(name) for name in header["extra"]]
    if any(name not in FURTHER for name in extra) or len(set(extra)) < len(extra):
        raise Damaged("an unknown column")
    shapes = _shapes(header["networks"])
    source.spend_bytes(8 * sum(math.prod(shape) for shape in shapes.values()))
    origin = tuple(number(v, "the origin of the cells", -FARTHEST, FARTHEST) for v in header["origin"])
    lattices = [Lattice.from_plain(value, n) for value in header["lattices"][:MOST_LATTICES]]
    if sum(lattice.count for lattice in lattices) != n or len(origin) != 3:
        raise Damaged(f"cells of another number than {n:,} anchors")
    places = read_places(lattices, SymbolReader(parts[POSITIONS]))
    source.check_time()
    groups = anchor_groups(F, K, bool(header["slots"]), len(extra))
    first, second = (whole_number(v, "the bits of a box", 0, 63) for v in header["boxes"])
    way = CodingOrder.of(places.keys, (first, second), places.fine)
    places = places.ordered(way.rows)
    stream = SymbolReader(parts[MODELS])
    models = code_models(reading(stream), groups, None)
    stream.finish()
    values = Walk(groups, way, models).read(parts)
    source.check_time()
    count = whole_number(header["rounded"], "the number of networks", 0, len(shapes))
    whole = WholeScene(values, steps_of(header["steps"], F, K, extra), extra, *_networks(parts, shapes, count))
    if checksum(places, whole) != header["integers"]:
        raise Damaged("numbers with another checksum")
    return CompactScene(header, places, origin, whole, shapes)  # type: ignore[arg-type]


def _shapes(listed: Any) -> dict[str, tuple[int, ...]]:
    """The shapes of the networks' tensors by name. Raises Damaged for shapes that are none."""
    out = {}
    for name, shape in listed[:MOST_TENSORS]:
        out[str(name)] = tuple(whole_number(v, f"the shape of {name}", 1, 1 << 24) for v in shape)
        if not 1 <= len(shape) <= 3 or math.prod(out[str(name)]) > MOST_VALUES:
            raise Damaged(f"a network {name} of another shape")
    if len(out) != len(listed):
        raise Damaged("networks of the same name, or too many")
    return out


def steps_of(value: Any, F: int, K: int, extra: list[str]) -> dict[str, list[float]]:
    """The steps of a header by group. Raises Damaged for others."""
    wanted = {FEATURE: F, SCALING: 6, OFFSETS: 3 * K} | ({EXTRA: len(extra)} if extra else {})
    found = {name: [number(v, "a step", 1e-30, LARGEST) for v in value[name]] for name in wanted}
    if any(len(found[name]) != size for name, size in wanted.items()):
        raise Damaged("steps of another number of channels")
    return found


def _networks(parts: dict[str, bytes], shapes: dict[str, tuple[int, ...]], count: int) -> tuple[dict[str, Rounded], dict[str, Any]]:
    """The networks' tensors as whole numbers, the first `count`, and the others as they are."""
    stream, rounded, exact, at = SymbolReader(parts[NETWORKS]), {}, {}, 0
    machine = zlib.decompressobj()
    floats = machine.decompress(parts[EXACT], 4 * sum(math.prod(shape) for shape in list(shapes.values())[count:]) + 1)
    for i, (name, shape) in enumerate(shapes.items()):
        if i < count:
            E, R, C = rows_of(name, torch.empty(shape, device="meta")).shape
            rounded[name] = code_rounded(reading(stream), (E, R, C), None)
        else:
            size = 4 * math.prod(shape)
            exact[name] = np.frombuffer(floats[at : at + size], "<f4").astype(np.float32)
            at += size
    stream.finish()
    if at != len(floats) or not machine.eof or machine.unused_data:
        raise Damaged("networks of another size")
    return rounded, exact


def fit(
    run: OpenRun,
    contents: AnchorData,
    world: World,
    options: Options,
    capture: Capture | None,
    rasterize: Rasterizer | None,
    tell: Tell,
) -> tuple[AnchorData, list[str]]:
    """See `registry.Format.fit`."""
    return choose_precision(run, contents, world, options, capture, rasterize, tell, lambda data: encode(data)[1].total)


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a file is meant as a compact one: by its mark, by its name, or by the start of a file
    of version 1."""
    return head.startswith(container.MARK) or path.suffix == FORMAT.suffix or (head[8:9] == b"{" and b"compact scene" in head)


FORMAT = Format(
    suffix=".compact",
    family="anchors",
    write=write,
    read=read,
    looks_like=looks_like,
    fit=fit,
    prepare=prepare,
)
