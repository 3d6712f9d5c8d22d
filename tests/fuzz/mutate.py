"""Mutations of bytes, texts and JSON values. The same random generator gives the same mutation."""

from __future__ import annotations

import json
import random
import re
from typing import Any

NUMBERS = (0, -1, 1, 2, 127, 128, 255, 256, 32767, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53, 2**62, 2**63 - 1, 2**64 - 1)
TEXTS = ("1e999", "-1e308", "3e38", "1e30", "NaN", "nan", "inf", "-0", "0x10", "9" * 5000, "", "../../x", "a\0b", "\u202e", "[" * 2000)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 1e308, -1e308, 1e-308, 3e38, 1e30, 2**31, 2**32, 2**62, 2**64, 10**40,
    "", "x", "../../etc/passwd", "x" * 3000, [], {}, [[]], [None], {"type": "Train"}, float("nan"), float("inf"),
)  # fmt: skip


def mutate(data: bytes, rng: random.Random, other: bytes = b"") -> bytes:
    """Return `data` after one to a few mutations. `other` is a file to splice parts from."""
    if data[:1] in (b"{", b"[") and rng.random() < 0.6:
        try:
            return mutate_json(data, rng)
        except (ValueError, RecursionError):
            pass
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        out = _mutate_once(out, rng, other)
    return bytes(out)


def _mutate_once(data: bytearray, rng: random.Random, other: bytes) -> bytearray:
    at = rng.randrange(len(data)) if data else 0
    end = min(len(data), at + rng.choice((1, 2, 4, 8, 16, 64, 512)))
    kind = rng.randrange(9)
    if kind == 0 and data:  # a bit
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1 and data:  # a number
        width = rng.choice((1, 2, 4, 8))
        value = rng.choice(NUMBERS) % (1 << 8 * width)
        data[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[at:end]
    elif kind == 4:
        data[at:at] = data[at:end] * rng.choice((1, 2, 100))
    elif kind == 5:
        data[at:end] = rng.randbytes(end - at)
    elif kind == 6 and other:
        start = rng.randrange(len(other))
        data[at:end] = other[start : start + rng.choice((4, 32, 256))]
    elif kind == 7:  # a word of a text, or of a header
        words = list(re.finditer(rb"[-+.\w]+", bytes(data[:65536])))
        if words:
            word = rng.choice(words)
            new = rng.choice(TEXTS) if rng.random() < 0.5 else str(rng.choice(NUMBERS))
            data[word.start() : word.end()] = new.encode("utf-8", "replace")
    elif kind == 8 and data:  # a special float
        data[at : at + 4] = rng.choice((b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\0\0\x80\xff", b"\x01\0\0\0"))
    return data


def mutate_json(data: bytes | str, rng: random.Random) -> bytes:
    """Return JSON text with one to a few values replaced, removed, repeated or nested deeply."""
    value = json.loads(data)
    text = json.dumps(value)
    for _ in range(rng.choice((1, 1, 2, 5))):
        value = _mutate_value(value, rng)
        text = json.dumps(value)
        if len(text) > 1 << 22:  # a part was repeated: more of it would only be slow to make
            break
        value = json.loads(text)  # repeated parts are the same object until here
    if rng.random() < 0.05:
        text = text.replace("0", "9" * 5000, 1)
    if rng.random() < 0.05:
        text = "[" * 100_000 + text
    return text.encode()


def _mutate_value(value: Any, rng: random.Random) -> Any:
    places = list(_places(value))
    if not places:
        return rng.choice(VALUES)
    holder, key = rng.choice(places)
    kind = rng.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.extend([holder[key]] * rng.choice((1, 10, 1000)))
    elif kind == 2 and isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool):
        holder[key] = holder[key] * rng.choice((-1, 0, 2, 1e10, 1e-10, 1e300)) if rng.random() < 0.5 else rng.choice(NUMBERS)
    elif kind == 3 and isinstance(holder, dict):
        holder[rng.choice(("type", "x", "count", "voxel"))] = holder[key]
    elif kind == 4:
        deep: Any = holder[key]
        for _ in range(rng.choice((1, 40, 500))):
            deep = [deep]
        holder[key] = deep
    else:
        holder[key] = rng.choice(VALUES)
    return value


def _places(value: Any) -> Any:
    """Every (container, key) of a nested value."""
    todo = [value]
    while todo:
        found = todo.pop()
        keys = list(found) if isinstance(found, dict) else range(len(found)) if isinstance(found, list) else ()
        for key in keys:
            yield found, key
            if isinstance(found[key], (dict, list)):
                todo.append(found[key])
