"""Streams of whole numbers: coded by the compiled library, or by `reference` where there is none."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec import reference
from scene_experts.files.codec.reference import Floats, Ints
from scene_experts.native import api
from scene_experts.native import library as native

MOST_INPUTS = 4096  # of a context, so that no sum exceeds 32 bits
_MOST_OPERATIONS = 6  # of a symbol


def _at(array: NDArray[Any]) -> int:
    assert array.flags.c_contiguous
    return array.__array_interface__["data"][0]  # faster than array.ctypes.data, which makes an object


class SymbolWriter:
    """Collects symbols and bits, and packs them into bytes. `slow`: with the reference."""

    def __init__(self, slow: bool = False) -> None:
        self._library = None if slow else native.load()
        self._memory, self._count = np.empty(0, np.uint32), 0

    @property
    def _operations(self) -> NDArray[np.uint32]:
        return self._memory[: self._count]

    def _room(self, more: int) -> NDArray[np.uint32]:
        """Memory for `more` operations after those that are there."""
        if self._count + more > len(self._memory):
            larger = np.empty(max(2 * len(self._memory), self._count + more), np.uint32)
            larger[: self._count] = self._operations
            self._memory = larger
        return self._memory[self._count : self._count + more]

    def _append(self, operations: NDArray[np.uint32]) -> None:
        self._room(len(operations))[:] = operations
        self._count += len(operations)

    def symbols(self, values: Ints, mean: Ints, scale: Ints) -> None:
        """Append values [n], expected near mean [n] (1/8 of a step) with a spread of 2^(scale / 8 -
        4) steps."""
        if self._library is None:
            self._append(reference.code_symbols(values, mean, scale))
            return
        values, mean, scale = (np.ascontiguousarray(a, np.int32) for a in (values, mean, scale))
        room = self._room(_MOST_OPERATIONS * len(values))
        self._count += self._library.se_code_symbols(_at(values), _at(mean), _at(scale), len(values), _at(room))

    def bits(self, bits: NDArray[np.uint8], odds: Ints) -> None:
        """Append bits [n] with odds [n] of a one: 2^((odds - 64) / 8)."""
        if self._library is None:
            self._append(reference.code_bits(bits, odds))
            return
        bits, odds = np.ascontiguousarray(bits, np.uint8), np.ascontiguousarray(odds, np.int32)
        self._library.se_code_bits(_at(bits), _at(odds), len(bits), _at(self._room(len(bits))))
        self._count += len(bits)

    def cells(self, keys: NDArray[np.int64], depth: int) -> None:
        """Append distinct ascending Morton keys [n] of 3 depth bits."""
        if self._library is None:
            self._append(reference.code_cells(keys, depth))
            return
        keys = np.ascontiguousarray(keys, np.int64)
        room, used = self._room(48 * len(keys) + 64), 0
        for _ in range(2):  # few scenes need more room
            used = self._library.se_code_cells(_at(keys), len(keys), depth, _at(room), len(room))
            native.check(int(used < 0), "coding the positions")
            if used <= len(room):
                break
            room = self._room(used)
        self._count += used

    @property
    def ideal_bits(self) -> float:
        """The information of the shares that were taken, in bits."""
        return float((reference.BITS - np.log2(self._operations & 0xFFFF)).sum())

    def pack(self) -> bytes:
        """The bytes of everything appended: words of 16 bits, low byte first."""
        operations = self._operations
        if self._library is None:
            return reference.pack(operations).astype("<u2").tobytes()
        room = np.empty(len(operations) + 2 * reference.LANES, np.uint16)
        used = self._library.se_code_pack(_at(operations), len(operations), _at(room))
        return room[:used].astype("<u2", copy=False).tobytes()


class SymbolReader:
    """Reads what a `SymbolWriter` packed, in the same order. Its methods raise Damaged for bytes
    that fit no symbols."""

    def __init__(self, data: bytes, slow: bool = False) -> None:
        if len(data) % 2:
            raise Damaged("a stream of half a word")
        self._words = np.frombuffer(data, "<u2").astype(np.uint16, copy=False)
        self._library = None if slow else native.load()
        self._slow = reference.WordReader(self._words) if self._library is None else None
        if self._library is not None:
            self._state = api.SeCodeReader(_at(self._words), len(self._words))
            self._check(self._library.se_code_start(ctypes.byref(self._state)))

    def _check(self, status: int) -> None:
        if status == 1:
            native.check(status, "reading a compact file")
        if status:
            raise Damaged("a stream that does not fit its contents")

    def symbols(self, mean: Ints, scale: Ints, out: Ints | None = None) -> Ints:
        """The values [n] that were coded with the same mean [n] and scale [n], in `out` if it is given."""
        out = np.empty(len(mean), np.int32) if out is None else out
        if self._slow is not None:
            out[:] = self._slow.symbols(mean, scale)
            return out
        mean, scale = np.ascontiguousarray(mean, np.int32), np.ascontiguousarray(scale, np.int32)
        assert len(mean) == len(scale) == len(out)
        self._check(self._library.se_code_read(ctypes.byref(self._state), _at(mean), _at(scale), len(mean), _at(out)))  # type: ignore[union-attr]
        return out

    def bits(self, odds: Ints) -> NDArray[np.uint8]:
        """The bits [n] that were coded with the same odds [n]."""
        if self._slow is not None:
            return self._slow.bits(odds)
        odds = np.ascontiguousarray(odds, np.int32)
        out = np.empty(len(odds), np.uint8)
        self._check(self._library.se_code_read_bits(ctypes.byref(self._state), _at(odds), len(odds), _at(out)))  # type: ignore[union-attr]
        return out

    def cells(self, depth: int, count: int) -> NDArray[np.int64]:
        """The Morton keys [count] that were coded with the same depth, at most 21."""
        if self._slow is not None:
            return reference.read_cells(self._slow, depth, count)
        out = np.empty(count, np.int64)
        self._check(self._library.se_code_read_cells(ctypes.byref(self._state), depth, count, _at(out)))  # type: ignore[union-attr]
        return out

    def finish(self) -> None:
        """Raises Damaged unless the bytes end here."""
        done = (
            self._slow.is_done
            if self._slow is not None
            else self._state.at == len(self._words) and set(self._state.state) == {reference.FLOOR}
        )
        if not done:
            raise Damaged("a stream that is longer than its contents")


class Inputs:
    """Inputs [D, n] of contexts: blocks of rows, which stay where they are."""

    def __init__(self, *blocks: NDArray[np.int16]) -> None:
        self.blocks: list[NDArray[np.int16]] = []
        self.places = np.empty(0, np.int64)
        """[D] addresses"""
        for block in blocks:
            self.append(block)

    def append(self, block: NDArray[np.int16]) -> None:
        """Add the rows [any, n] of a block, each in one piece."""
        assert block.dtype == np.int16 and (block.shape[1] < 2 or block.strides[1] == 2)
        self.blocks.append(block)
        rows = block.__array_interface__["data"][0] + block.strides[0] * np.arange(len(block))
        self.places = np.concatenate([self.places, rows])


def predict(
    inputs: Inputs, weights: NDArray[np.int8], numbers: Sequence[int], classes: NDArray[np.int8], slow: bool = False
) -> tuple[Ints, Ints]:
    """`reference.predict` with the first D inputs; weights [2, D]."""
    library, used = None if slow else native.load(), weights.shape[1]
    if library is None:
        return reference.predict(np.concatenate(inputs.blocks)[:used], weights, numbers, classes)
    n = len(classes)
    mean, scale, four = np.empty(n, np.int32), np.empty(n, np.int32), np.array(numbers, np.int32)
    weights, classes = np.ascontiguousarray(weights, np.int8), np.ascontiguousarray(classes, np.int8)
    assert used <= len(inputs.places) and all(block.shape[1] == n for block in inputs.blocks)
    places = (ctypes.c_void_p * len(inputs.places)).from_address(_at(inputs.places))
    library.se_code_predict(places, _at(weights), _at(four), used, _at(classes), n, _at(mean), _at(scale))
    return mean, scale


def as_inputs(
    values: Ints, classes: NDArray[np.int8], factor: int, offset: int, out: NDArray[np.int16] | None = None, slow: bool = False
) -> NDArray[np.int16]:
    """`reference.as_inputs`, in `out` [n] if it is given."""
    library = None if slow else native.load()
    out = np.empty(len(values), np.int16) if out is None else out
    if library is None:
        out[:] = reference.as_inputs(values, classes, factor, offset)
        return out
    values, classes = np.ascontiguousarray(values, np.int32), np.ascontiguousarray(classes, np.int8)
    assert len(values) == len(classes) == len(out)
    library.se_code_inputs(_at(values), _at(classes), len(values), factor, offset, _at(out))
    return out


def blend(columns: NDArray[np.int16], parents: Ints, weights: Ints, slow: bool = False) -> NDArray[np.int16]:
    """`reference.blend`."""
    library = None if slow else native.load()
    if library is None:
        return np.ascontiguousarray(reference.blend(columns, parents, weights))
    out = np.empty((len(columns), len(parents)), np.int16)
    library.se_code_blend(_at(columns), columns.shape[1], len(columns), _at(parents), _at(weights), len(parents), _at(out))
    return out


def find_parents(cells: Ints, rows: Ints, coarse: Ints, slow: bool = False) -> tuple[Ints, Ints]:
    """`reference.find_parents`."""
    library = None if slow else native.load()
    if library is None:
        return reference.find_parents(cells, rows, coarse)
    cells, rows, coarse = (np.ascontiguousarray(a, np.int32) for a in (cells, rows, coarse))
    parents, weights = np.empty((len(rows), 4), np.int32), np.empty((len(rows), 4), np.int32)
    library.se_code_parents(_at(cells), _at(rows), len(rows), _at(coarse), len(coarse), _at(parents), _at(weights))
    return parents, weights


def restore(whole: Ints, steps: Floats, scale: Floats | None, slow: bool = False) -> Floats:
    """`reference.restore`."""
    library = None if slow else native.load()
    if library is None:
        return reference.restore(whole, steps, scale)
    (C, N), whole, steps = whole.shape, np.ascontiguousarray(whole, np.int32), np.ascontiguousarray(steps, np.float32)
    scale = None if scale is None else np.ascontiguousarray(scale, np.float32)
    assert len(steps) == C and (scale is None or len(scale) == N)
    out = np.empty((N, C), np.float32)
    library.se_code_restore(_at(whole), N, C, _at(steps), None if scale is None else _at(scale), _at(out))
    return out
