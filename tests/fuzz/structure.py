"""Mutations that know how a file is built: they reach code behind the checks of sizes, checksums and magic numbers.

Each function returns the bytes after one mutation. `mutate_structure` chooses by the content of the file.
"""

from __future__ import annotations

import gzip
import io
import json
import random
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable

NAMES = (
    "../outside",
    "/etc/passwd",
    "a/../../b",
    "C:\\x",
    "a\0b",
    "\U0001f600",
    "e\u0301" * 40,
    "\u202egnp.a",
    "x" * 5000,
    ".",
    "",
    "con",
    "a//b",
)
WORDS = (
    "NaN",
    "-inf",
    "1e400",
    "-1e-400",
    "1_000",
    "\u0661\u0662",
    "+5",
    "0x1p3",
    "9" * 400,
    "-" * 50,
    "\ufeff",
    "\u2028",
    "\0",
    "'",
    '"',
    "\x85",
)
DTYPES = ("F64", "F32", "F16", "BF16", "F8_E4M3", "I64", "I32", "U8", "BOOL", "C64", "X")


def mutate_structure(data: bytes, rng: random.Random) -> bytes:
    """Return `data` after one mutation of its structure. Raises an exception for a file that is damaged already."""
    kinds: list[Callable[[bytes, random.Random], bytes]] = [lengths, blocks]
    if data[:4] == b"\x89PNG":
        kinds = [png_chunks] * 4 + kinds
    elif data[:2] == b"\xff\xd8":
        kinds = [jpeg_segments] * 4 + kinds
    elif data[:4] == b"RIFF":
        kinds = [riff_chunks] * 4 + kinds
    elif data[:4] in (b"II*\0", b"MM\0*"):
        kinds = [tiff_entries] * 6 + kinds
    elif data[:2] == b"PK":
        kinds = [zip_entries] * 6 + kinds
    elif data[:2] == b"\x1f\x8b":
        kinds = [gzip_stream] * 6 + kinds
    elif data[:4] == b"glTF":
        kinds = [glb_chunks] * 3 + kinds
    elif data[:3] == b"ply":
        kinds = [header_lines] * 4 + kinds
    elif data[8:10] == b'{"':
        kinds = [safetensors_header] * 6 + kinds
    elif data[:1] in (b"{", b"["):
        kinds = [json_text] * 3 + [blocks]
    elif _is_text(data):
        kinds = [text_lines]
    return rng.choice(kinds)(data, rng)


def lengths(data: bytes, rng: random.Random) -> bytes:
    """A length, count or offset changed: a number of 2 to 8 bytes whose value could be one."""
    out, size = bytearray(data), len(data)
    found = []
    for at in range(0, min(size - 8, 4096), 2):
        for width in (2, 4, 8):
            value = int.from_bytes(data[at : at + width], "little")
            if 0 < value <= size:
                found.append((at, width, value))
    if not found:
        return blocks(data, rng)
    at, width, value = rng.choice(found)
    new = rng.choice(
        (value - 1, value + 1, 2 * value, value * 1000, 0, size, size - at, -1, 1 << (8 * width - 1), (1 << (8 * width - 1)) - 1)
    )
    out[at : at + width] = (new % (1 << 8 * width)).to_bytes(width, "little")
    return bytes(out)


