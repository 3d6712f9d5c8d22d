"""The run folder of a training: its files, and functions that write and open it.

RUN/config.json                      recipe, numbers, capture, command, versions
RUN/metrics.jsonl                    one line per logged iteration
RUN/checkpoints/ckpt_NNNNNN.safetensors
RUN/point_cloud/iteration_N/, RUN/cameras.json      the Scaffold-GS layout, in the coordinate frame
of the capture RUN/previews/, RUN/test/, RUN/results.json, RUN/per_view.json
RUN/.lock                            held by the training that writes to this folder
"""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import scene_experts.training.recipes  # noqa: F401  registers the parts of this package, and finds those of others
from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, few
from scene_experts.core.io import locked, read_json, write_json
from scene_experts.core.plain import MOST_DIFFERENCES, differences, from_json, to_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding
from scene_experts.core.version import __version__
from scene_experts.data import capture as captures
from scene_experts.data.capture import Capture
from scene_experts.data.fetch.obtain import resolve
from scene_experts.data.settings import Data
from scene_experts.scene import Scene
from scene_experts.scene.exposure import Exposures
from scene_experts.scene.fit import restore_foreign
from scene_experts.scene.poses import Poses
from scene_experts.training import capture_place
from scene_experts.training.capture_place import Lone
from scene_experts.training.clock import Clock
from scene_experts.training.config import RunConfig

FORMAT = 1
PICTURES = ("renders", "gt", "errors", "side_by_side", "masks", "experts")  # folders with the images of an evaluation


@dataclass(frozen=True)
class OpenRun:
    """A trained scene with its capture and configuration."""

    path: Path
    config: RunConfig
    scene: Scene
    step: int
    clock: Clock  # of the training
    capture: str = ""  # fingerprint of the capture that the run was trained on; empty if unknown
    poses: str = ""  # of that capture, see `Capture.poses`; empty if unknown
    box: tuple[float, ...] = ()  # as `Training.box`
    lone: Lone | None = None  # for a scene of a file; None for a run folder

    @property
    def cameras(self) -> Capture | None:
        """The cameras in place of a capture; None for a scene that has one."""
        return None if self.lone is None else self.lone.capture


