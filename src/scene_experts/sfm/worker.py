"""Runs pycolmap in a process of its own, because pycolmap can corrupt memory in a process that also
loads Pillow, torch or OpenCV.

The script is started by its path and imports nothing of this project. It reads a request (JSON)
from standard input and writes a line of JSON per step to standard output; COLMAP logs to standard
error. Finished work stays in the database, so a repeated request continues where the previous one
stopped.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

CHUNK = 8  # photographs per progress message during feature extraction
PAIRS = 200  # pairs per progress message during matching
ENOUGH = 0.9  # fraction of photographs with a pose at which the second mapper is not tried
FEW_FITTING = 4  # other photographs that fit one
GROWN = 1.3  # times as many photographs or points as at the last adjustment of all poses, from which on they are adjusted anew
WORSE = 1.1  # times the error of two focal lengths up to which one fits as well
FITS = 1.0  # pixels of error up to which one is kept where two were not tried
SEEN = 30  # points of the model that a photograph shows, in the mean; a camera that only turns may leave 5
SEEN_FROM, LOOKED_AT = 2.5, 2000  # degrees between the directions of points, in the median of so many: 1.6 for a camera that only turns
NEAR = 0.9  # share of the angle of a first pair from which COLMAP may find it
FEW_FEATURES = 200  # a sharp photograph has thousands
PROBED = 8  # photographs of a camera from which on two of them show whether the smallest features are needed


def report(**what: Any) -> None:
    """Write a line of JSON to standard output."""
    print(json.dumps(what), flush=True)


def extract_features(colmap: Any, ask: dict[str, Any]) -> bool:
    """Extract the features of every photograph that has none yet. The photographs of a group share
    one camera. Returns whether the smallest features of a group were left out."""
    total, done, large = sum(map(len, ask["groups"])), 0, False
    report(step="features", done=0, total=total)
    for names in ask["groups"]:
        camera, missing = read_done(colmap, ask["database"], names)
        done += len(names) - len(missing)
        reader = colmap.ImageReaderOptions()
        reader.camera_model = ask["camera_model"]
        if is_cut(names[0], ask):
            reader.camera_model = ask["rig"]["model"]
            reader.camera_params = ", ".join(map(repr, ask["rig"]["params"]))
        if ask["masks"]:
            reader.mask_path = ask["masks"]
        octave = 0 if has_large_features(colmap, ask, names, reader) else -1
        large = large or octave == 0
        while missing:
            some, missing = missing[:CHUNK], missing[CHUNK:]
            if camera is not None:
                reader.existing_camera_id = camera
            extract_some(colmap, ask, ask["database"], some, reader, octave)
            camera, lacking = read_done(colmap, ask["database"], names)
            if unread := [name for name in some if name in lacking]:
                report(step="unread", names=unread)
            done += len(some)
            report(step="features", done=done, total=total)
    return large


def extract_some(colmap: Any, ask: dict[str, Any], database: str, names: list[str], reader: Any, octave: int) -> None:
    """Extract the features of some photographs. octave: -1: also those that only the picture of
    twice the size shows; 0: without them, in less than half of the time."""
    options = colmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size, options.use_gpu = ask["threads"], ask["max_side"], False
    options.sift.first_octave = octave
    colmap.extract_features(
        database, ask["images"], names,
        camera_mode=colmap.CameraMode.SINGLE, reader_options=reader, extraction_options=options, device=colmap.Device.cpu,
    )  # fmt: skip


def has_large_features(colmap: Any, ask: dict[str, Any], names: list[str], reader: Any) -> bool:
    """Return whether two photographs of a camera have ask["enough"] features without those of the
    smallest size. None: as many as COLMAP keeps, so that it would leave out the smallest ones."""
    if len(names) < PROBED:
        return False
    enough = ask["enough"] or colmap.FeatureExtractionOptions().sift.max_num_features
    for name in (names[len(names) // 4], names[3 * len(names) // 4]):
        with tempfile.TemporaryDirectory() as folder:
            database = str(Path(folder) / "probe.db")
            extract_some(colmap, ask, database, [name], reader, 0)
            with colmap.Database.open(database) as there:
                places = {(x, y) for image in there.read_all_images() for x, y, *_ in there.read_keypoints(image.image_id).tolist()}
        if len(places) < enough:
            return False
    return True


def read_done(colmap: Any, database: str, names: list[str]) -> tuple[int | None, list[str]]:
    """Return the camera id of a group, or None if no photograph of it is done, and the names of the
    photographs without features."""
    if not Path(database).exists():
        return None, names
    with colmap.Database.open(database) as there:
        images = {image.name: image for image in there.read_all_images()}
        have = {name: images[name] for name in names if name in images and there.exists_descriptors(images[name].image_id)}
    camera = next((image.camera_id for image in have.values()), None)
    return camera, [name for name in names if name not in have]


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


def match_all(colmap: Any, ask: dict[str, Any]) -> None:
    """Match the pairs, then the spare pairs of photographs that fit too few others."""
    match_pairs(colmap, ask, ask["pairs"])
    if not ask["spare"]:
        return
    with colmap.Database.open(ask["database"]) as there:
        names = {image.image_id: image.name for image in there.read_all_images()}
        keys, inliers = there.read_two_view_geometry_num_inliers()
    fitting = [[names[i] for i in colmap.pair_id_to_image_pair(key)] for key, count in zip(keys, inliers) if count]
    weak = find_weak(list(names.values()), fitting)
    more = [pair for pair in ask["spare"] if weak.intersection(pair)]
    if more:
        report(step="weak", photographs=len(weak), pairs=len(more))
        match_pairs(colmap, ask, more)


def find_weak(names: list[str], fitting: list[list[str]]) -> set[str]:
    """Return the photographs that fit fewer than FEW_FITTING others, or that no chain of fitting
    pairs connects with the largest number of photographs."""
    beside: dict[str, set[str]] = {name: set() for name in names}
    for one, other in fitting:
        beside[one].add(other)
        beside[other].add(one)
    left, largest = set(names), set()
    while left:
        found, edge = set(), {next(iter(left))}
        while edge:
            found |= edge
            edge = set().union(*(beside[name] for name in edge)) - found
        left -= found
        largest = max(largest, found, key=len)
    return {name for name in names if len(beside[name]) < FEW_FITTING or name not in largest}


def match_pairs(colmap: Any, ask: dict[str, Any], pairs: list[list[str]]) -> None:
    """Match pairs. COLMAP skips those that are done."""
    options = colmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = ask["threads"], False
    report(step="matches", done=0, total=len(pairs))
    for first in range(0, len(pairs), PAIRS):
        some = pairs[first : first + PAIRS]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pairs.txt"
            path.write_text("".join(f"{a} {b}\n" for a, b in some))
            pairing = colmap.ImportedPairingOptions()
            pairing.match_list_path = str(path)
            colmap.match_image_pairs(ask["database"], matching_options=options, pairing_options=pairing, device=colmap.Device.cpu)
        report(step="matches", done=first + len(some), total=len(pairs))


def add_learned(colmap: Any, ask: dict[str, Any]) -> None:
    """Copy the database to ask["database"], and add the keypoints and matches of the npz file
    ask["learned"] to those that COLMAP has found and verified. All are verified together."""
    import numpy as np  # pycolmap loads it anyway

    report(step="matches of both kinds", done=0, total=1)
    shutil.copyfile(ask["database"], ask["database"] + ".learned")
    ask["database"] += ".learned"
    with np.load(ask["learned"], allow_pickle=False) as more, colmap.Database.open(ask["database"]) as there:
        ids = {image.name: image.image_id for image in there.read_all_images()}
        new = {ids[name]: more[f"k{i}"] for i, name in enumerate(ask["names"]) if name in ids}
        old = {image: there.read_keypoints(image) for image in new}
        matches: dict[tuple[int, int], list[Any]] = {}
        for key, geometry in zip(*there.read_two_view_geometries()):
            matches[tuple(colmap.pair_id_to_image_pair(key))] = [geometry.inlier_matches]
        for p, pair in enumerate(more["pairs"].tolist()):
            one, other = (ids.get(ask["names"][i]) for i in pair)
            if one is not None and other is not None:
                found = more[f"m{p}"] + np.array([len(old[one]), len(old[other])], np.uint32)
                found = found if one < other else found[:, ::-1]
                matches.setdefault((min(one, other), max(one, other)), []).append(found)
        for clear in (there.clear_matches, there.clear_two_view_geometries, there.clear_keypoints):
            clear()
        for image, places in new.items():
            before = old[image] if len(old[image]) else np.zeros((0, 6), np.float32)
            rows = np.zeros((len(places), before.shape[1]), np.float32)
            rows[:, :2] = places
            rows[:, 2::3] = 1  # of scale 1: the diagonal of an affine shape (columns 2 and 5), or the third of four columns
            there.write_keypoints(image, np.concatenate([before, rows]))
        lines = []
        by_id = {image: name for name, image in ids.items()}
        for (one, other), parts in sorted(matches.items()):
            there.write_matches(one, other, np.concatenate(parts).astype(np.uint32))
            lines.append(f"{by_id[one]} {by_id[other]}\n")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pairs.txt"
        path.write_text("".join(lines))
        options = colmap.TwoViewGeometryOptions()
        options.ransac.random_seed = ask["seed"]  # for each pair: the order in which threads take pairs does not matter
        colmap.verify_matches(ask["database"], str(path), options)
    report(step="matches of both kinds", done=1, total=1)


def estimate_poses(colmap: Any, ask: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct the scene, write the best model and return a description of it. Its `lacking` are
    the photographs that the incremental mapper, or the only one, gave no pose."""
    total = sum(map(len, ask["groups"]))
    found: list[tuple[str, Any]] = []
    first: set[str] = set()
    tried: dict[str, int] = {}
    for mapper in ("incremental", "global") if ask["mapper"] == "auto" else (ask["mapper"],):
        out = Path(ask["maps"]) / mapper
        out.mkdir(parents=True)
        report(step=f"poses ({mapper})", done=0, total=total)
        try:
            models = MAPPERS[mapper](colmap, ask, str(out), total)
        except Exception as error:  # report it; the other mapper may succeed
            report(step="failed", mapper=mapper, why=str(error))
            tried[mapper] = 0
            continue
        found += [(mapper, model) for model in models.values()]
        tried[mapper] = max((model.num_reg_images() for model in models.values()), default=0)
        if len(tried) == 1 and models:
            first = registered_names(max(models.values(), key=lambda model: model.num_reg_images()))
        if tried[mapper] >= ENOUGH * total:
            break
        if mapper != ask["mapper"] and len(tried) == 1:
            report(step="next mapper", mapper=mapper, posed=tried[mapper], photographs=total, parts=len(models))
    lacking = sorted({name for group in ask["groups"] for name in group} - first)
    if not found:
        return {"registered": [], "lacking": lacking}
    mapper, best = max(found, key=lambda one: (one[1].num_reg_images(), one[1].num_points3D()))
    os.makedirs(ask["model"])
    best.write_binary(ask["model"])
    have = registered_names(best)
    others = [registered_names(model) - have for one, model in found if one == mapper]
    return {
        "mapper": mapper,
        "mappers": tried,
        "registered": sorted(have),
        "lacking": lacking,
        "why": explain_missing(colmap, ask, have, set().union(*others)),
        "apart": sorted(map(len, filter(None, others)), reverse=True),
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "observations": best.compute_mean_observations_per_reg_image(),
        "cameras": [
            {"model": c.model.name, "width": c.width, "height": c.height, "params": [float(p) for p in c.params]}
            for c in best.cameras.values()
        ],
    }


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


