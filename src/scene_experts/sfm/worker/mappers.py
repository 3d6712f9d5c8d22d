"""COLMAP's mappers: matches to poses and points."""

from __future__ import annotations

import math
from typing import Any

from scene_experts.sfm.worker.messages import report
from scene_experts.sfm.worker.rigs import find_cut_cameras, is_cut

GROWN = 1.3  # times as many photographs or points as at the last adjustment of all poses, from which on they are adjusted anew
NEAR = 0.9  # share of the angle of a first pair from which COLMAP may find it


def map_incrementally(colmap: Any, ask: dict[str, Any], out: str, total: int) -> dict[int, Any]:
    """Run COLMAP's mapper, which adds one photograph at a time."""
    options, count, attempt = colmap.IncrementalPipelineOptions(), 2, 0
    options.num_threads, options.random_seed, options.ba_use_gpu = ask["threads"], ask["seed"], False
    options.min_model_size = 3
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GROWN
    if ask["rig"] is not None:
        options.ba_refine_sensor_from_rig = False
        options.constant_cameras = find_cut_cameras(colmap, ask)
    elif ask["narrow"]:  # the first pair is the one that COLMAP's third search would find
        options.mapper.init_min_num_inliers //= 2
        options.mapper.init_min_tri_angle /= 2

    def start() -> None:  # from two photographs; again where they lead nowhere, and for photographs that do not fit the others
        nonlocal count, attempt
        count, attempt = 2, attempt + 1

    def count_image() -> None:
        nonlocal count
        count += 1
        name = "poses (incremental)" if attempt < 2 else f"poses (incremental, start {attempt})"
        report(step=name, done=min(count, total), total=total)

    calls = {"initial_image_pair_callback": start, "next_image_callback": count_image}
    return colmap.incremental_mapping(ask["database"], ask["images"], out, options=options, **calls)


def has_wide_pair(colmap: Any, ask: dict[str, Any]) -> bool:
    """Return whether a pair of photographs may have the angle that COLMAP wants of the first pair.

    COLMAP searches all pairs for one, 30 ms each, then again with half of the inliers, then with
    half of the angle. The frames of a video often have none. A pair takes 1 ms here.
    """
    wanted = colmap.IncrementalPipelineOptions().mapper
    with colmap.Database.open(ask["database"]) as there:
        images = {image.image_id: image for image in there.read_all_images()}
        cameras = {camera.camera_id: camera for camera in there.read_all_cameras()}
        pairs = sorted(zip(*there.read_two_view_geometries()), key=lambda pair: -len(pair[1].inlier_matches))
        places: dict[int, Any] = {}
        for key, geometry in pairs:
            if len(geometry.inlier_matches) < wanted.init_min_num_inliers // 2:
                break
            sides = []
            for i in colmap.pair_id_to_image_pair(key):
                if i not in places:
                    places[i] = there.read_keypoints(i)[:, :2].astype(float)
                sides += [cameras[images[i].camera_id], places[i]]
            colmap.estimate_two_view_geometry_pose(*sides, geometry)
            if geometry.tri_angle >= math.radians(NEAR * wanted.init_min_tri_angle):
                return True
    return False


def map_globally(colmap: Any, ask: dict[str, Any], out: str, total: int) -> dict[int, Any]:
    """Run GLOMAP, which solves for all photographs together."""
    options = colmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = ask["threads"], ask["seed"]
    if ask["rig"] is not None:
        options.mapper.refine_sensor_from_rig = False
        if all(is_cut(name, ask) for names in ask["groups"] for name in names):
            options.mapper.bundle_adjustment.refine_focal_length = options.mapper.bundle_adjustment.refine_extra_params = False
    return colmap.global_mapping(ask["database"], ask["images"], out, options=options)


MAPPERS = {"incremental": map_incrementally, "global": map_globally}
