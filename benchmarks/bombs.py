"""Write hostile files of several sizes, read each in a process of its own, and print the memory and the time (docs/security.md).

    python benchmarks/bombs.py [--sizes 1 8 16 32] [--only spz sog ...]

Each file is valid and unpacks to as much as the budget of its format admits for its size: most of the file is padding that cannot be
compressed, and the rest compresses to nearly nothing. The memory is the peak above that of the process before it reads. Exit code 1 if
a file takes more than 1 GiB and 24 times its size, or more than 5 s.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HONEST = 24
"""Bytes in memory that a file honestly takes per byte: half-precision columns that compress by 2, decoded to float64, and a copy."""


def noise(count: int) -> bytes:
    """Return bytes that cannot be compressed, none of them 0."""
    return np.random.default_rng(0).integers(1, 256, max(0, count), np.uint8).tobytes()


def write_spz(path: Path, size: int, allowance: int) -> None:
    """Equal Gaussians of degree 3; the padding is the name in the gzip header."""
    from scene_experts.files.formats import pack, spz

    count = allowance // pack.decoded_bytes(3)
    raw = spz.HEADER.pack(spz.MAGIC, 3, count, 3, 12, 0, 0) + bytes(count * 9) + b"\x80" * count * (1 + 3 + 3 + 4 + 45)
    packed = gzip.compress(raw, 6, mtime=0)
    name = noise(size - len(packed)) + b"\0"
    path.write_bytes(packed[:3] + b"\x08" + packed[4:10] + name + packed[10:])


def write_spz4(path: Path, size: int, allowance: int) -> None:
    """The same in version 4, with padding before the table of streams."""
    import zstandard

    from scene_experts.files.formats import pack, spz

    count = allowance // pack.decoded_bytes(3)
    sizes = spz._sizes(4, count, 3)
    streams = [zstandard.ZstdCompressor().compress(b"\x00" * n if name == "positions" else b"\x80" * n) for name, n in sizes.items()]
    table = spz.V4_HEADER.size + max(0, size - sum(map(len, streams)))
    head = spz.V4_HEADER.pack(0x5053474E, 4, count, 3, 12, 0, len(streams), table)
    body = noise(table - len(head)) + b"".join(struct.pack("<QQ", len(s), n) for s, n in zip(streams, sizes.values())) + b"".join(streams)
    path.write_bytes(head + body)


def write_sog(path: Path, size: int, allowance: int) -> None:
    """Equal Gaussians of degree 3 in pictures of one colour, and a member of noise."""
    from PIL import Image

    from scene_experts.files.formats import pack

    count = (allowance - (1 << 20)) // pack.decoded_bytes(3) * 97 // 100  # the members count as well
    side = int(np.ceil(np.sqrt(count)))

    def picture(width: int, height: int, colour: tuple[int, int, int, int]) -> bytes:
        stream = io.BytesIO()
        Image.new("RGBA", (width, height), colour).save(stream, "WEBP", lossless=True, exact=True, method=0)
        return stream.getvalue()

    plain, turned, labels = (
        picture(side, side, (9, 9, 9, 255)),
        picture(side, side, (128, 128, 128, 252)),
        picture(side, side, (0, 0, 0, 255)),
    )
    book = np.linspace(-4, 4, 256).tolist()
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": [-1] * 3, "maxs": [1] * 3, "files": ["plain", "plain"]},
        "scales": {"codebook": book, "files": ["plain"]},
        "quats": {"files": ["turned"]},
        "sh0": {"codebook": book, "files": ["plain"]},
        "shN": {"count": 64, "bands": 3, "codebook": book, "files": ["rows", "labels"]},
    }
    members = {
        "meta.json": json.dumps(meta).encode(),
        "plain": plain,
        "turned": turned,
        "labels": labels,
        "rows": picture(960, 1, (1, 2, 3, 255)),
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**members, "padding": noise(size - sum(map(len, members.values())))}.items():
            archive.writestr(name, data)


def write_compact(path: Path, size: int, allowance: int) -> None:
    """Anchors in a row with equal columns, and a part of noise."""
    import torch

    from scene_experts.files.anchors import compact
    from scene_experts.files.anchors.data import AnchorData
    from scene_experts.files.codec import container, fit

    fit.STEPS, fit.ROWS = 0, 64  # there is nothing to fit
    K, F = 10, 32
    count = (allowance - (1 << 20)) // (compact.BYTES_PER_VALUE * (3 * K + F + 18))
    cells = torch.nn.functional.pad(torch.arange(count)[:, None], (0, 2))
    sizes = {"feature": (F,), "offsets": (K, 3), "log_scaling": (6,)}
    columns = {"xyz": cells.float()} | {name: torch.zeros(count, *rest) for name, rest in sizes.items()}
    networks = {f"{a}.experts.w1": torch.randn(1, 32, 35) for a in ("opacity", "cov", "color")}
    data = AnchorData(columns, networks, {"step": 1, "add_dist": {}}, cells, 0.01)
    header, parts = container.part(compact.encode(data)[0])
    path.write_bytes(container.join(header, parts | {"padding": noise(size - sum(map(len, parts.values())))}))


def write_glb(path: Path, size: int, allowance: int) -> None:
    """Accessors that all name the same bytes."""
    from scene_experts.files.formats import glb, gltf

    names = {"POSITION": "VEC3", f"{glb.NAME}:SCALE": "VEC3", f"{glb.NAME}:ROTATION": "VEC4", f"{glb.NAME}:OPACITY": "SCALAR"}
    names |= {f"{glb.NAME}:SH_DEGREE_{d}_COEF_{i}": "VEC3" for d in range(4) for i in range(2 * d + 1)}
    count = min(allowance // (8 * sum(gltf.WIDTHS[kind] for kind in names.values())), (size - 8192) // 4)
    accessors = [{"bufferView": 0, "componentType": 5121, "normalized": True, "count": count, "type": kind} for kind in names.values()]
    primitive = {"attributes": {name: i for i, name in enumerate(names)}, "mode": 0, "extensions": {glb.NAME: {}}}
    scene = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": [{"buffer": 0}]}
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    body = noise(size - len(text))
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def write_pt(path: Path, size: int, allowance: int) -> None:
    """A deflated tensor of zeros in a network file, and a member of noise."""
    import torch

    stream = io.BytesIO()
    torch.save({"w": torch.zeros((allowance - (1 << 20)) // 8)}, stream)
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name in old.namelist():
            archive.writestr(name, old.read(name))
        archive.writestr(zipfile.ZipInfo("archive/padding"), noise(size))


def write_png(path: Path, size: int, allowance: int) -> None:
    """A photograph of one colour, and a chunk of noise."""
    from PIL import Image

    side = int(np.sqrt(allowance / 4))
    stream = io.BytesIO()
    Image.new("RGB", (side, side), (9, 9, 9)).save(stream, "PNG")
    data, chunk = stream.getvalue(), noise(size - len(stream.getvalue()))
    padding = struct.pack(">I", len(chunk)) + b"teXt" + chunk + struct.pack(">I", zlib.crc32(b"teXt" + chunk))
    path.write_bytes(data[:33] + padding + data[33:])


def write_json(path: Path, size: int, allowance: int) -> None:
    """Empty lists, which take the most memory per byte."""
    path.write_bytes(b'{"a": [' + b"[]," * (size // 3) + b"[]]}")


def read_photograph(path: Path) -> Any:
    from scene_experts.data.images import FrameSource, decode, probe
    from scene_experts.data.lens import Lens

    width, height = probe(path).size
    return decode(FrameSource(path, Lens("PINHOLE", width, height, (9.0, 9.0, 4.0, 4.0)), (160, 160)))


def read_html(path: Path) -> Any:
    from scene_experts.files.formats import html

    return html.read(path)


def write_html(path: Path, size: int, allowance: int) -> None:
    """The SPZ file of equal Gaussians in a page with a comment of noise."""
    import base64

    from scene_experts.files.formats import html

    part = path.with_suffix(".part")
    write_spz(part, 0, allowance)
    scene = base64.b64encode(part.read_bytes())
    padding = base64.b64encode(noise((size - len(scene)) * 3 // 4))
    path.write_bytes(b"<!doctype html>" + html.MARK + b"<!--" + padding + b"-->" + html._SCENE + scene + b"</script>")


def formats() -> dict[str, tuple[Any, Callable[[Path, int, int], None], Callable[[Path], Any]]]:
    """Return the budget, the writer and the reader of each format."""
    from scene_experts.core.reading import budget
    from scene_experts.core.reading.plain import read_json
    from scene_experts.core.reading.torch_archive import read_tensors
    from scene_experts.files.anchors import compact
    from scene_experts.files.formats import glb, sog, spz

    return {
        "spz": (budget.SPZ, write_spz, spz.read),
        "spz4": (budget.SPZ, write_spz4, spz.read),
        "baked-html": (budget.HTML, write_html, read_html),
        "sog": (budget.SOG, write_sog, sog.read),
        "compact": (budget.COMPACT, write_compact, compact.read),
        "glb": (budget.GLB, write_glb, glb.read),
        "pt": (budget.NETWORK, write_pt, read_tensors),
        "png": (budget.PHOTOGRAPH, write_png, read_photograph),
        "json": (budget.JSON, write_json, lambda path: read_json(path, "JSON file")),
    }


def read_memory(name: str) -> int:
    """Return a line of /proc/self/status in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))