def registered_names(model: Any) -> set[str]:
    """Return the names of the photographs that have a pose in a model."""
    return {model.images[i].name for i in model.reg_image_ids()}


def explain_missing(colmap: Any, ask: dict[str, Any], have: set[str], apart: set[str]) -> dict[str, str]:
    """Return why each photograph that is not in `have` has no pose, by name. apart: photographs
    with poses in a model of their own."""
    names = [name for group in ask["groups"] for name in group if name not in have]
    if not names:
        return {}
    with colmap.Database.open(ask["database"]) as there:
        by_name = {image.name: image.image_id for image in there.read_all_images()}
        features = {name: there.num_keypoints_for_image(by_name[name]) if name in by_name else 0 for name in names}
        pairs, inliers = there.read_two_view_geometry_num_inliers()
    shared: dict[int, dict[int, int]] = {}
    for pair, count in zip(pairs, inliers):
        one, other = colmap.pair_id_to_image_pair(pair)
        shared.setdefault(one, {})[other] = shared.setdefault(other, {})[one] = count
    posed = {by_name[name] for name in have if name in by_name}
    return {name: explain(features[name], shared.get(by_name.get(name, -1), {}), posed, name in apart) for name in names}


def explain(features: int, shared: dict[int, int], posed: set[int], apart: bool) -> str:
    """Return why a photograph has no pose.

    shared: The number of points that it shares with other photographs, by their id. posed: Ids of
    the photographs that have a pose.
    """
    with_posed = [count for other, count in shared.items() if other in posed and count]
    if features < FEW_FEATURES:
        return f"only {features} features: it is blurred, dark or plain"
    if apart:
        return "fits only together with others that are apart from the rest"
    if not any(shared.values()):
        return "no other photograph shows the same points; take one or two between it and its neighbours"
    if not with_posed:
        return "shares points only with photographs that have no pose either"
    return f"shares points with {len(with_posed)} photographs that have a pose, at most {max(with_posed)}, which did not fit a pose"


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


