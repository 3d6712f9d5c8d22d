"""Runs pycolmap in a process of its own, started by its path: beside Pillow, torch or OpenCV pycolmap can corrupt the process's memory.

Reads a request (JSON) from standard input, writes a line of JSON for each step to standard output; COLMAP's own words go to standard error.
Imports nothing of this project. What is done is kept in the database, so a request that is made again goes on where it was stopped.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

CHUNK = 8  # photographs whose features are sought between two lines
PAIRS = 200  # pairs that are matched between two lines
ENOUGH = 0.9  # share of photographs with a pose at which the second mapper is not tried


def tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def features(colmap: Any, ask: dict[str, Any]) -> None:
    """Find the features of every photograph that has none yet; the photographs of a group share one camera."""
    options = colmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size, options.use_gpu = ask["threads"], ask["max_side"], False
    total, done = sum(map(len, ask["groups"])), 0
    for names in ask["groups"]:
        camera, missing = known(colmap, ask["database"], names)
        done += len(names) - len(missing)
        while missing:
            some, missing = missing[:CHUNK], missing[CHUNK:]
            reader = colmap.ImageReaderOptions()
            reader.camera_model = ask["camera_model"]
            if ask["masks"]:
                reader.mask_path = ask["masks"]
            if camera is not None:
                reader.existing_camera_id = camera
            colmap.extract_features(
                ask["database"], ask["images"], some,
                camera_mode=colmap.CameraMode.SINGLE, reader_options=reader, extraction_options=options, device=colmap.Device.cpu,
            )  # fmt: skip
            camera, lacking = known(colmap, ask["database"], names)
            if unread := [name for name in some if name in lacking]:
                tell(step="unread", names=unread)
            done += len(some)
            tell(step="features", done=done, total=total)


def known(colmap: Any, database: str, names: list[str]) -> tuple[int | None, list[str]]:
    """The camera of a group, None before its first photograph, and which of its photographs are not in the database."""
    if not Path(database).exists():
        return None, names
    with colmap.Database.open(database) as there:
        images = {image.name: image for image in there.read_all_images()}
        have = {name: images[name] for name in names if name in images and there.exists_descriptors(images[name].image_id)}
    camera = next((image.camera_id for image in have.values()), None)
    return camera, [name for name in names if name not in have]


def matches(colmap: Any, ask: dict[str, Any]) -> None:
    """Match the pairs; COLMAP passes over those that are done."""
    options = colmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = ask["threads"], False
    pairs = ask["pairs"]
    for first in range(0, len(pairs), PAIRS):
        some = pairs[first : first + PAIRS]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pairs.txt"
            path.write_text("".join(f"{a} {b}\n" for a, b in some))
            pairing = colmap.ImportedPairingOptions()
            pairing.match_list_path = str(path)
            colmap.match_image_pairs(ask["database"], matching_options=options, pairing_options=pairing, device=colmap.Device.cpu)
        tell(step="matches", done=first + len(some), total=len(pairs))


def poses(colmap: Any, ask: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct, and write the best model; says what it is."""
    total = sum(map(len, ask["groups"]))
    found: list[tuple[str, Any]] = []
    for mapper in ("incremental", "global") if ask["mapper"] == "auto" else (ask["mapper"],):
        out = Path(ask["maps"]) / mapper
        out.mkdir(parents=True)
        tell(step=f"poses ({mapper})", done=0, total=total)
        try:
            models = MAPPERS[mapper](colmap, ask, str(out), total)
        except Exception as error:  # a mapper that gives up is told of, and the other one may do
            tell(step="failed", mapper=mapper, why=str(error))
            continue
        found += [(mapper, model) for model in models.values()]
        if found and max(model.num_reg_images() for _, model in found) >= ENOUGH * total:
            break
    if not found:
        return {"registered": []}
    mapper, best = max(found, key=lambda one: (one[1].num_reg_images(), one[1].num_points3D()))
    os.makedirs(ask["model"])
    best.write_binary(ask["model"])
    have = posed(best)
    others = [posed(model) - have for one, model in found if one == mapper]
    return {
        "mapper": mapper,
        "registered": sorted(have),
        "apart": sorted(map(len, filter(None, others)), reverse=True),
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "observations": best.compute_mean_observations_per_reg_image(),
        "cameras": [
            {"model": c.model.name, "width": c.width, "height": c.height, "params": [float(p) for p in c.params]}
            for c in best.cameras.values()
        ],
    }


def posed(model: Any) -> set[str]:
    """The names of the photographs with a pose in a model."""
    return {model.images[i].name for i in model.reg_image_ids()}


def incremental(colmap: Any, ask: dict[str, Any], out: str, total: int) -> dict[int, Any]:
    """COLMAP: one photograph after the other."""
    options, count = colmap.IncrementalPipelineOptions(), 2
    options.num_threads, options.random_seed, options.ba_use_gpu = ask["threads"], ask["seed"], False
    options.min_model_size = 3

    def another() -> None:
        nonlocal count
        count += 1
        tell(step="poses (incremental)", done=min(count, total), total=total)

    return colmap.incremental_mapping(ask["database"], ask["images"], out, options=options, next_image_callback=another)


def at_once(colmap: Any, ask: dict[str, Any], out: str, total: int) -> dict[int, Any]:
    """GLOMAP: all photographs together."""
    options = colmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = ask["threads"], ask["seed"]
    return colmap.global_mapping(ask["database"], ask["images"], out, options=options)


MAPPERS = {"incremental": incremental, "global": at_once}


def watch() -> None:
    """End this process when the one that started it is gone: its end of standard input closes then."""
    sys.stdin.read()
    os._exit(1)


def main() -> int:
    ask = json.loads(sys.stdin.readline())
    try:
        import pycolmap as colmap
    except ImportError as error:
        tell(step="missing", why=str(error))
        return 0
    threading.Thread(target=watch, daemon=True).start()
    colmap.set_random_seed(ask["seed"])
    features(colmap, ask)
    matches(colmap, ask)
    tell(step="done", version=colmap.__version__, **poses(colmap, ask))
    sys.stdout.flush()
    os._exit(0)  # the thread that waits would hold the interpreter's end up


if __name__ == "__main__":
    sys.exit(main())
