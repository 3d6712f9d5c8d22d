"""Files that hide their content (deflated, zipped, under a checksum): mutations reach the content and pack it again."""

from __future__ import annotations

import gzip
import io
import json
import random
import struct
import zipfile
from pathlib import Path

import torch
from safetensors.torch import load, save

from fuzz.mutate import mutate, mutate_json
from scene_experts.core import checkpoint
from scene_experts.files.codec import container


def gzipped(data: bytes, rng: random.Random) -> bytes:
    return gzip.compress(mutate(gzip.decompress(data), rng), 1)


def zipped(data: bytes, rng: random.Random) -> bytes:
    """One member changed, left out, or a bomb."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, kind = rng.choice(sorted(members)), rng.randrange(12)
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[name] = bytes(rng.choice((1 << 20, 1 << 28)))
    elif kind == 2:
        members[name] = members[rng.choice(sorted(members))]
    else:
        name = next((n for n in members if n.endswith((".json", "data.pkl"))), name) if kind < 8 else name
        members[name] = mutate(members[name], rng)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if kind == 1 else zipfile.ZIP_STORED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return stream.getvalue()


def glb(data: bytes, rng: random.Random) -> bytes:
    """The description changed."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = mutate_json(data[20 : 20 + size], rng), data[20 + size :]
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + rest
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def tensors(data: bytes, rng: random.Random) -> bytes:
    """Metadata, values, shapes or types changed, under a fresh checksum."""
    size = int.from_bytes(data[:8], "little")
    head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"][checkpoint.KEY])
    found = load(data)
    name, kind = rng.choice(sorted(found)), rng.randrange(10)
    value = found[name].clone()
    if kind < 5:
        try:
            head["meta"] = json.loads(mutate_json(json.dumps(head["meta"]), rng))
        except (ValueError, RecursionError):
            head["meta"] = {}
    elif kind == 5:
        del found[name]
    elif kind == 6 and value.is_floating_point() and value.numel():
        value.view(-1)[rng.randrange(value.numel())] = rng.choice((float("nan"), float("inf"), 3e38, -1e30))
        found[name] = value
    elif kind == 7:
        found[name] = value.to(rng.choice((torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool, torch.float64)))
    elif kind == 8:
        found[name] = value[: len(value) // 2].clone() if value.dim() else value[None]
    elif value.dtype == torch.uint8 and value.numel():
        raw = mutate(bytes(value.numpy().tobytes()), rng)
        found[name] = torch.frombuffer(bytearray(raw or b"\0"), dtype=torch.uint8)
    else:
        found[name] = value.unsqueeze(0)
    head["sha256"] = checkpoint.digest(found)
    try:
        return save(found, {checkpoint.KEY: json.dumps(head)})
    except UnicodeEncodeError:
        return data


def compact(data: bytes, rng: random.Random) -> bytes:
    """The header or a part of a compact file changed, under a fresh checksum."""
    header, parts = container.part(data)
    name, kind = rng.choice(sorted(parts)), rng.randrange(8)
    if kind < 3:
        try:
            changed = json.loads(mutate_json(json.dumps(header), rng))
            header = changed if isinstance(changed, dict) else {}
        except (ValueError, RecursionError):
            header = {}
    elif kind == 3:
        del parts[name]
    elif kind == 4:
        parts[name] = parts[rng.choice(sorted(parts))]
    else:
        parts[name] = mutate(parts[name], rng)
    try:
        return container.join(header, parts)
    except (ValueError, TypeError, RecursionError):  # numbers that JSON does not have
        return data


def write(folder: Path, files: dict[str, bytes]) -> None:
    """Write the files of an input into a folder."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