def blocks(data: bytes, rng: random.Random) -> bytes:
    """Two blocks of equal size swapped, or one written over another or repeated."""
    width = rng.choice((4, 8, 12, 16, 64, 256))
    a, b = (rng.randrange(max(1, len(data) // width)) * width for _ in range(2))
    a, b = min(a, b), max(a, b)
    first, second = data[a : a + width], data[b : b + width]
    kind = rng.randrange(3)
    if kind == 0 and b >= a + width:
        return data[:a] + second + data[a + width : b] + first + data[b + width :]
    if kind == 1:
        return data[:b] + first + data[b + len(first) :]
    return data[:b] + first + data[b:]


def shuffle(parts: list[bytes], rng: random.Random) -> list[bytes]:
    """Parts of a file after one was dropped, repeated, moved, cut or emptied."""
    parts, at, kind = list(parts), rng.randrange(len(parts)), rng.randrange(5)
    if kind == 0:
        del parts[at]
    elif kind == 1:
        parts[at:at] = [parts[at]] * rng.choice((1, 3, 500))
    elif kind == 2:
        parts.insert(rng.randrange(len(parts)), parts.pop(at))
    elif kind == 3:
        parts[at] = parts[at][: rng.randrange(len(parts[at]) + 1)]
    else:
        other = rng.randrange(len(parts))
        parts[at], parts[other] = parts[other], parts[at]
    return parts


def png_chunks(data: bytes, rng: random.Random) -> bytes:
    """Chunks in another order, or one with other content, under fresh checksums."""
    chunks, at = [], 8
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if rng.random() < 0.5:
        i = rng.randrange(len(chunks))
        name, body = chunks[i]
        kind = rng.randrange(4)
        if name == b"IHDR" and kind < 3:
            width, height = (rng.choice((0, 1, 16, 0xFFFF, 1 << 20, 0x7FFFFFFF, 0xFFFFFFFF)) for _ in range(2))
            body = struct.pack(">II", width, height) + bytes(
                [rng.choice((1, 2, 4, 8, 16, 3)), rng.choice((0, 2, 3, 4, 6, 1)), 0, 0, rng.choice((0, 1, 2))]
            )
        elif name == b"IDAT" and kind < 3:
            raw = zlib.decompress(body)
            body = rng.choice(
                (zlib.compress(raw[:-9]), zlib.compress(raw + bytes(1 << 22)), zlib.compress(raw)[:-6], zlib.compress(b"\7" + raw[1:]), b"")
            )
        else:
            body = flip(body, rng)
        chunks[i] = (name, body)
    else:
        text = b"x\0\0" + zlib.compress(bytes(1 << 24))
        extra = rng.choice(
            (
                (b"zTXt", text),
                (b"iCCP", text),
                (b"PLTE", b"\0" * 7),
                (b"acTL", b"\xff" * 8),
                (b"tRNS", b"\0" * 3),
                (b"eXIf", b"II*\0\xff\xff\xff\xff"),
            )
        )
        chunks.insert(rng.randrange(1, len(chunks) + 1), extra)
    packed = [struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks]
    return data[:8] + b"".join(shuffle(packed, rng) if rng.random() < 0.4 else packed)


def jpeg_segments(data: bytes, rng: random.Random) -> bytes:
    """Segments dropped, repeated or in another order, or one with another length or content."""
    parts, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        size = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        parts.append(data[at : at + size])
        at += size
    if rng.random() < 0.5:
        i = rng.randrange(len(parts))
        body = bytearray(parts[i])
        place = rng.choice((2, 4, 5, 7, 9, rng.randrange(len(body))))
        body[place : place + 2] = struct.pack(">H", rng.choice((0, 1, 2, 255, 65535, 65500, len(body))))
        parts[i] = bytes(body)
    else:
        parts = shuffle(parts, rng)
    return data[:2] + b"".join(parts) + data[at:]


def riff_chunks(data: bytes, rng: random.Random) -> bytes:
    """Chunks of a WebP dropped, repeated, cut or with another size."""
    chunks, at = [], 12
    while at + 8 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        chunks.append(data[at : at + 8 + size + size % 2])
        at += 8 + size + size % 2
    if rng.random() < 0.4:
        header = (
            b"VP8X"
            + struct.pack("<I", 10)
            + bytes([rng.randrange(256), 0, 0, 0])
            + rng.choice((b"\xff" * 6, b"\0" * 6, b"\x0f\0\0\x0b\0\0"))
        )
        chunks.insert(rng.randrange(len(chunks) + 1), rng.choice((header, b"ANMF" + struct.pack("<I", 16) + b"\xff" * 16)))
    if rng.random() < 0.5:
        i = rng.randrange(len(chunks))
        chunks[i] = chunks[i][:4] + struct.pack("<I", rng.choice((0, 1, 0xFFFFFFFF, 0x7FFFFFFE, len(chunks[i])))) + flip(chunks[i][8:], rng)
    body = b"".join(shuffle(chunks, rng))
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


def tiff_entries(data: bytes, rng: random.Random) -> bytes:
    """A tag of the directory with another type, count or value; directories in a circle."""
    order = "<" if data[:2] == b"II" else ">"
    start = struct.unpack_from(order + "I", data, 4)[0]
    count = struct.unpack_from(order + "H", data, start)[0]
    out, at = bytearray(data), start + 2 + 12 * rng.randrange(count)
    kind = rng.randrange(6)
    if kind == 0:
        struct.pack_into(order + "H", out, at + 2, rng.choice((0, 1, 2, 3, 4, 5, 7, 11, 12, 13, 16, 255)))
    elif kind == 1:
        struct.pack_into(order + "I", out, at + 4, rng.choice((0, 2, 1000, 1 << 20, 0xFFFFFFFF)))
    elif kind == 2:
        struct.pack_into(order + "I", out, at + 8, rng.choice((0, 1, 8, start, len(data), 1 << 16, 1 << 30, 0xFFFFFFFF)))
    elif kind == 3:
        struct.pack_into(
            order + "H", out, at, rng.choice((256, 257, 258, 259, 262, 273, 277, 278, 279, 284, 317, 322, 323, 324, 338, 339, 347, 34675))
        )
    elif kind == 4 and start + 6 + 12 * count <= len(data):
        struct.pack_into(order + "I", out, start + 2 + 12 * count, rng.choice((start, 8, len(data) - 2)))
    else:
        struct.pack_into(order + "H", out, start, rng.choice((0, 1, count - 1, count + 1, 65535)))
    return bytes(out)


def zip_entries(data: bytes, rng: random.Random) -> bytes:
    """Names that lead out, links, names that are there twice, other methods, wrong sizes, many members, cut streams."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info, archive.read(info)) for info in archive.infolist()]
    at, kind = rng.randrange(len(members)), rng.randrange(9)
    info, body = members[at]
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for i, (found, content) in enumerate(members):
            new = zipfile.ZipInfo(found.filename)
            if i == at and kind == 0:
                new.filename = rng.choice(NAMES).encode("utf-8", "replace").decode()
            if i == at and kind == 1:
                new.external_attr, content = (stat.S_IFLNK | 0o777) << 16, b"../../../etc/passwd"
            if i == at and kind == 2:
                new.compress_type = rng.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
            archive.writestr(new, content)
        if kind == 3:
            archive.writestr(zipfile.ZipInfo(info.filename), rng.choice((b"", body[::-1], body + body)))
        if kind == 4:
            for i in range(rng.choice((10, 3000))):
                archive.writestr(zipfile.ZipInfo(f"{i}/{rng.choice(NAMES)[:20]}"), b"")
    out = bytearray(stream.getvalue())
    place = out.rfind(b"PK\1\2")
    if kind == 5 and place >= 0:  # sizes, offset or flags of the list of members
        struct.pack_into("<I", out, place + rng.choice((20, 24, 42)), rng.choice((0, 1, len(out), 0x7FFFFFFF, 0xFFFFFFFF, 0xFFFFFFFE)))
    if kind == 6 and place >= 0:
        struct.pack_into("<H", out, place + rng.choice((8, 10, 28, 30, 32)), rng.choice((1, 8, 12, 99, 0x800, 0xFFFF)))
    if kind == 7:
        return bytes(out[: rng.randrange(len(out))]) + bytes(out[-22:])
    if kind == 8:
        end = out.rfind(b"PK\5\6")
        struct.pack_into("<H", out, end + rng.choice((8, 10)), rng.choice((0, 1, 0xFFFF)))
        struct.pack_into("<I", out, end + rng.choice((12, 16)), rng.choice((0, 1, len(out), 0xFFFFFFFF)))
    return bytes(out)


def gzip_stream(data: bytes, rng: random.Random) -> bytes:
    """A stream that is cut, doubled, has a wrong checksum, or is a bomb; content whose header has other counts."""
    raw, kind = gzip.decompress(data), rng.randrange(7)
    if kind == 0:
        return data[: rng.randrange(len(data))]
    if kind == 1:
        return data + data
    if kind == 2:
        return data[:-8] + rng.randbytes(8)
    if kind == 3:
        return gzip.compress(raw + bytes(1 << 26), 1)
    if kind == 4:
        return gzip.compress(raw[: rng.randrange(len(raw))], 1)
    return gzip.compress(lengths(raw, rng) if kind == 5 else blocks(raw, rng), 1)


def glb_chunks(data: bytes, rng: random.Random) -> bytes:
    """Chunks dropped, repeated, in another order, or with another length."""
    chunks, at = [], 12
    while at + 8 <= len(data):
        size = struct.unpack_from("<I", data, at)[0]
        chunks.append(data[at : at + 8 + size])
        at += 8 + size
    if rng.random() < 0.5:
        i = rng.randrange(len(chunks))
        chunks[i] = struct.pack("<I", rng.choice((0, 1, 3, len(data), 0x7FFFFFFF, 0xFFFFFFFF))) + chunks[i][4:]
    else:
        chunks = shuffle(chunks, rng)
    body = b"".join(chunks)
    return data[:8] + struct.pack("<I", rng.choice((12 + len(body), 12 + len(body), 0, 0xFFFFFFFF))) + body


def header_lines(data: bytes, rng: random.Random) -> bytes:
    """Lines of a PLY header dropped, repeated or in another order, or a word changed."""
    end = data.index(b"end_header\n")
    lines = data[:end].splitlines(keepends=True)
    if rng.random() < 0.5:
        i = rng.randrange(1, len(lines))
        words = lines[i].split()
        new = rng.choice(
            (
                b"double",
                b"uchar",
                b"int",
                b"list",
                b"float64",
                b"-1",
                b"0",
                b"1e9",
                b"9" * 20,
                b"18446744073709551616",
                b"x\0y",
                b"\xff",
                b"x" * 3000,
            )
        )
        words[rng.randrange(len(words))] = new
        lines[i] = b" ".join(words) + b"\n"
        return b"".join(lines) + data[end:]
    return lines[0] + b"".join(shuffle(lines[1:], rng)) + data[end:]


def safetensors_header(data: bytes, rng: random.Random) -> bytes:
    """Types, shapes or places of tensors changed, entries that are there twice, under a header of the right length."""
    size = int.from_bytes(data[:8], "little")
    head = json.loads(data[8 : 8 + size])
    names = [name for name in head if name != "__metadata__"]
    a, b = rng.choice(names), rng.choice(names)
    kind, twice = rng.randrange(9), ""
    if kind == 0:
        head[a]["dtype"] = rng.choice(DTYPES)
    elif kind == 1:
        head[a]["shape"] = rng.choice(
            ([], [0], [-1], [1 << 62, 4], [2**64], [1] * 500, head[a]["shape"][::-1], [*head[a]["shape"], 1], [1.5], None)
        )
    elif kind == 2:
        head[a]["data_offsets"] = rng.choice(
            (head[b]["data_offsets"], [0, 0], [8, 0], [0, 1 << 60], [-8, 0], [0], head[a]["data_offsets"][::-1])
        )
    elif kind == 3:
        head[a], head[b] = head[b], head[a]
    elif kind == 4:
        head[rng.choice(NAMES).encode("utf-8", "replace").decode()] = head.pop(a)
    elif kind == 5:
        twice = f",{json.dumps(a)}:{json.dumps(head[b])}}}"
    elif kind == 6:
        head["__metadata__"] = rng.choice(
            ({}, None, [], {"x": 1}, {"format": {}}, {"x" * 5000: "y"}, dict.fromkeys(map(str, range(9000)), "z"))
        )
    elif kind == 7:
        head[a] = rng.choice((None, [], {}, {"dtype": "F32"}, {**head[a], "more": 1}))
    else:
        return data[: rng.randrange(8 + size, len(data) + 1)]
    text = json.dumps(head)
    text = text[:-1] + twice if twice else text
    return len(text.encode()).to_bytes(8, "little") + text.encode() + data[8 + size :]


def json_text(data: bytes, rng: random.Random) -> bytes:
    """JSON as a text: a name that is there twice, numbers and texts in other forms, another encoding, a cut end."""
    text, kind = data.decode(), rng.randrange(9)
    if kind == 0:
        pairs = list(re.finditer(r'"[^"]*"\s*:\s*[^,{}\[\]]+', text))
        pair = rng.choice(pairs)
        name = pair[0].partition(":")[0]
        return (text[: pair.end()] + f", {name}: {rng.choice(('null', '-1', '[]', '1e999'))}" + text[pair.end() :]).encode()
    if kind == 1:
        found = rng.choice(list(re.finditer(r"-?\d[\d.eE+-]*", text)))
        new = rng.choice(
            (
                "-0",
                "-0.0",
                "1e-400",
                "1E400",
                "Infinity",
                "-Infinity",
                "NaN",
                "0." + "1" * 4000,
                "1" * 4400,
                "true",
                '"1"',
                "1e5",
                "2147483648",
                "-9223372036854775809",
            )
        )
        return (text[: found.start()] + new + text[found.end() :]).encode()
    if kind == 2:
        found = rng.choice(list(re.finditer(r'"[^"\\]*"', text)))
        new = rng.choice(("\\ud800", "\\u0000", "\\udfff\\ud800", *(json.dumps(name)[1:-1] for name in NAMES)))
        return (text[: found.start()] + f'"{new}"' + text[found.end() :]).encode()
    if kind == 3:
        return text.encode(rng.choice(("utf-16", "utf-32", "utf-8-sig", "utf-16-be")))
    if kind == 4:
        return text[: rng.randrange(len(text))].encode()
    if kind == 5:
        return (text + rng.choice((text, "\0", "]", " " * 100_000, "//x"))).encode()
    if kind == 6:
        return text.replace(rng.choice(("[", "{")), rng.choice(("[" * 900, '{"a":' * 900, "[[")), 1).encode()
    if kind == 7:
        first, second = rng.choice(_values(text)), rng.choice(_values(text))
        return (text[: first[0]] + text[second[0] : second[1]] + text[first[1] :]).encode()
    return data.replace(b'"', b"'", rng.choice((1, -1)))


def text_lines(data: bytes, rng: random.Random) -> bytes:
    """Lines in another order, repeated or cut, words replaced, other ends of lines."""
    lines, kind = data.splitlines(keepends=True), rng.randrange(5)
    if kind == 0:
        return b"".join(shuffle(lines, rng))
    if kind == 1:
        return data.replace(b"\n", rng.choice((b"\r", b"\r\n", b"\n\n", b"\0", b" ", b"\x0b", "\u2028".encode())))
    i = rng.randrange(len(lines))
    words = lines[i].split() or [b""]
    if kind == 2:
        words[rng.randrange(len(words))] = rng.choice((*WORDS, *NAMES)).encode("utf-8", "surrogatepass")
    elif kind == 3:
        words = shuffle(words, rng)
    else:
        words *= rng.choice((2, 1000))
    lines[i] = b" ".join(words) + b"\n"
    return b"".join(lines)


def flip(data: bytes, rng: random.Random) -> bytes:
    """One byte changed."""
    out = bytearray(data or b"\0")
    out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def _values(text: str) -> list[tuple[int, int]]:
    """Places of the flat values of a JSON text: numbers, texts, and lists and objects without others in them."""
    return [match.span() for match in re.finditer(r'"[^"]*"|-?\d[\d.eE+-]*|\[[^\[\]{}]*\]|\{[^\[\]{}]*\}', text)]


def _is_text(data: bytes) -> bool:
    return b"\0" not in data[:2000] and data[:2000].isascii()
