"""The precision of a run: steps by what its values do to the pictures, kept in its folder."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.checkpoint import read_tensors, write_tensors
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.files.anchors.data import FILE_NAMES
from scene_experts.files.anchors.precision import ROUNDED, Precision, from_sensitivity, is_exact
from scene_experts.files.measure import Tell
from scene_experts.render import Rasterizer
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.sensitivity import MOST_VIEWS, evenly, find_sensitivity

FILE = "precision.safetensors"
"""In a run folder: the steps of an error of 1 at the newest export."""
KIND, VERSION = "precision", 1


def measure(scene: AnchorScene, step: int, cameras: Sequence[Camera], background: Tensor, rasterize: Rasterizer, tell: Tell) -> Precision:
    """The steps of an error of 1 of a scene, from its pictures at `cameras` over `background`
    [3]."""
    named = {f"params.{name}": scene.table.params[name] for name in ROUNDED}
    for name, value in scene.network_tensors().items():
        part, _, rest = name.partition(".")
        named[f"{'feature_bank' if part == 'mix' else part}.{FILE_NAMES.get(rest, rest)}"] = value
    values = {name: value for name, value in named.items() if not is_exact(name)}

    def tell_views(done: int, total: int) -> None:
        tell("measuring what each value does to the pictures", done, total)

    found = find_sensitivity(scene, values, step, cameras, background, rasterize, tell_views)
    means = {name: value.cpu() for name, value in found.items()}
    columns = {name: means.pop(f"params.{name}") for name in ROUNDED}
    return from_sensitivity(columns, means)


def prepare(run: OpenRun, capture: Capture, rasterize: Rasterizer, device: str) -> str:
    """Measure the precision of a run on a device and keep it in the run folder. Returns a sentence
    about it. See `registry.Format.prepare`."""
    scene, begun = cast(AnchorScene, run.scene), time.process_time()
    if not len(scene.table) or not capture.train:
        return ""
    cameras = [capture.views[i].camera.to(device) for i in evenly(capture.train, MOST_VIEWS)]
    scene.to(device)
    try:
        precision = measure(scene, run.step, cameras, torch.tensor(capture.background, device=device), rasterize, lambda *_: None)
    finally:
        scene.to("cpu")
    keep(run, precision)
    return f"measured what each value does to the pictures, for exports as compact files ({time.process_time() - begun:.0f} s of CPU time)"


def fingerprint(scene: AnchorScene) -> int:
    """A checksum of the values that a precision belongs to."""
    found = 0
    for value in (*(scene.table.params[name] for name in ROUNDED), *scene.network_tensors().values()):
        found = zlib.crc32(np.ascontiguousarray(value.detach().cpu().numpy()).tobytes(), found)
    return found


def kept(run: OpenRun) -> Precision | None:
    """The precision in a run folder, if it is that of the scene; None without."""
    path = run.path / FILE
    if run.lone is not None or not path.is_file():
        return None
    try:
        tensors, meta = read_tensors(path, KIND, VERSION)
    except InputError:
        return None
    scene = cast(AnchorScene, run.scene)
    if meta.get("scene") != fingerprint(scene):
        return None
    steps = {name: tensors[f"steps.{name}"] for name in ROUNDED}
    networks = {name.removeprefix("network."): value for name, value in tensors.items() if name.startswith("network.")}
    return Precision(steps, tensors["classes"].long(), networks)


def keep(run: OpenRun, precision: Precision) -> None:
    """Write a precision into the run folder, where that is possible."""
    if run.lone is not None or not Path(run.path).is_dir():
        return
    tensors = {f"steps.{name}": value for name, value in precision.steps.items()} | {"classes": precision.classes.to(torch.int8)}
    tensors |= {f"network.{name}": value for name, value in precision.networks.items()}
    try:
        write_tensors(run.path / FILE, tensors, KIND, VERSION, {"scene": fingerprint(cast(AnchorScene, run.scene)), "step": run.step})
    except RunError:  # a folder that may not be written to: the next export measures again
        return
