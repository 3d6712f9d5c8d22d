"""The file of the first web viewers: 32 bytes per Gaussian, one colour each.

There is no header and no harmonic above the constant. A row holds position and scales in float32,
colour and opacity in 8 bits each, and the quaternion (w, x, y, z) as 128 q + 128 in 8 bits each.
The largest Gaussians come first, for viewers that show a file while it loads.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.source import opening
from scene_experts.files.formats.pack import alphas, byte_logits, tensor, to_bytes, unit_quats
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import Format
from scene_experts.geometry.sh import C0

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def write(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the file. It has no room for the note."""
    table = np.zeros(len(splats), ROW)
    opacity = alphas(splats)
    table["means"], table["scales"] = splats.means, splats.log_scales.double().exp()
    table["rgba"][:, :3] = to_bytes(splats.sh[:, 0].double().numpy() * C0 + 0.5)
    table["rgba"][:, 3] = to_bytes(opacity)
    table["quats"] = np.clip(np.rint(unit_quats(splats) * 128 + 128), 0, 255)
    size = splats.log_scales.double().sum(1).numpy() + np.log(np.maximum(opacity, 1e-30))
    write_bytes(path, table[np.argsort(-size, kind="stable")].tobytes())


def read(path: Path) -> Splats:
    """The Gaussians of a file, of degree 0. Raises InputError for a size or values that no such
    file has."""
    with opening(path, budget.SPLAT) as source:
        data = source.read()
        if len(data) % ROW.itemsize:
            raise CutShort(f"{len(data):,} bytes, which is not a multiple of {ROW.itemsize}")
        table = np.frombuffer(data, ROW)
        scales = table["scales"].astype(np.float64)
        if not (np.isfinite(table["means"]).all() and np.isfinite(scales).all() and (scales >= 0).all()):
            raise Damaged("positions or scales that are not finite")
        quats = (table["quats"].astype(np.float64) - 128) / 128
        quats[(quats == 0).all(1)] = [1, 0, 0, 0]
        colors = (table["rgba"][:, :3].astype(np.float64) / 255 - 0.5) / C0
        return Splats(
            means=tensor(table["means"]),
            log_scales=tensor(np.log(np.maximum(scales, 1e-30))),
            quats=tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
            opacity_logit=tensor(byte_logits(table["rgba"][:, 3])),
            sh=tensor(colors[:, None]),
        ).checked(path)


def looks_like(path: Path, head: bytes) -> bool:
    """Whether a file without a signature is one: by its name, or by positions and scales that make
    sense in its first rows."""
    size = path.stat().st_size
    if path.suffix.lower() == ".splat":
        return True
    if size == 0 or size % ROW.itemsize:
        return False
    rows = np.frombuffer(head[: len(head) // ROW.itemsize * ROW.itemsize], ROW)
    scales = rows["scales"]
    plausible = np.isfinite(rows["means"]) & (np.abs(rows["means"]) < 1e6) & (scales > 1e-12) & (scales < 1e6)
    return bool(plausible.all())


FORMAT = Format(
    suffix=".splat",
    write=write,
    read=read,
    looks_like=looks_like,
    sh_degree=0,
)