def versions() -> dict[str, str]:
    """Return the versions of the software and the machine type that a run records."""
    return {
        "scene-experts": __version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def check(out: Path, config: RunConfig, resume: bool, overwrite: bool = False) -> None:
    """Check that a run can be written to `out`. Changes nothing on disk.

    Raises:
        InputError: The folder holds another run or foreign files, is that of `init_from`, or has a
            path that is not UTF-8, the settings are not finite, or the run to resume has another
            recipe, other capture settings, other training settings or another start.
    """
    place = next(p for p in (out, *out.absolute().parents) if p.exists())
    if not place.is_dir():
        raise InputError(f"expected a folder for the run at {out}, found a file at {place}; choose another --out")
    try:
        json.dumps(to_json(config), allow_nan=False)
    except ValueError:
        raise InputError("expected finite numbers in every setting, found nan or infinity; correct the flag") from None
    try:
        str(out.absolute()).encode()
    except UnicodeEncodeError:  # safetensors would write checkpoints there, but not read them
        raise InputError(f"expected a run folder whose path is UTF-8, found {str(out)!r}; choose another --out") from None
    if out.resolve() == config.data.path.resolve():
        raise InputError(f"expected a folder of its own for the run, found the capture's at {out}; choose another --out")
    if not resume and _place(config.init_from) == out.resolve():  # until the new run has a checkpoint, its start would exist nowhere
        raise InputError(f"expected another folder for the run than that of --init-from, found {out} for both; choose another --out")
    if foreign := _foreign(out):
        raise InputError(f"expected a new or empty folder or an earlier run at {out}, found {foreign} in it; choose another --out")
    if resume and overwrite:
        raise InputError("expected either resume (--resume) or overwrite (--overwrite), found both; leave one out")
    if resume and not (out / "config.json").is_file():
        raise InputError(f"expected an earlier run to resume in {out}, found none; begin one without --resume, or correct --out")
    if resume:
        _check_same(out, read_config(out), as_begun(out, config))
    elif not overwrite and any((out / "checkpoints").glob("ckpt_*.safetensors")):
        imported = config.command.startswith(("import ", "merged "))
        go_on = "" if imported else "continue it with --resume, replace it with --overwrite (in Python: resume=True, overwrite=True), or "
        raise InputError(f"expected a new or empty run folder, found checkpoints in {out}; {go_on}choose another folder (--out)")


def _foreign(out: Path) -> str:
    """Return the first file name in a folder that is not a run folder, or an empty string if
    nothing can be lost."""
    if any((out / "checkpoints").glob("ckpt_*.safetensors")):
        return ""
    try:
        if "format" in read_json(out / "config.json", "run configuration"):  # type: ignore[operator]
            return ""
    except (InputError, TypeError):
        pass
    names = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    found = [name for name in names if name not in (".lock", "paths") and not (name.startswith(".config.json.") and name.endswith(".part"))]
    return found[0] if found else ""


def _check_same(out: Path, found: RunConfig, config: RunConfig) -> None:
    """Raise InputError if a setting that affects the results differs between two configurations.
    The capture may have moved."""
    if found.train.recipe != config.train.recipe:
        raise InputError(
            f"expected a run of '{config.train.recipe}' to resume in {out}, found one of '{found.train.recipe}'; "
            f"use `train {found.train.recipe}` or another --out"
        )
    old = to_json(replace(found.data, path=Path())) | to_json(found.train)
    new = to_json(replace(config.data, path=Path())) | to_json(config.train)
    other = differences(old, new)
    if other:
        raise InputError(
            f"expected the settings that the run in {out} began with, found other settings: {few(other, MOST_DIFFERENCES)}; "
            f"resume with the run's own flags; to go on with others, train into another --out with --init-from {out}"
        )
    if config.init_from is not None and _place(config.init_from) != _place(found.init_from):
        raise InputError(
            f"expected the --init-from that the run in {out} began with ({found.init_from or 'none'}), found {config.init_from}; "
            "leave it out, or choose another --out"
        )


def _place(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()


_UNFINISHED = (".config.json.*.part", ".cfg_args.*.part", "checkpoints/.*.part", "previews/.*.part", "point_cloud/*/.*.part")
"""Temporary files of `core.io.write_atomic` that a killed training may leave; evaluations and
viewers write elsewhere."""


@contextmanager
def held(out: Path) -> Iterator[None]:
    """Lock `out` for one training. The lock ends with the process. Raises InputError if another
    training holds the lock."""
    out.mkdir(parents=True, exist_ok=True)
    busy = f"expected a run folder that nobody writes to, found a training at work in {out}; choose another --out"
    with locked(out / ".lock", busy):
        yield


def prepare(out: Path, config: RunConfig, resume: bool, overwrite: bool = False, exported: Iterable[Path] = ()) -> None:
    """Prepare `out` for a run: call `check`, remove unfinished files of a killed training, the
    metrics of a run that is not resumed and the checkpoints and results of an overwritten run, and
    write config.json."""
    check(out, config, resume, overwrite)
    if resume:  # a run is deterministic if all parts of its training were, and limited if one part was
        begun = read_config(out)
        limit = config.max_memory or begun.max_memory
        config = replace(config, deterministic=config.deterministic and begun.deterministic, max_memory=limit)
    for unfinished in (path for pattern in _UNFINISHED for path in out.glob(pattern)):
        unfinished.unlink(missing_ok=True)
    if not resume:
        (out / "metrics.jsonl").unlink(missing_ok=True)  # a run with --init-from keeps the lines up to its start
    if overwrite:
        results = [out / f"{name}{suffix}.json" for name in ("results", "per_view") for suffix in ("", "_train", "_half")]
        others = [*exported, out / "training_views.json", out / "report.html", out / "config.json"]
        for old in [*(out / "checkpoints").glob("ckpt_*.safetensors"), *(out / "previews").glob("*.png"), *results, *others]:
            old.unlink(missing_ok=True)
        for scored in (out / name for name in ("test", "train", "test_half", "train_half", "training_views")):
            for pictures in PICTURES:  # and nothing else that may lie there
                shutil.rmtree(scored / pictures, ignore_errors=True)
        for sidecar in (out / "point_cloud").glob("iteration_*/scene.json"):  # a later iteration's would be taken for the new run's
            shutil.rmtree(sidecar.parent, ignore_errors=True)
    _write_config(out, config)


def as_begun(out: Path, config: RunConfig) -> RunConfig:
    """Return the configuration with what the run in `out` decided where it decides nothing itself:
    `init_from`, the background of `train.mean_background` and the near plane of `train.near_share`.
    Unchanged if there is no run. For a run to resume."""
    if not (out / "config.json").is_file():
        return config
    begun = read_config(out)
    if config.train.mean_background and config.data.background is None:
        config = replace(config, data=replace(config.data, background=begun.data.background))
    if config.train.near_share and config.data.near is None:
        config = replace(config, data=replace(config.data, near=begun.data.near))
    return config if config.init_from is not None else replace(config, init_from=begun.init_from)


def as_trained(out: Path, config: RunConfig) -> RunConfig:
    """Return the configuration of the run in `out` with the capture at the place of `config`. For a
    run whose training has ended."""
    found = read_config(out)
    return replace(found, data=replace(found.data, path=config.data.path))


def _write_config(out: Path, config: RunConfig) -> None:
    """Write config.json with the absolute path of the capture and its path relative to the run
    folder."""
    path = capture_place.absolute(named(config.data).path)
    relative = capture_place.from_run(out, path)
    beside = {} if relative is None else {capture_place.KEY: relative}
    config = replace(config, data=replace(config.data, path=path))
    write_json(out / "config.json", {"format": FORMAT, **beside, **to_json(config)})


def read_config(run: Path) -> RunConfig:
    """Read the configuration of a run folder and find its capture. Raises InputError if the folder
    is not a run folder."""
    if not (run / "config.json").is_file():
        raise InputError(f"expected a run folder with config.json at {run}, found none; give the folder that `train --out` wrote")
    value = read_json(run / "config.json", "run configuration")
    if not isinstance(value, dict) or value.pop("format", None) != FORMAT:
        raise InputError(f"expected a run configuration of format {FORMAT} in {run}, found another; train it again with this version")
    relative = value.pop(capture_place.KEY, None)
    with guarding(run / "config.json", RUN, "run configuration"):
        config = from_json(RunConfig, value)
        config.train.scaled_scene()
    path = capture_place.find(run, config.data.path, relative if isinstance(relative, str) else None)
    return replace(config, data=replace(config.data, path=path))


def named(data: Data) -> Data:
    """Replace `catalog:SCENE` with the folder of the scene. A resolution or split of "auto" is
    replaced with that of the paper."""
    path, resolution, split = resolve(data.path, data.resolution, data.split)
    views = None if data.views is None else data.views.absolute()
    points = None if data.points is None else _settle(data.points, path)
    return replace(data, path=path, resolution=resolution, split=split, views=views, points=points)


def _settle(file: Path, capture: Path) -> Path:
    """Return where a file of the user is: relative to the capture if it lies inside, so that both
    may move, else absolute."""
    inside = file.absolute()
    if not inside.is_file() and (capture / file).is_file():
        return file
    return inside.relative_to(capture.absolute()) if inside.is_relative_to(capture.absolute()) else inside


def capture_of(run: OpenRun, data: Path | None = None) -> Capture:
    """Load the capture that a run was trained on, its training cameras where the run has refined
    them. `data` is its new location if it has moved.

    Raises InputError, which names --data, if the capture does not exist or has other views. Other
    views would define another world frame. A scene without a capture has `OpenRun.cameras`.
    """
    if run.cameras is not None:
        return run.cameras
    where = named(run.config.data if data is None else replace(run.config.data, path=data))
    if data is None and not where.path.exists():
        raise InputError(f"expected the run's capture at {where.path}, found nothing there; say where it is with --data")
    capture = captures.load(where, run.config.train.seed)
    if run.capture not in ("", capture.fingerprint()):
        capture.images.close()
        raise InputError(f"expected the capture that {run.path} was trained on, found other views in {capture.root}; give the right --data")
    capture.expect_poses(run.poses, run.path)
    return at_refined_poses(capture, run.scene)


def at_refined_poses(capture: Capture, scene: Scene) -> Capture:
    """Return a capture as it was loaded with its training cameras where a scene has refined
    them."""
    return capture if scene.poses is None else capture.with_cameras(scene.poses.refine)


def with_capture(run: OpenRun, data: Path | None) -> OpenRun:
    """Return the run with its capture at `data` (a folder or catalog:SCENE). None returns the run
    unchanged."""
    if data is None:
        return run
    return replace(run, config=replace(run.config, data=replace(run.config.data, path=named(Data(data)).path)))


def open_run(run: Path, device: str = "cpu", step: int | None = None) -> OpenRun:
    """Open the newest valid checkpoint of a run, or the one at `step`. Raises InputError if there
    is none."""
    config = read_config(run)
    folder = run / "checkpoints"
    tensors, meta = newest(folder) if step is None else at_step(folder, step)
    with guarding(run, RUN):
        checkpoint.expect(meta, recipe=config.train.recipe)
        scene = restore_foreign(config.train.scaled_scene(), tensors, meta, averaged=True)
        scene.exposures, scene.poses = Exposures.restore(tensors), Poses.restore(tensors)
        opened = OpenRun(run, config, scene, int(meta["step"]), Clock.of(meta), meta.get("capture", ""), meta.get("poses", ""))
        opened = replace(opened, box=tuple(meta.get("box", ())))
    return replace(opened, scene=scene.to(device))


def newest(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load the tensors and metadata of the newest valid checkpoint. Raises InputError if there is
    none."""
    found = checkpoint.newest(folder)
    if found is None and any(folder.glob("ckpt_*.safetensors")):
        raise InputError(f"expected a whole checkpoint in {folder}, found only damaged ones; copy one back or train again")
    if found is None:
        raise InputError(
            f"expected a checkpoint in {folder}, found none; train it first (`train --resume` goes on with a run that was stopped)"
        )
    return found


def at_step(folder: Path, step: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load the tensors and metadata of the checkpoint at a step. Raises InputError if there is
    none."""
    path = folder / f"ckpt_{step:06d}.safetensors"
    if not path.is_file():
        kept = ", ".join(str(int(p.stem[5:])) for p in sorted(folder.glob("ckpt_*.safetensors")) if p.stem[5:].isdecimal()) or "none"
        raise InputError(
            f"expected a checkpoint at step {step} in {folder}, found {kept}; give one of those, or leave --step out "
            "(train with --keep-checkpoints 0 to keep all that --save-every writes)"
        )
    return checkpoint.load(path)
