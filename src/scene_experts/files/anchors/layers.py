"""A scene of anchors in layers: a coarse scene, which is a compact file, and chunks that make it whole.

The coarse scene holds some of the anchors with coarse values. The plan says where the other anchors
are and how the chunks are coded (`codec.refine`). Any number of chunks leaves a scene. With all of
them it has the whole numbers of the compact file of the scene. docs/compact-file.md states every
byte.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import whole_number
from scene_experts.core.reading.source import Source
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.compact import BYTES_PER_VALUE, MODELS, MOST_ANCHORS, POSITIONS, CompactScene, steps_of
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.places import MOST_LATTICES, AnchorPlaces, Lattice, find_places, from_zero, read_places, write_places
from scene_experts.files.anchors.rounding import WholeScene, round_scene
from scene_experts.files.codec import container
from scene_experts.files.codec.groups import CLASS, EXTRA, OFFSETS, SLOTS
from scene_experts.files.codec.numbers import code_models, reading, writing
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.refine import CoarsePart, Refiner, fit_refinement, groups_of, refined_groups
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter
from scene_experts.files.formats.morton import AXIS_BITS, morton

MARK, VERSION = b"SXPLAN1\n", 1
MOST_CHUNKS, ANCHORS, MOST_SHIFT = 64, 2000, 20  # of a scene; of a chunk, about
_SUM = 4  # bytes of a chunk's checksum


@dataclass(frozen=True)
class EncodedLayers:
    """The bytes of a scene in layers."""

    coarse: bytes
    """A compact file."""
    plan: bytes
    chunks: list[bytes]
    """In the order in which they are read."""

    @property
    def size(self) -> int:
        """Bytes in all."""
        return len(self.coarse) + len(self.plan) + sum(map(len, self.chunks))


def encode(data: AnchorData, rows: Tensor, coarse: AnchorData, given: Tensor) -> EncodedLayers:
    """The layers of a scene of N anchors.

    rows: [n], of the anchors of the coarse scene. coarse: the scene of these anchors, of the same
    classes and networks, with masks, and with the steps of `data` times powers of two. given: [N]
    what each anchor gives to the first view; chunks with more of it come first. Raises InputError
    as `compact.write`.
    """
    base, whole = compact.arrange(coarse), round_scene(data)
    order = rows.numpy()[base.rows]
    others = np.setdiff1d(np.arange(len(given)), order)
    added, along = find_places(_rows_of(data, torch.from_numpy(others)))
    merged, place = _merge(base.places, added)
    row = np.concatenate([order, others[along]])[place]
    is_coarse = place < len(order)
    values = {name: np.ascontiguousarray(value[:, row]) for name, value in whole.values.items()}
    shifts = {name: _shift(base.whole.steps[name], steps) for name, steps in whole.steps.items() if name != EXTRA}
    known = _spread(base.whole.values, shifts, place, is_coarse)
    if any((known[name][:, is_coarse] != values[name][:, is_coarse]).any() for name in (CLASS, EXTRA) if name in known):
        raise InputError("expected a coarse scene with the classes and further columns of the whole one, found others")
    F, K = len(values["feature"]), len(values[OFFSETS]) // 3
    groups = groups_of(F, K, SLOTS in values, len(whole.extra))
    count = max(1, min(MOST_CHUNKS, len(row) // ANCHORS))
    sums = [float(given[torch.from_numpy(row[i * len(row) // count : (i + 1) * len(row) // count])].sum()) for i in range(count)]
    turns = sorted(range(count), key=lambda i: -sums[i])
    part = CoarsePart.of(merged.keys, is_coarse, turns)
    models = fit_refinement(groups, part, known, values)
    positions, numbers = SymbolWriter(), SymbolWriter()
    write_places(added, positions)
    models = code_models(writing(numbers), (*groups, *refined_groups(groups)), models)
    refiner = Refiner(groups, part, known, models)
    streams = [refiner.write(i, values) for i in range(count)]
    header = {
        "version": VERSION,
        "coarse": compact.checksum(base.places, base.whole),
        "N": len(row),
        "slots": SLOTS in values,
        "lattices": [lattice.plain() for lattice in added.lattices],
        "steps": whole.steps,
        "shifts": shifts,
        "chunks": turns,
        "integers": compact.checksum(merged, replace(whole, values=values)),
    }
    plan = container.join(header, {POSITIONS: positions.pack(), MODELS: numbers.pack()}, MARK)
    coarse_file = compact.encode_arranged(coarse, base)[0]
    return EncodedLayers(coarse_file, plan, [stream + zlib.crc32(stream).to_bytes(_SUM, "little") for stream in streams])


class LayeredScene:
    """The scene of layers that arrive one after the other."""

    def __init__(self, base: CompactScene, plan: bytes, source: Source) -> None:
        """base: the coarse scene; plan: the bytes that belong to it. Raises CutShort and Damaged for
        a plan that is damaged or belongs to another scene."""
        header, parts = container.part(plan, MARK)
        if header["version"] != VERSION:
            raise Damaged(f"version {header['version']!r} of a plan, not {VERSION}")
        if header["coarse"] != base.header["integers"]:
            raise Damaged("the plan of another scene")
        v, extra = base.whole.values, base.whole.extra
        n, F, K = len(base.places.keys), len(v["feature"]), len(v[OFFSETS]) // 3
        if SLOTS not in v:
            raise Damaged("a coarse scene without masks")
        N = whole_number(header["N"], "the number of anchors", n, MOST_ANCHORS)
        source.spend_bytes(N * BYTES_PER_VALUE * (6 * K + F + 18))
        lattices = [Lattice.from_plain(value, N) for value in header["lattices"][:MOST_LATTICES]]
        if sum(lattice.count for lattice in lattices) != N - n:
            raise Damaged(f"cells of another number than {N - n:,} anchors")
        merged, place = _merge(base.places, read_places(lattices, SymbolReader(parts[POSITIONS])))
        groups = groups_of(F, K, header["slots"] is True, len(extra))
        stream = SymbolReader(parts[MODELS])
        models = code_models(reading(stream), (*groups, *refined_groups(groups)), None)
        stream.finish()
        self.steps = steps_of(header["steps"], F, K, extra)
        shifts = {name: whole_number(header["shifts"][name], "a shift", 0, MOST_SHIFT) for name in self.steps if name != EXTRA}
        order = [whole_number(i, "a chunk", 0, MOST_CHUNKS) for i in header["chunks"][: MOST_CHUNKS + 1]]
        part = CoarsePart.of(merged.keys, place < n, order)
        self.base, self.places, self.header, self.taken = base, merged, header, 0
        self.refiner = Refiner(groups, part, _spread(v, shifts, place, place < n), models)

    @property
    def chunks(self) -> int:
        """The number of chunks in all."""
        return len(self.refiner.part.chunks)

    def take(self, chunk: bytes) -> None:
        """Take the next chunk. Raises CutShort and Damaged for one that does not fit."""
        if zlib.crc32(chunk[:-_SUM]) != int.from_bytes(chunk[-_SUM:], "little") or len(chunk) < _SUM:
            raise CutShort("bytes with another checksum")
        self.refiner.read(self.taken, chunk[:-_SUM])
        self.taken += 1
        if self.taken == self.chunks and self._checksum() != self.header["integers"]:
            raise Damaged("numbers with another checksum")

    def _checksum(self) -> int:
        return compact.checksum(self.places, self._whole(np.arange(len(self.places.keys))))

    def _whole(self, rows: NDArray[Any]) -> WholeScene:
        """The numbers of rows [n]; masks where the scene has some, or is not whole."""
        is_open = self.taken == self.chunks and not self.refiner.has_slots
        values = {name: value[:, rows] for name, value in self.refiner.values.items() if name != SLOTS or not is_open}
        return replace(self.base.whole, values=values, steps=self.steps)

    def restored(self) -> AnchorData:
        """The scene as far as it is here."""
        rows = np.flatnonzero(self.refiner.is_known)
        return replace(self.base, places=self.places.ordered(rows), whole=self._whole(rows)).restored()


def _rows_of(data: AnchorData, rows: Tensor) -> AnchorData:
    """The scene of some anchors, without its precision."""
    columns = {name: value[rows] for name, value in data.columns.items()}
    return replace(data, columns=columns, cells=None if data.cells is None else data.cells[rows], precision=None)


def _shift(coarse: Sequence[float], fine: Sequence[float]) -> int:
    return round(float(np.log2(np.array(coarse) / np.array(fine)).mean()))


def _spread(values: dict[str, Ints], shifts: dict[str, int], place: NDArray[Any], is_coarse: NDArray[np.bool_]) -> dict[str, Ints]:
    """The values [C, N] along the curve, in fine steps, of coarse ones [C, n]; 0 for other anchors."""
    out = {}
    for name, value in values.items():
        out[name] = np.zeros((len(value), len(place)), np.int32)
        fine = value[:, place[is_coarse]].astype(np.int64) << shifts.get(name, 0)
        out[name][:, is_coarse] = fine.clip(-(1 << 30), 1 << 30)
    return out


def _merge(base: AnchorPlaces, added: AnchorPlaces) -> tuple[AnchorPlaces, NDArray[np.int64]]:
    """All places along the curve, and for each its number among those of `base` and then `added`.
    Raises Damaged for lattices that do not fit together."""
    every = sorted({lattice.level: lattice for lattice in (*added.lattices, *base.lattices)}.values(), key=lambda lattice: lattice.level)
    finest = min((lattice.edge for lattice in every), default=1.0)
    every = [replace(lattice, multiple=round(lattice.edge / finest)) for lattice in every]
    if any(lattice.multiple >= 1 << AXIS_BITS for lattice in every):
        raise Damaged("lattices that do not fit together")
    index = {lattice.level: i for i, lattice in enumerate(every)}
    number = [np.array([index[lattice.level] for lattice in places.lattices] or [0])[places.lattice] for places in (base, added)]
    cells, lattice = np.concatenate([base.cells, added.cells]), np.concatenate(number)
    fine = cells * np.array([one.multiple for one in every] or [1])[lattice][:, None]
    if np.abs(fine).max(initial=0) > 1 << 60:
        raise Damaged("cells that are too far away")
    try:
        fine = from_zero(fine)
        keys = morton(fine)
    except InputError as error:
        raise Damaged(str(error)) from None
    place = np.lexsort((lattice, keys))
    return AnchorPlaces(every, cells[place], lattice[place], keys[place], fine[place].astype(np.int32)), place
