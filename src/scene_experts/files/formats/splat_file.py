"""The .splat file of the first web viewers: 32 bytes a Gaussian, no harmonics above the constant, no header.

float32 position and length of each axis, 8-bit colour and opacity, 8-bit quaternion (w, x, y, z) as 128 q + 128. Largest first, as viewers
that show a file while it arrives expect.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.io import write_bytes
from scene_experts.files.formats.pack import alphas, byte_logits, damaged, tensor, to_bytes, unit_quats
from scene_experts.files.formats.splats import Splats
from scene_experts.geometry.sh import C0

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def write_splat(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the .splat file; it has no room for a note."""
    table = np.zeros(len(splats), ROW)
    opacity = alphas(splats)
    table["means"], table["scales"] = splats.means, splats.log_scales.double().exp()
    table["rgba"][:, :3] = to_bytes(splats.sh[:, 0].double().numpy() * C0 + 0.5)
    table["rgba"][:, 3] = to_bytes(opacity)
    table["quats"] = np.clip(np.rint(unit_quats(splats) * 128 + 128), 0, 255)
    size = splats.log_scales.double().sum(1).numpy() + np.log(np.maximum(opacity, 1e-30))
    write_bytes(path, table[np.argsort(-size, kind="stable")].tobytes())


def read_splat(path: Path) -> Splats:
    """The Gaussians of a .splat file, of degree 0. Raises InputError where its size or values cannot be those of one."""
    data = path.read_bytes()
    if len(data) % ROW.itemsize:
        raise damaged(path, ".splat", f"{len(data):,} bytes, no multiple of {ROW.itemsize}")
    table = np.frombuffer(data, ROW)
    scales = table["scales"].astype(np.float64)
    if not (np.isfinite(table["means"]).all() and np.isfinite(scales).all() and (scales >= 0).all()):
        raise damaged(path, ".splat", "positions or lengths that are no numbers")
    quats = (table["quats"].astype(np.float64) - 128) / 128
    quats[(quats == 0).all(1)] = [1, 0, 0, 0]
    colors = (table["rgba"][:, :3].astype(np.float64) / 255 - 0.5) / C0
    return Splats(
        means=tensor(table["means"]),
        log_scales=tensor(np.log(np.maximum(scales, 1e-30))),
        quats=tensor(quats / np.linalg.norm(quats, axis=1, keepdims=True)),
        opacity_logit=tensor(byte_logits(table["rgba"][:, 3])),
        sh=tensor(colors[:, None]),
    )
