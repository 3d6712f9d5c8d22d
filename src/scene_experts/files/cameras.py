"""cameras.json, the list of views that viewers of the 3DGS family read beside a scene, in the
capture's own frame."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from scene_experts.core.io import write_json
from scene_experts.data.views import Capture, Vector, View, World


def camera_entries(views: Iterable[View], world: World) -> list[dict[str, Any]]:
    """One entry a view, numbered in the order given: position (camera centre) and rotation (3x3,
    camera to world) in the input frame.

    Sizes, fx and fy are pixels of the trained resolution. cx and cy are ours: the readers of this
    family take the image centre.
    """
    out = []
    for i, view in enumerate(views):
        camera = view.camera
        pose = camera.world_to_cam.double()
        centre = world.to_input(-(pose[:3, :3].T @ pose[:3, 3]))
        out.append(
            {
                "id": i,
                "img_name": str(PurePosixPath(view.name).with_suffix("")),
                "width": camera.width,
                "height": camera.height,
                "position": centre.tolist(),
                "rotation": pose[:3, :3].T.tolist(),
                "fy": camera.fy,
                "fx": camera.fx,
                "cx": camera.cx,
                "cy": camera.cy,
            }
        )
    return out


def write_cameras(path: Path, capture: Capture, origin: Vector = (0.0, 0.0, 0.0)) -> None:
    """Write the views of a capture, those held out first, then those trained on, relative to
    `origin`."""
    views = [capture.views[i] for i in (*capture.test, *capture.train)]
    write_json(path, camera_entries(views, capture.world.seen_from(origin)))
