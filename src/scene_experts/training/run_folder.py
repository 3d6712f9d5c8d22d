"""A run folder: what a training leaves behind, and how the other commands open it.

RUN/config.json                      recipe, numbers, capture, command, versions
RUN/metrics.jsonl                    one line per logged iteration
RUN/checkpoints/ckpt_NNNNNN.safetensors
RUN/point_cloud/iteration_N/, RUN/cameras.json      the Scaffold-GS layout, in the capture's own frame
RUN/previews/, RUN/test/, RUN/results.json, RUN/per_view.json
RUN/.lock                            held by the training that writes there
"""

from __future__ import annotations

import json
import math
import platform
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import scene_experts
from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.io import locked, read_json, write_json
from scene_experts.core.plain import UnknownPart, first_difference, from_json, to_json
from scene_experts.data import capture as captures
from scene_experts.data.capture import Capture
from scene_experts.data.fetch.obtain import resolve
from scene_experts.data.settings import Data
from scene_experts.recipes import RECIPES
from scene_experts.scene import Scene
from scene_experts.training import capture_place
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.state import scene_from

FORMAT = 1
PICTURES = ("renders", "gt", "errors", "side_by_side", "masks", "experts")  # the folders of an evaluation's pictures


@dataclass(frozen=True)
class OpenRun:
    """A trained scene with its capture and configuration."""

    path: Path
    config: RunConfig
    cfg: Train  # scaled
    scene: Scene
    step: int
    clock: Clock  # of the training
    capture: str = ""  # fingerprint of the capture it was trained on; empty where nothing says it