def find_cut_cameras(colmap: Any, ask: dict[str, Any]) -> set[int]:
    """Return the cameras of the views that were cut out of panoramas: their lens is known."""
    with colmap.Database.open(ask["database"]) as there:
        return {image.camera_id for image in there.read_all_images() if is_cut(image.name, ask)}


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


def exit_with_parent() -> None:
    """End this process when its parent ends, which closes standard input."""
    sys.stdin.read()
    os._exit(1)


def main() -> int:
    """Serve one request and return the exit code."""
    ask = json.loads(sys.stdin.readline())
    try:
        import pycolmap as colmap
    except ImportError as error:
        report(step="missing", why=str(error))
        return 0
    threading.Thread(target=exit_with_parent, daemon=True).start()
    colmap.set_random_seed(ask["seed"])
    large = False
    if ask["learned"]:
        add_learned(colmap, ask)
    else:
        large = extract_features(colmap, ask)
        if ask["pairs"] is not None:
            match_all(colmap, ask)
    if not ask["poses"]:
        report(step="done")
        sys.stdout.flush()
        os._exit(0)
    if ask["rig"] is not None:
        tie_views(colmap, ask)
    ask["narrow"] = ask["rig"] is None and ask["mapper"] != "global" and not has_wide_pair(colmap, ask)
    estimate = estimate_all if ask["camera_model"] == "OPENCV" and ask["rig"] is None else estimate_poses
    report(step="done", version=colmap.__version__, large_features=large, **estimate(colmap, ask))
    sys.stdout.flush()
    os._exit(0)  # the waiting thread would delay the end of the interpreter


if __name__ == "__main__":
    sys.exit(main())
