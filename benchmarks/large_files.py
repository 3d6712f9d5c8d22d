"""Makes large honest files, opens them, and prints the time and the memory of each (docs/security.md).

python benchmarks/large_files.py [--share 1.0] [--only ply,compact,capture]: a PLY file of 10 million Gaussians (2.5 GB; its reader
takes three times that in memory), a compact file of 2 million anchors and a capture of 5,000 views, or a share of these numbers.
Hostile files are in `bombs.py`.
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
    from scene_experts.files.anchors import compact
    from scene_experts.files.anchors.data import AnchorData

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
    from scene_experts.data.settings import Data

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
    return lambda: capture.load(Data(folder))


MAKE = {"ply": make_ply, "compact": make_compact, "capture": make_capture}


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