def versions() -> dict[str, str]:
    """What the run was made with."""
    return {
        "scene-experts": scene_experts.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def check(out: Path, config: RunConfig, resume: bool, overwrite: bool = False) -> None:
    """Raises InputError where a run may not go to `out`: over another run, or on from one of another recipe, capture or numbers.

    Changes nothing on disk.
    """
    place = next(p for p in (out, *out.absolute().parents) if p.exists())
    if not place.is_dir():
        raise InputError(f"expected a folder for the run at {out}, found a file at {place}; choose another --out")
    try:
        json.dumps(to_json(config), allow_nan=False)
    except ValueError:
        raise InputError("expected finite numbers in every setting, found nan or infinity; correct the flag") from None
    if out.resolve() == config.data.path.resolve():
        raise InputError(f"expected a folder of its own for the run, found the capture's at {out}; choose another --out")
    if foreign := _foreign(out):
        raise InputError(f"expected a new or empty folder or an earlier run at {out}, found {foreign} in it; choose another --out")
    if resume and overwrite:
        raise InputError("expected --resume (go on) or --overwrite (begin anew), found both; leave one out")
    if resume and not (out / "config.json").is_file():
        raise InputError(f"expected an earlier run to resume in {out}, found none; leave out --resume to begin one, or correct --out")
    if resume:
        _check_same(out, read_config(out), config)
    elif not overwrite and any((out / "checkpoints").glob("ckpt_*.safetensors")):
        imported = config.command.startswith("import ")
        advice = "choose another --out" if imported else "add --resume to go on, --overwrite to begin anew, or choose another --out"
        raise InputError(f"expected a new or empty run folder, found checkpoints in {out}; {advice}")


def _foreign(out: Path) -> str:
    """The first thing in a folder that is no run of ours; empty where there is nothing to lose."""
    if any((out / "checkpoints").glob("ckpt_*.safetensors")):
        return ""
    try:
        if "format" in read_json(out / "config.json", "run configuration"):  # type: ignore[operator]
            return ""
    except (InputError, TypeError):
        pass
    found = sorted(path.name for path in out.iterdir() if path.name not in (".lock", "paths")) if out.is_dir() else []
    return found[0] if found else ""


def _check_same(out: Path, found: RunConfig, config: RunConfig) -> None:
    """Whether a run can go on with `config`: everything that changes its numbers as it was; the capture may have moved."""
    if found.train.recipe != config.train.recipe:
        raise InputError(
            f"expected a run of '{config.train.recipe}' to resume in {out}, found one of '{found.train.recipe}'; "
            f"use `train {found.train.recipe}` or another --out"
        )
    old = to_json(replace(found.data, path=Path())) | to_json(found.train)
    new = to_json(replace(config.data, path=Path())) | to_json(config.train)
    other = first_difference(old, new)
    if other:
        raise InputError(
            f"expected the settings that the run in {out} began with, found other settings: {other}; "
            f"resume with the run's own flags, or choose another --out"
        )


@contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold `out` for one training; a process that dies lets go. Raises InputError where another training writes there."""
    out.mkdir(parents=True, exist_ok=True)
    busy = f"expected a run folder that nobody writes to, found a training at work in {out}; choose another --out"
    with locked(out / ".lock", busy):
        yield


def prepare(out: Path, config: RunConfig, resume: bool, overwrite: bool = False, exported: Iterable[Path] = ()) -> None:
    """Make `out` ready for a run that `check` admits: an overwritten run's checkpoints and results go, config.json is written."""
    check(out, config, resume, overwrite)
    if overwrite:
        results = [out / f"{name}{suffix}.json" for name in ("results", "per_view") for suffix in ("", "_train", "_half")]
        others = [*exported, out / "report.html", out / "config.json"]
        for old in [*(out / "checkpoints").glob("ckpt_*.safetensors"), *(out / "previews").glob("*.png"), *results, *others]:
            old.unlink(missing_ok=True)
        for scored in (out / f"{views}{half}" for views in ("test", "train") for half in ("", "_half")):
            for pictures in PICTURES:  # and nothing else that may lie there
                shutil.rmtree(scored / pictures, ignore_errors=True)
        for sidecar in (out / "point_cloud").glob("iteration_*/scene.json"):  # a later iteration's would be taken for the new run's
            shutil.rmtree(sidecar.parent, ignore_errors=True)
    _write_config(out, config)


def _write_config(out: Path, config: RunConfig) -> None:
    """Write config.json with the path of the capture from the root and from the run folder."""
    path = capture_place.absolute(named(config.data).path)
    relative = capture_place.from_run(out, path)
    beside = {} if relative is None else {capture_place.KEY: relative}
    config = replace(config, data=replace(config.data, path=path))
    write_json(out / "config.json", {"format": FORMAT, **beside, **to_json(config)})


def read_config(run: Path) -> RunConfig:
    """The configuration of a run folder, with the path of its capture where it is now. Raises InputError when it is none."""
    if not (run / "config.json").is_file():
        raise InputError(f"expected a run folder with config.json at {run}, found none; give the folder that `train --out` wrote")
    value = read_json(run / "config.json", "run configuration")
    if not isinstance(value, dict) or value.pop("format", None) != FORMAT:
        raise InputError(f"expected a run configuration of format {FORMAT} in {run}, found another; train it again with this version")
    relative = value.pop(capture_place.KEY, None)
    try:
        config = from_json(RunConfig, value)
    except UnknownPart:  # of another package, perhaps
        RECIPES.load()
        config = from_json(RunConfig, value)
    path = capture_place.find(run, config.data.path, relative if isinstance(relative, str) else None)
    return replace(config, data=replace(config.data, path=path))


def named(data: Data) -> Data:
    """`data` with `catalog:SCENE` replaced by the scene's folder and, where they are "auto", the paper's resolution and split."""
    path, resolution, split = resolve(data.path, data.resolution, data.split)
    return replace(data, path=path, resolution=resolution, split=split)


def load_capture(data: Data, seed: int = 0, look: bool = False) -> Capture:
    """The capture that `data` describes; `look` admits one without points, which nothing can be trained on."""
    if data.background and not all(math.isfinite(v) and 0 <= v <= 1 for v in data.background):
        raise InputError(f"expected --background as three numbers between 0 and 1, found {list(data.background)}; correct them")
    if data.near is not None and not 0 < data.near < math.inf:
        raise InputError(f"expected --near as a positive length, found {data.near}; leave it out for min(0.2, 0.02 R)")
    capture = captures.load(
        data.path,
        images=data.images,
        resolution=data.resolution,
        split=data.split,
        missing=data.missing,
        normalise=data.normalise,
        init=data.init,
        max_views=data.max_views,
        ignore_principal_point=data.ignore_principal_point,
        background=data.background,
        seed=seed,
        allow_no_points=look,
    )
    if data.near is None:
        return capture
    return replace(capture, views=tuple(replace(v, camera=replace(v.camera, near=data.near)) for v in capture.views))


def capture_of(run: OpenRun, data: Path | None = None) -> Capture:
    """The capture that a run was trained on; data: where it is now, if it moved.

    Raises InputError, naming --data, where it is gone, and where there are other views (its world would be another).
    """
    where = named(run.config.data if data is None else replace(run.config.data, path=data))
    if data is None and not where.path.exists():
        raise InputError(f"expected the run's capture at {where.path}, found nothing there; say where it is with --data")
    capture = load_capture(where, run.cfg.seed)
    if run.capture not in ("", capture.fingerprint()):
        capture.images.close()
        raise InputError(f"expected the capture that {run.path} was trained on, found other views in {capture.root}; give the right --data")
    return capture


def with_capture(run: OpenRun, data: Path | None) -> OpenRun:
    """The run with its capture at `data` (a folder or catalog:SCENE); as it is where that is None."""
    if data is None:
        return run
    return replace(run, config=replace(run.config, data=replace(run.config.data, path=named(Data(data)).path)))


def open_run(run: Path, device: str = "cpu", step: int | None = None) -> OpenRun:
    """The newest whole checkpoint of a run (or the one at `step`). Raises InputError when there is none."""
    config = read_config(run)
    folder = run / "checkpoints"
    tensors, meta = newest(folder) if step is None else at_step(folder, step)
    checkpoint.expect(meta, recipe=config.train.recipe)
    cfg = config.train.scaled()
    scene = scene_from(cfg, tensors, meta).to(device)
    return OpenRun(run, config, cfg, scene, int(meta["step"]), Clock.of(meta), meta.get("capture", ""))


def newest(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and meta of the newest whole checkpoint."""
    found = checkpoint.newest(folder)
    if found is None and any(folder.glob("ckpt_*.safetensors")):
        raise InputError(f"expected a whole checkpoint in {folder}, found only damaged ones; copy one back or train again")
    if found is None:
        raise InputError(
            f"expected a checkpoint in {folder}, found none; train it first (`train --resume` goes on with a run that was stopped)"
        )
    return found


def at_step(folder: Path, step: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and meta of the checkpoint at a step."""
    path = folder / f"ckpt_{step:06d}.safetensors"
    if not path.is_file():
        kept = ", ".join(str(int(p.stem[5:])) for p in sorted(folder.glob("ckpt_*.safetensors")) if p.stem[5:].isdigit()) or "none"
        raise InputError(f"expected a checkpoint at step {step} in {folder}, found {kept}; give one of those, or leave --step out")
    return checkpoint.load(path)
