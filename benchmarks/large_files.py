"""Makes large honest files, opens them, and prints the time and the memory of each (docs/security.md).

python benchmarks/large_files.py [--share 1.0] [--only ply,compact,capture,hostile]: a PLY file of 10 million Gaussians (2.5 GB; its reader
takes three times that in memory), a compact file of 2 million anchors and a capture of 5,000 views, or a share of these numbers; and
hostile files of 12 and 24 MB that would unpack to 1.25 GiB.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch


def make_ply(folder: Path, share: float) -> Callable[[], Any]:
    """3DGS's PLY of 10 million Gaussians of degree 3."""
    from scene_experts.files.formats import ply
    from scene_experts.files.formats.splats import Splats

    n = int(10_000_000 * share)
    new = lambda *shape: torch.randn(*shape)  # noqa: E731
    ply.write(folder / "large.ply", Splats(new(n, 3), new(n, 3), new(n, 4), new(n), new(n, 16, 3)), {})
    return lambda: ply.read(folder / "large.ply")


def make_compact(folder: Path, share: float) -> Callable[[], Any]:
    """A compact file of 2 million anchors."""
    from scene_experts.files.anchors.data import AnchorData
    from scene_experts.files.formats import compact

    n = int(2_000_000 * share)
    cells = torch.randint(0, 4000, (n, 3))
    columns = {"feature": torch.randn(n, 32), "offsets": torch.randn(n, 10, 3), "log_scaling": torch.randn(n, 6) - 4}
    networks = {f"{a}.experts.w1": torch.randn(1, 32, 35) for a in ("opacity", "cov", "color")}
    about = {"step": 30_000, "add_dist": {}}
    data = AnchorData({"xyz": cells * 0.01, **columns}, networks, about, cells, 0.01, (0.0, 0.0, 0.0), (), 30_000)
    compact.write(folder / "large.compact", data, {})
    return lambda: compact.read(folder / "large.compact")


def make_capture(folder: Path, share: float) -> Callable[[], Any]:
    """A COLMAP capture of 5,000 views of 640 x 480 px with 2,000 observations each, and of a million points."""
    from PIL import Image

    from scene_experts.data import capture
    from scene_experts.data.lens import Lens
    from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model

    views, points = int(5000 * share), int(1_000_000 * share)
    rng = np.random.default_rng(0)
    (folder / "images").mkdir()
    Image.fromarray(rng.integers(0, 255, (480, 640, 3), np.uint8)).save(folder / "first.jpg")
    data, images = (folder / "first.jpg").read_bytes(), []
    for i in range(views):
        (folder / "images" / f"{i:05d}.jpg").write_bytes(data)
        angle = 2 * np.pi * i / views
        q = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
        images.append(ColmapImage(i + 1, f"{i:05d}.jpg", q, (0.0, 0.0, 4.0), 1))
    xyz, rgb = rng.normal(size=(points, 3)), rng.integers(0, 255, (points, 3), np.uint8)
    lens = Lens("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    write_model(folder / "sparse" / "0", Model({1: lens}, tuple(images), np.arange(points), xyz, rgb, np.ones(points)))
    return lambda: capture.load(folder)


def make_hostile(folder: Path, share: float) -> Callable[[], Any]:
    """Files of 12 and 24 MB (more with a share above 1) that unpack to 1.25 GiB or declare as much: SPZ, SOG, compact, networks, glTF."""
    import gzip
    import io
    import json
    import struct
    import zipfile

    from scene_experts.core.errors import InputError
    from scene_experts.files.archive.torch_archive import read_tensors
    from scene_experts.files.formats import compact, glb, sog, spz

    zeros, most = bytes(64 << 20), 5 << 28
    packed = gzip.compress(zeros, 6)
    head = spz.HEADER.pack(spz.MAGIC, 3, most // 64, 3, 12, 0, 0)
    cases: list[tuple[str, Callable[[Path], Any]]] = []

    def make_zip(path: Path, names: list[str], padding: int) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
            for name in names:
                with archive.open(name, "w", force_zip64=True) as member:
                    for _ in range(most // len(zeros)):
                        member.write(zeros)
            archive.writestr(zipfile.ZipInfo("padding"), np.random.default_rng(0).bytes(padding))

    for size in (int(12e6 * max(1, share)), int(24e6 * max(1, share))):
        path = folder / f"{size}.spz"
        body = gzip.compress(head) + packed * (most // len(zeros))
        path.write_bytes(body + gzip.compress(np.random.default_rng(0).bytes(max(0, size - len(body))), 0))
        cases.append((path.name, spz.read))
        make_zip(folder / f"{size}.sog", ["meta.json"], size)
        cases.append((f"{size}.sog", sog.read))
        make_zip(folder / f"{size}.pt", ["x/data.pkl"], size)
        cases.append((f"{size}.pt", read_tensors))
        for name, form, read in (("compact", "<Q", compact.read), ("glb", "<III", glb.read)):
            text = json.dumps({"asset": {"version": "2.0"}, "accessors": [{"count": most, "type": "VEC3", "componentType": 5126}] * 1000})
            data = struct.pack(form, *((len(text),) if form == "<Q" else (0x46546C67, 2, size))) + text.encode()
            (folder / f"{size}.{name}").write_bytes(data + bytes(max(0, size - len(data))))
            cases.append((f"{size}.{name}", read))
    buffer = io.StringIO()

    def read_all() -> None:
        for name, read in cases:
            began = time.process_time()
            Path("/proc/self/clear_refs").write_text("5")
            try:
                read(folder / name)
                said = "accepted"
            except InputError:
                said = "refused"
            peak = next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
            print(f"  {name}: {said}, {time.process_time() - began:.2f} s CPU, peak of the process {peak / 2**20:.2f} GiB", file=buffer)
        print(buffer.getvalue(), end="")

    return read_all


MAKE = {"ply": make_ply, "compact": make_compact, "capture": make_capture, "hostile": make_hostile}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0)
    parser.add_argument("--only", default=",".join(MAKE))
    args = parser.parse_args()
    for name in args.only.split(","):
        with tempfile.TemporaryDirectory() as folder:
            read = MAKE[name](Path(folder), args.share)
            size = sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file())
            began, cpu = time.perf_counter(), time.process_time()
            read()
            took, used = time.perf_counter() - began, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{name}: {size / 1e6:.0f} MB, opened in {took:.2f} s ({used:.2f} s CPU); peak of the process {peak:.2f} GiB", flush=True)


if __name__ == "__main__":
    main()
