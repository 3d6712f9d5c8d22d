"""The arithmetic of the codec in plain Python: the definition that the compiled library is tested
against, and what runs where there is none.

Nothing here is fast. `streams` calls the compiled functions of the same names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged

BITS = 15
"""Probabilities are multiples of 2^-15."""
LANES, FLOOR = 4, 1 << 16  # states, and the least state
HALF = 40  # symbols -40 .. 40 have shares of their own
SYMBOLS = 2 * HALF + 2  # with the escape
SCALES, PHASES, TOP = 48, 8, 127  # tables; the largest scale and the largest odds
FARTHEST = 1 << 28  # means are clamped to +- this
FRACTION, SHARE = 26, 20  # bits after the point: of powers of two, of probabilities
SLOPES = (193635251, 177564308, 162827188, 149313190, 136920799, 125556926, 115136209, 105580369)
"""round(2^27 log2(e) 2^(-j / 8))."""
ROOTS = (
    *(47453133, 56431603, 61539100, 64263668, 65670859, 66385968, 66746437, 66927405),
    *(67018073, 67063453, 67086155, 67097508, 67103186, 67106025, 67107444, 67108154),
)
"""round(2^26 2^(-2^-b)), b = 1 .. 16."""
REACH, LARGEST = 2047, 1 << 26  # largest input, largest mean
Ints = NDArray[np.int32]
Floats = NDArray[np.float32]


# --- tables -------------------------------------------------------------------------------------------------------------------------------


def power(u: int) -> int:
    """2^-u of u >= 0, both with 26 bits after the point."""
    whole, e = u >> FRACTION, 1 << FRACTION
    if whole >= FRACTION:
        return 0
    for b, root in enumerate(ROOTS, 1):
        if u >> (FRACTION - b) & 1:
            e = e * root >> FRACTION
    return e >> whole


def tail(u: int) -> int:
    """1 / (1 + 2^u) of u >= 0 with 26 bits after the point, as a whole number of 2^-20."""
    e = power(u)
    return (e << SHARE) // ((1 << FRACTION) + e)


@cache
def table(scale: int, phase: int) -> tuple[int, ...]:
    """The 83 borders of the shares of the symbols -40 .. 40 and the escape, from 0 to 2^15: the
    logistic distribution of scale 2^(scale / 8 - 4) and mean (phase - 4) / 8 steps, with at least
    one unit for each."""
    slope = SLOPES[scale & 7] >> (scale >> 3)
    below = lambda t: tail(-t * slope) if t <= 0 else (1 << SHARE) - tail(t * slope)  # noqa: E731
    first = below(-8 * HALF - phase)
    inner = [s + ((below(8 * (s - HALF) - phase) - first) * ((1 << BITS) - SYMBOLS) >> SHARE) for s in range(SYMBOLS)]
    return (*inner, 1 << BITS)


@cache
def zeros(odds: int) -> int:
    """The share of bit 0 where a one has the odds 2^((odds - 64) / 8)."""
    least = tail(abs(odds - 64) << (FRACTION - 3))
    return 1 + (((1 << SHARE) - least if odds <= 64 else least) * ((1 << BITS) - 2) >> SHARE)


# --- operations ---------------------------------------------------------------------------------------------------------------------------


def _find(mean: int, scale: int) -> tuple[tuple[int, ...], int, int]:
    """The table of a symbol, its centre, and how many low bits are stored as they are."""
    mean, scale = max(-FARTHEST, min(FARTHEST, mean)), max(0, min(TOP, scale))
    centre = (mean + 4) >> 3
    low = 0 if scale < SCALES else ((scale - SCALES) >> 3) + 1
    return table(scale - 8 * low, 4 if low else mean - 8 * centre + 4), centre, low


def _raw(value: int, bits: int) -> int:
    return value << (BITS - bits) << 16 | 1 << (BITS - bits)


def code_symbols(values: Ints, mean: Ints, scale: Ints) -> NDArray[np.uint32]:
    """The operations (start << 16 | width) of values [n], expected near mean [n] (1/8 of a step)
    with the spread 2^(scale / 8 - 4) steps, scale [n] 0 to 127."""
    out: list[int] = []
    for value, m, s in zip(values.tolist(), mean.tolist(), scale.tolist()):
        row, centre, low = _find(m, s)
        away = value - centre + ((1 << low) >> 1)
        symbol = away >> low
        entry = symbol + HALF if abs(symbol) <= HALF else SYMBOLS - 1
        out.append(row[entry] << 16 | (row[entry + 1] - row[entry]))
        if abs(symbol) > HALF:
            beyond = abs(symbol) - HALF
            left = beyond.bit_length() - 1
            out.append(_raw(left << 1 | (symbol < 0), 7))
            while left > 0:
                part = min(left, BITS)
                left -= part
                out.append(_raw(beyond >> left & ((1 << part) - 1), part))
        if low:
            out.append(_raw(away & ((1 << low) - 1), low))
    return np.array(out, np.uint32)


def code_bits(bits: NDArray[np.uint8], odds: Ints) -> NDArray[np.uint32]:
    """The operations of bits [n] with odds [n], 0 to 127."""
    return np.array([_bit(zeros(max(0, min(TOP, o))), bool(b)) for b, o in zip(bits.tolist(), odds.tolist())], np.uint32)


def _bit(share: int, one: bool) -> int:
    return share << 16 | ((1 << BITS) - share) if one else share


def pack(operations: NDArray[np.uint32]) -> NDArray[np.uint16]:
    """The words of operations: four states, then what they left behind, in reading order."""
    state, out = [FLOOR] * LANES, []
    for i in range(len(operations) - 1, -1, -1):
        start, width, x = int(operations[i]) >> 16, int(operations[i]) & 0xFFFF, state[i % LANES]
        if x >= width << 17:
            out.append(x & 0xFFFF)
            x >>= 16
        state[i % LANES] = (x // width << BITS) + x % width + start
    heads = [part for x in state for part in (x & 0xFFFF, x >> 16)]
    return np.array([*heads, *reversed(out)], np.uint16)


class WordReader:
    """Decodes what `pack` wrote. Raises Damaged where the words end too early."""

    def __init__(self, words: NDArray[np.uint16]) -> None:
        self._words, self._at, self._operations = words.tolist(), 2 * LANES, 0
        if len(words) < 2 * LANES:
            raise Damaged("a stream that is cut short")
        self._state = [self._words[2 * i] | self._words[2 * i + 1] << 16 for i in range(LANES)]
        if min(self._state) < FLOOR:
            raise Damaged("a stream with a wrong start")

    @property
    def is_done(self) -> bool:
        """Whether every word was read and the states are those before the first operation."""
        return self._at == len(self._words) and self._state == [FLOOR] * LANES

    def _place(self) -> int:
        return self._state[self._operations % LANES] & ((1 << BITS) - 1)

    def _take(self, start: int, width: int) -> None:
        lane = self._operations % LANES
        self._operations += 1
        x = self._state[lane]
        x = width * (x >> BITS) + (x & ((1 << BITS) - 1)) - start
        if x < FLOOR:
            if self._at >= len(self._words) or x == 0:
                raise Damaged("a stream that is cut short")
            x = x << 16 | self._words[self._at]
            self._at += 1
        self._state[lane] = x

    def _raw(self, bits: int) -> int:
        value = self._place() >> (BITS - bits)
        self._take(value << (BITS - bits), 1 << (BITS - bits))
        return value

    def bit(self, share: int) -> bool:
        """One bit; share: that of zero."""
        one = self._place() >= share
        self._take(share if one else 0, (1 << BITS) - share if one else share)
        return one

    def symbols(self, mean: Ints, scale: Ints) -> Ints:
        """The values [n] that `code_symbols` coded with the same mean and scale."""
        out = []
        for m, s in zip(mean.tolist(), scale.tolist()):
            row, centre, low = _find(m, s)
            place = self._place()
            entry = int(np.searchsorted(row, place, "right")) - 1
            self._take(row[entry], row[entry + 1] - row[entry])
            symbol = entry - HALF
            if entry == SYMBOLS - 1:
                form, beyond = self._raw(7), 1
                left = form >> 1
                if left > 32:
                    raise Damaged("a number of too many bits")
                while left > 0:
                    part = min(left, BITS)
                    left -= part
                    beyond = beyond << part | self._raw(part)
                symbol = -(beyond + HALF) if form & 1 else beyond + HALF
            value = centre + ((symbol << low) + self._raw(low) - ((1 << low) >> 1) if low else symbol)
            if not -(1 << 31) <= value < 1 << 31:
                raise Damaged("a number of too many bits")
            out.append(value)
        return np.array(out, np.int32)

    def bits(self, odds: Ints) -> NDArray[np.uint8]:
        """The bits [n] that `code_bits` coded with the same odds."""
        return np.array([self.bit(zeros(max(0, min(TOP, o)))) for o in odds.tolist()], np.uint8)


# --- cells --------------------------------------------------------------------------------------------------------------------------------


def _walk(depth: int, most: int, ask: Callable[[int, int, int], bool]) -> list[int]:
    """Walk the octree and return its leaves. ask(level, share of zero, key of the child) codes one
    bit. Raises Damaged for more than `most` nodes."""
    counts: dict[tuple[int, int, int], list[int]] = {}
    nodes = [0]
    for level in range(depth):
        known, children, following = {key: i for i, key in enumerate(nodes)}, [0] * len(nodes), []
        for i, key in enumerate(nodes):
            beside = [[known.get(step(key, axis, up, level), -1) for up in (-1, 1)] for axis in range(3)]
            own = 0
            for child in range(8):
                one = child == 7 and not own
                if not one:
                    state = 0
                    for axis in range(3):
                        high, other = child >> axis & 1, child ^ 1 << axis
                        node = beside[axis][high]
                        seen = 2 * (own >> other & 1) + (node >= 0) if high else 0 if node < 0 else 1 + (children[node] >> other & 1)
                        state = 4 * state + seen
                    count = counts.setdefault((min(depth - 1 - level, 3), child, state), [0, 0])
                    share = ((2 * count[0] + 1) << BITS) // (2 * sum(count) + 2)
                    one = ask(level, max(32, min((1 << BITS) - 32, share)), key << 3 | child)
                    count[one] += 1
                    if sum(count) > 1023:
                        count[:] = [(n + 1) >> 1 for n in count]
                if one:
                    own |= 1 << child
                    following.append(key << 3 | child)
            children[i] = own
            if len(following) > most:
                raise Damaged("more cells than there are")
        nodes = following
    return nodes


def step(key: int, axis: int, by: int, depth: int) -> int:
    """The Morton key one step along an axis among keys of `depth` bits an axis; -1: outside."""
    value = sum((key >> (3 * i + axis) & 1) << i for i in range(depth)) + by
    if not 0 <= value < 1 << depth:
        return -1
    cleared = key & ~sum(1 << (3 * i + axis) for i in range(depth))
    return cleared | sum((value >> i & 1) << (3 * i + axis) for i in range(depth))


def code_cells(keys: NDArray[np.int64], depth: int) -> NDArray[np.uint32]:
    """The operations of distinct ascending Morton keys [n] of 3 depth bits."""
    out: list[int] = []
    inside = [set((keys >> 3 * (depth - 1 - level)).tolist()) for level in range(depth)]

    def ask(level: int, share: int, key: int) -> bool:
        out.append(_bit(share, key in inside[level]))
        return key in inside[level]

    _walk(depth, len(keys), ask)
    return np.array(out, np.uint32)


def read_cells(reader: WordReader, depth: int, count: int) -> NDArray[np.int64]:
    """The keys [count] that `code_cells` coded."""
    keys = _walk(depth, count, lambda level, share, key: reader.bit(share))
    if len(keys) != count:
        raise Damaged(f"{len(keys):,} cells where {count:,} are expected")
    return np.array(keys, np.int64)


# --- contexts -----------------------------------------------------------------------------------------------------------------------------


def _shifted(sums: NDArray[np.int64], shift: int) -> NDArray[np.int64]:
    if shift > 0:
        return (sums + (1 << shift >> 1)) >> shift
    return sums.clip(-(LARGEST >> -shift), LARGEST >> -shift) << -shift


def predict(inputs: NDArray[np.int16], weights: NDArray[np.int8], numbers: Sequence[int], classes: NDArray[np.int8]) -> tuple[Ints, Ints]:
    """mean [n] (1/8 of a step) and scale [n] from inputs [D, n], weights [2, D] of both, numbers
    (bias and shift of both) and classes [n]."""
    sums = weights.astype(np.int64) @ inputs.astype(np.int64)
    fine = classes.astype(np.int64) + 2
    mean = (_shifted(sums[0] + numbers[0], numbers[1]).clip(-LARGEST, LARGEST) + (1 << fine >> 1)) >> fine
    scale = (_shifted(sums[1] + numbers[2], numbers[3]) + 32 - 8 * (fine - 2)).clip(0, TOP)
    return mean.astype(np.int32), scale.astype(np.int32)


def as_inputs(values: Ints, classes: NDArray[np.int8], factor: int, offset: int) -> NDArray[np.int16]:
    """Values [n] as inputs: (4 * 2^class value factor - offset) / 2^12 within +-2047, rounded."""
    fine = classes.astype(np.int64) + 2
    reach = ((1 << 29) // factor) >> fine
    scaled = values.astype(np.int64).clip(-reach, reach) << fine
    return ((scaled * factor - offset + 2048) >> 12).clip(-REACH, REACH).astype(np.int16)


def blend(columns: NDArray[np.int16], parents: Ints, weights: Ints) -> NDArray[np.int16]:
    """The weighted means [C, n] of columns [C, N] at parents [n, 4]; weights [n, 4] in 1/256."""
    return ((columns[:, parents].astype(np.int64) * weights).sum(2) >> 8).astype(np.int16)


def find_parents(cells: Ints, rows: Ints, coarse: Ints) -> tuple[Ints, Ints]:
    """The two rows before and the two after each of rows [n] among coarse [m], both ascending, and
    their weights by the distance of cells [N, 3]: [n, 4] both."""
    place = np.searchsorted(coarse, rows)[:, None] + np.arange(-2, 2)
    there = (place >= 0) & (place < len(coarse))
    parents = np.where(there, coarse[place.clip(0, max(len(coarse) - 1, 0))], 0) if len(coarse) else np.zeros_like(place)
    away = np.abs(cells[rows][:, None].astype(np.int64) - cells[parents]).sum(2)
    share = np.where(there, 65536 // (away + 1), 0)
    total = share.sum(1, keepdims=True)
    return parents.astype(np.int32), np.where(total > 0, share * 256 // np.maximum(total, 1), 0).astype(np.int32)


def restore(whole: Ints, steps: Floats, scale: Floats | None) -> Floats:
    """The values [N, C] of whole numbers [C, N] in steps [C] times scale [N] (None: 1)."""
    found = whole.astype(np.float32) * steps[:, None]
    return np.ascontiguousarray((found if scale is None else found * scale).T)