def read_one(kind: str, path: Path) -> None:
    """Read a file and print what it took as JSON."""
    from scene_experts.core.errors import InputError

    read = formats()[kind][2]
    Path("/proc/self/clear_refs").write_text("5")
    before, began = read_memory("VmRSS"), time.process_time()
    try:
        read(path)
        said = "accepted"
    except InputError as error:
        said = str(error).replace(str(path), "FILE")
    print(json.dumps({"said": said, "bytes": read_memory("VmHWM") - before, "seconds": time.process_time() - began}))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="*", type=float, default=[1, 8, 16, 32], help="sizes of the files in MB (default: 1 8 16 32)")
    parser.add_argument("--only", nargs="*", help="formats (default: all)")
    parser.add_argument("--read", nargs=2, metavar=("FORMAT", "FILE"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.read:
        read_one(args.read[0], Path(args.read[1]))
        return 0
    code = 0
    for kind, (budget, write, _) in formats().items():
        for megabytes in args.sizes if not args.only or kind in args.only else ():
            with tempfile.TemporaryDirectory() as folder:
                path, size = Path(folder) / f"bomb.{kind.rstrip('4')}", int(megabytes * 1e6)
                write(path, size, int(budget.allowance(size)))
                size = path.stat().st_size
                command = [sys.executable, __file__, "--read", kind, str(path)]
                done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
            if done.returncode:
                print(f"{kind:8s} {size / 1e6:6.1f} MB  exit code {done.returncode}: {done.stderr[-300:]}", flush=True)
                code = 1
                continue
            found = json.loads(done.stdout)
            beyond = found["bytes"] > (1 << 30) + max(0, HONEST * size) or found["seconds"] > 5
            code |= int(beyond)
            print(
                f"{kind:8s} {size / 1e6:6.1f} MB  {found['bytes'] / 2**20:7.0f} MiB {found['seconds']:6.2f} s  {found['said'][:90]}",
                flush=True,
            )
    return code


if __name__ == "__main__":
    sys.exit(main())
