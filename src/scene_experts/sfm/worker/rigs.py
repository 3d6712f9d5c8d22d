"""Views that were cut out of panoramas."""

from __future__ import annotations

from typing import Any


def is_cut(name: str, ask: dict[str, Any]) -> bool:
    """Return whether a photograph is a view that was cut out of a panorama."""
    return ask["rig"] is not None and name.split("/")[0] in ask["rig"]["views"]


def tie_views(colmap: Any, ask: dict[str, Any]) -> None:
    """Tell COLMAP that the views of a panorama were seen from one place, and how they are turned."""
    cameras = []
    for folder, rotation in ask["rig"]["views"].items():
        camera = colmap.RigConfigCamera()
        camera.image_prefix, camera.ref_sensor = f"{folder}/", not cameras
        if cameras:
            first = next(iter(ask["rig"]["views"].values()))
            turn = [[sum(rotation[i][k] * first[j][k] for k in range(3)) for j in range(3)] for i in range(3)]
            camera.cam_from_rig = colmap.Rigid3d(colmap.Rotation3d(turn), [0.0, 0.0, 0.0])
        cameras.append(camera)
    config = colmap.RigConfig()
    config.cameras = cameras
    with colmap.Database.open(ask["database"]) as there:
        colmap.apply_rig_config([config], there)


def find_cut_cameras(colmap: Any, ask: dict[str, Any]) -> set[int]:
    """Return the cameras of the views that were cut out of panoramas: their lens is known."""
    with colmap.Database.open(ask["database"]) as there:
        return {image.camera_id for image in there.read_all_images() if is_cut(image.name, ask)}
