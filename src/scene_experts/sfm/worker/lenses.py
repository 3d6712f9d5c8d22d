"""Poses with one focal length where the pictures do not tell two apart."""

from __future__ import annotations

import math
import os
import shutil
from typing import Any

from scene_experts.sfm.worker.messages import report
from scene_experts.sfm.worker.poses import ENOUGH, estimate_poses

WORSE = 1.1  # times the error of two focal lengths up to which one fits as well
FITS = 1.0  # pixels of error up to which one is kept where two were not tried
SEEN = 30  # points of the model that a photograph shows, in the mean; a camera that only turns may leave 5
SEEN_FROM, LOOKED_AT = 2.5, 2000  # degrees between the directions of points, in the median of so many: 1.6 for a camera that only turns


def estimate_all(colmap: Any, ask: dict[str, Any]) -> dict[str, Any]:
    """Estimate the poses, with one focal length where the pictures do not tell two apart: first, where
    no pair of photographs has a wide angle (ask["narrow"]), and for the frames of a video
    (ask["film"]); else for lenses that were found to have two that no lens has, if they took most
    photographs. Such are a drone's pictures from one height: with two focal lengths the scene may be
    stretched. The poses with one are kept where they are as many and fit as well.

    They are those of the global mapper: the incremental one does not begin where pictures are nearly
    parallel projections, or takes three times as long.
    """
    one: dict[str, Any] | None = None
    if (ask["narrow"] or ask["film"]) and ask["mapper"] == "auto":
        report(step="one first", narrow=ask["narrow"])
        with colmap.Database.open(ask["database"]) as there:
            guessed = {camera.camera_id: min(camera.params[:2]) for camera in there.read_all_cameras() if camera.model.name == "OPENCV"}
        one = estimate_with_one(colmap, ask, guessed)
        if len(one["registered"]) >= ENOUGH * sum(map(len, ask["groups"])) and one["error"] <= FITS and one["deep"]:
            return keep_one(ask, one)
        report(step="one focal length", kept=False, first=True)
    result = estimate_poses(colmap, ask)
    if not result["registered"]:
        return result
    model = colmap.Reconstruction(ask["model"])
    lenses = {i: sorted(camera.params[:2]) for i, camera in model.cameras.items() if camera.model.name == "OPENCV"}
    stretched = {i: short for i, (short, long) in lenses.items() if long >= ask["stretched"] * short > 0}
    if 2 * sum(image.camera_id in stretched for image in model.images.values()) <= len(model.images):
        return result
    if one is None:
        report(step="stretched", ratio=max(lenses[i][1] / lenses[i][0] for i in stretched))
        one = estimate_with_one(colmap, ask, stretched)
    kept = len(one["registered"]) >= len(result["registered"]) and one["error"] <= WORSE * result["error"] and one["deep"]
    report(step="one focal length", kept=kept, first=False)
    return keep_one(ask, {**one, "mappers": {**result["mappers"], **one["mappers"]}, "lacking": result["lacking"]}) if kept else result


def estimate_with_one(colmap: Any, ask: dict[str, Any], focal: dict[int, float]) -> dict[str, Any]:
    """Estimate the poses by the global mapper, with one focal length for these cameras. The model is in
    the folder of maps; `deep` says whether its points have a depth."""
    again = {
        **ask,
        "database": ask["database"] + ".one",
        "maps": ask["maps"] + "/one",
        "model": ask["maps"] + "/one-model",
        "mapper": "global",
    }
    shutil.copyfile(ask["database"], again["database"])  # a call that is killed goes on with the lenses that were asked for
    use_one_focal_length(colmap, again["database"], focal)
    options = colmap.ViewGraphCalibrationOptions()
    options.random_seed = ask["seed"]
    colmap.calibrate_view_graph(again["database"], options)  # without it, a guess of half the focal length may lead nowhere
    found = estimate_poses(colmap, again)
    deep = (
        bool(found["registered"]) and found["observations"] >= SEEN and measure_angles(colmap.Reconstruction(again["model"])) >= SEEN_FROM
    )
    return {**found, "deep": deep}


def measure_angles(model: Any) -> float:
    """Return how far apart the directions are, in degrees, from which the points of a model are seen:
    the median over points of the widest angle. A camera that only turns gives poses that fit, and
    points of no known depth."""
    import numpy as np

    centres = {i: image.projection_center() for i, image in model.images.items() if image.has_pose}
    points = [model.points3D[i] for i in sorted(model.points3D)]
    widest = []
    for point in points[:: max(1, len(points) // LOOKED_AT)]:
        rays = np.array([point.xyz - centres[element.image_id] for element in point.track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True).clip(1e-12)
        widest.append(math.degrees(math.acos(min(1.0, max(-1.0, float((rays @ rays.T).min()))))))
    return float(np.median(widest)) if widest else 0.0


def keep_one(ask: dict[str, Any], one: dict[str, Any]) -> dict[str, Any]:
    """Put the model with one focal length into the place of the other, if there is one."""
    shutil.rmtree(ask["model"], ignore_errors=True)
    os.rename(ask["maps"] + "/one-model", ask["model"])
    return {**one, "one_focal_length": True}


def use_one_focal_length(colmap: Any, database: str, focal: dict[int, float]) -> None:
    """Give cameras of the database a lens with one focal length, in pixels by camera to begin with,
    and two radial terms."""
    with colmap.Database.open(database) as there:
        for camera in there.read_all_cameras():
            if camera.camera_id in focal:
                params = [focal[camera.camera_id], camera.width / 2, camera.height / 2, 0.0, 0.0]
                new = colmap.Camera(camera_id=camera.camera_id, model="RADIAL", width=camera.width, height=camera.height, params=params)
                new.has_prior_focal_length = camera.has_prior_focal_length
                there.update_camera(new)
