"""The bake that a run folder keeps, so that later exports need none.

The newest one is kept, with what it was made of: scene, cameras and settings. A scene that was
trained on, another capture or other settings of the bake make a new one.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from scene_experts.core.checkpoint import digest, read_tensors, write_tensors
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.plain import to_json
from scene_experts.data.views import Capture
from scene_experts.files.bake.bake import Bake, Baked
from scene_experts.files.gaussians.read import scene_of
from scene_experts.training.run_folder import OpenRun

FILE = "bake.safetensors"
"""In a run folder."""
KIND, VERSION = "bake", 1


def origin(run: OpenRun, capture: Capture, how: Bake) -> str:
    """Return a hash of everything that a bake depends on, but the processor."""
    scene = digest({name: value.detach().cpu() for name, value in {**run.scene.table.params, **run.scene.network_tensors()}.items()})
    views = [capture.fingerprint(), capture.chosen(), capture.poses(), list(capture.background)]
    about = [VERSION, scene, run.step, run.config.train.antialias, views, to_json(how)]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def load(run: OpenRun, capture: Capture, how: Bake) -> Baked | None:
    """Return the bake in a run folder, without its closed form, if it is of this scene, capture and
    settings; else None."""
    path = run.path / FILE
    if run.lone is not None or not path.is_file():
        return None
    try:
        tensors, meta = read_tensors(path, KIND, VERSION)
    except InputError:
        return None
    if meta.get("origin") != origin(run, capture, how):
        return None
    return Baked(scene_of(tensors, run.scene.extent), None, meta["about"])


def keep(run: OpenRun, capture: Capture, how: Bake, baked: Baked) -> None:
    """Write a bake into the run folder, where that is possible."""
    if run.lone is not None or not Path(run.path).is_dir():
        return
    meta = {"origin": origin(run, capture, how), "about": baked.about}
    try:
        write_tensors(run.path / FILE, dict(baked.scene.table.params), KIND, VERSION, meta)
    except RunError:  # a folder that may not be written to: the next export bakes again
        return
