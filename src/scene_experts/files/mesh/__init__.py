"""A mesh of coloured triangles, PLY or GLB: the surface that the training views show.

The depths of the training views are fused into a signed distance (`fuse`), whose zero is the
surface (`surface`). View-dependent colours become their mean.
"""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_bytes
from scene_experts.files.options import Options
from scene_experts.files.registry import DRAWN, Format


def expect_libraries() -> None:
    """Raise InputError where scikit-image or trimesh is missing."""
    if any(importlib.util.find_spec(name) is None for name in ("skimage", "trimesh")):
        raise InputError(f"a mesh requires scikit-image and trimesh: {install_line('mesh')}")


def write(path: Path, mesh: Any, note: dict[str, Any]) -> None:
    """Write a `surface.Mesh` as PLY or GLB, by the suffix. In a GLB, +Y is up: half a turn about z
    from ours."""
    import trimesh

    glb = path.suffix.lower() == ".glb"
    vertices = mesh.vertices * np.array([-1.0, -1.0, 1.0]) if glb else mesh.vertices
    made = trimesh.Trimesh(vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    found: Any = made.export(file_type="glb" if glb else "ply")
    write_bytes(path, found)


def draw(run: Any, capture: Any, options: Options, rasterize: Any, tell: Any) -> tuple[Any, dict[str, Any]]:
    """Return the mesh of a run and how it was made, see `draw.make_mesh`. The vertices are relative
    to a local origin where float32 does not hold them otherwise."""
    from scene_experts.files.mesh.draw import MeshTask, make_mesh
    from scene_experts.files.scene_folder import origin_note, origin_of

    mesh, note = make_mesh(MeshTask(run, capture, options.cells, options.crop, rasterize, tell))
    origin = origin_of(run, capture.world)
    return replace(mesh, vertices=mesh.vertices - np.array(origin)), note | origin_note(origin)


FORMAT = Format(
    suffix=".mesh.ply",
    family=DRAWN,
    write=write,
    other_suffixes=(".ply", ".glb"),
    needs=expect_libraries,
    draw=draw,
)
