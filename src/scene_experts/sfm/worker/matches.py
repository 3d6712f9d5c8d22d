"""Matches of pairs of photographs, in the database."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

from scene_experts.sfm.worker.messages import report

PAIRS = 200  # pairs per progress message during matching
FEW_FITTING = 4  # other photographs that fit one


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
