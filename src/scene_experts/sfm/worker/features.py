"""Features of photographs, in the database."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from scene_experts.sfm.worker.messages import report
from scene_experts.sfm.worker.rigs import is_cut

CHUNK = 8  # photographs per progress message during feature extraction
PROBED = 8  # photographs of a camera from which on two of them show whether the smallest features are needed


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
