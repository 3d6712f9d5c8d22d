"""OpenUSD's ParticleField3DGaussianSplat, exact; needs usd-core 26.3 or newer.

Scales and opacities are stored directly (no logarithms or logits), harmonics in the order of 3DGS.
+Y is up: half a turn about x from ours, so a USD camera without a transform looks the way ours
does. A name that ends in .usda gets the text form, others the binary one. usd-core runs in a
process of its own (`usd_worker.py`).
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_atomic
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import Source, opening, shorten
from scene_experts.core.version import package_folders
from scene_experts.files.formats.pack import (
    Floats,
    alphas,
    check_count,
    decoded_bytes,
    logits,
    tensor,
    turn,
    unit_quats,
    warn_of_transforms,
)
from scene_experts.files.formats.splats import Splats, tell_degree
from scene_experts.files.formats.usd_worker import COEFFICIENTS, DAMAGED, MISSING
from scene_experts.files.registry import Format

log: logging.Logger = logging.getLogger(__name__)
LONGEST = 3600  # seconds that a file may take to be written
_LOADED = 1 << 30  # bytes of addresses that Python, NumPy and usd-core reserve with one thread
_STARTING = 60  # seconds that usd-core may take to start on a busy machine, beside the time limit of a file


def write(path: Path, splats: Splats, note: dict[str, Any]) -> None:
    """Write the file; the note goes into customLayerData. Raises InputError without usd-core,
    RunError where it fails."""
    expect_library()
    s = turn(splats, "x")
    arrays = {
        "positions": s.means.numpy().astype(np.float32),
        "scales": s.log_scales.double().exp().numpy().astype(np.float32),
        "orientations": unit_quats(s)[:, [1, 2, 3, 0]].astype(np.float32),
        "opacities": alphas(s).astype(np.float32),
        "sh": s.sh.numpy().astype(np.float32),
        "note": np.array(json.dumps(note, default=str) if note else ""),
    }
    with tempfile.TemporaryDirectory(prefix="scene-experts-usd-") as folder:
        archive, made = Path(folder) / "arrays.npz", Path(folder) / f"scene{'.usda' if path.suffix.lower() == '.usda' else '.usdc'}"
        np.savez(archive, **arrays)  # type: ignore[arg-type]
        try:
            done = _work("write", archive, made, LONGEST)
        except Damaged as error:  # no file is at fault
            raise RunError(f"usd-core could not write {path}: {error}") from None
        if done.returncode or not made.is_file():
            raise RunError(f"usd-core could not write {path}: {shorten(done.stderr) or f'exit code {done.returncode}'}")
        write_atomic(path, lambda temporary: temporary.write_bytes(made.read_bytes()))


def read(path: Path) -> Splats:
    """The Gaussians of all prims of the kind, together. Transforms of prims are not applied, and y
    is taken as up; a warning tells where that is wrong. Other files are not opened.

    Raises InputError for damaged files, for files without such a prim, and without usd-core.
    """
    with opening(path, budget.USD) as source, tempfile.TemporaryDirectory(prefix="scene-experts-usd-") as folder:
        expect_library()
        archive, seconds = Path(folder) / "arrays.npz", int(budget.USD.time_limit(source.size)) + 1
        done = _work(
            "read",
            _named(path, source, Path(folder)),
            archive,
            _STARTING + 10 * seconds,
            str(_LOADED + budget.USD.allowance(source.size)),
            str(seconds),
        )
        if done.returncode == DAMAGED:
            raise Damaged(shorten(done.stdout))
        if done.returncode or not archive.is_file():
            raise Damaged("content that OpenUSD cannot read")
        source.spend_bytes(3 * archive.stat().st_size)  # float32, and float64 beside it
        with np.load(archive) as data:
            found = [_prim(source, data, i) for i in range(int(data["count"]))]
            moved, up = bool(data["moved"]), str(data["up"])
        if moved:
            warn_of_transforms(path)
        if up != "Y":
            log.warning("%s has the axis %s up, and is read as if it were Y: turn it before the import", path, shorten(up, 20))
        coefficients = min(part[4].shape[1] for part in found)
        means, scales, quats, opacity = (np.concatenate([part[i] for part in found]) for i in range(4))
        sh = np.concatenate([part[4][:, :coefficients] for part in found])
        stored = Splats(tensor(means), tensor(np.log(np.maximum(scales, 1e-30))), tensor(quats), tensor(logits(opacity)), tensor(sh))
        return turn(stored, "x").checked(path)


def read_note(path: Path) -> dict[str, Any]:
    """The note in a file of ours. Raises InputError as `read` does."""
    with opening(path, budget.USD) as source, tempfile.TemporaryDirectory(prefix="scene-experts-usd-") as folder:
        expect_library()
        seconds = int(budget.USD.time_limit(source.size)) + 1
        limits = (str(_LOADED + budget.USD.allowance(source.size)), str(seconds))
        done = _work("note", _named(path, source, Path(folder)), Path(folder), _STARTING + 10 * seconds, *limits)
        text = done.stdout.strip()
        found = parse_json(text, budget.NOTE) if done.returncode == 0 and text else {}
        return found if isinstance(found, dict) else {}


def _named(path: Path, source: Source, folder: Path) -> Path:
    """A file as one that is named .usd in `folder`: usd-core goes by the suffix, and a layer of that
    name may be binary or text."""
    named = folder / "scene.usd"
    named.symlink_to(path.absolute()) if hasattr(os, "symlink") and os.name != "nt" else named.write_bytes(source.read())
    return named


def expect_library() -> None:
    """Raises InputError where usd-core is missing."""
    if find_spec("pxr") is None:
        raise InputError(f"expected the package usd-core for OpenUSD files, found none; install it: {install_line('usd')}")


def _prim(source: Source, data: Any, number: int) -> tuple[Floats, ...]:
    """Means, scales, quaternions (w, x, y, z), opacities and harmonics of one prim."""
    means, scales, xyzw, opacity, flat = (
        data[f"{number}:{name}"].astype(np.float64) for name in ("positions", "scales", "orientations", "opacities", COEFFICIENTS)
    )
    degree = int(data[f"{number}:degree"])
    if not 0 <= degree <= 10:
        raise Damaged(f"harmonics of degree {degree}")
    tell_degree(degree)
    n, coefficients = len(means), (degree + 1) ** 2
    check_count(source, n, decoded_bytes(degree))
    if (len(scales), len(xyzw), len(opacity), len(flat)) != (n, n, n, n * coefficients):
        raise Damaged("arrays of different lengths")
    if not all(np.isfinite(part).all() for part in (means, scales, xyzw, opacity, flat)):
        raise Damaged("values that are not finite")
    return means, scales, xyzw[:, [3, 0, 1, 2]], opacity[:, 0], flat.reshape(n, coefficients, 3)[:, :16]


def _work(task: str, source: Path, target: Path, seconds: int, *limits: str) -> subprocess.CompletedProcess[str]:
    """Run the worker. Raises InputError for a usd-core that is too old, and Damaged after
    `seconds`."""
    roots = [str(folder.parent) for folder in package_folders()]
    paths = os.pathsep.join([*roots, *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "scene_experts.files.formats.usd_worker", task, str(source), str(target), *limits]
    environment = os.environ | {"PYTHONPATH": paths, "PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        raise Damaged(f"content that takes longer than {seconds} s to {task}") from None
    if done.returncode == MISSING:
        raise InputError(f"expected usd-core 26.3 or newer for OpenUSD files, found {shorten(done.stdout)}; pip install -U usd-core")
    return done


FORMAT = Format(
    suffix=".usdc",
    other_suffixes=(".usda", ".usd"),
    write=write,
    read=read,
    read_note=read_note,
    marks=(b"PXR-USDC", b"#usda"),
    needs=expect_library,
)
