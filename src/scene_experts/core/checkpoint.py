"""Checkpoints: named tensors and JSON metadata in one safetensors file. Files are written
atomically and verified when they are read.

The header of the file holds one JSON string under "scene_experts": {"kind", "format", "sha256",
"meta"}. The digest covers the name, dtype, shape and bytes of every tensor, so truncated,
overwritten and damaged files are detected. Nothing is pickled.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic
from scene_experts.core.reading.budget import CHECKPOINT, Damaged
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import guarding, shorten
from scene_experts.core.reading.tensors import find_not_finite, read_metadata, read_safetensors

FORMAT = 1
KIND = "checkpoint"
KEY = "scene_experts"
FINITE = ("params.", "facts.", "network.", "average.", "feature", "offsets", "log_scaling", "cells")
"""Prefixes of the tensors of a scene, whose values must be finite. Statistics and states of an
optimiser are not among them."""
_NAME = re.compile(r"ckpt_(\d{6,})\.safetensors")

log: logging.Logger = logging.getLogger(__name__)


# --- a folder of checkpoints --------------------------------------------------------------------------------------------------------------


def save(folder: Path, step: int, tensors: dict[str, Tensor], meta: dict[str, Any], keep: int = 2) -> Path:
    """Write `folder/ckpt_<step>.safetensors` atomically, then remove all but the newest `keep`
    files up to this step.

    Temporary files of an interrupted save are removed first.

    Args:
        folder: The folder of the checkpoints.
        step: The iteration.
        tensors: Tensors of any dtype that safetensors supports (float64 to bfloat16, integers,
            bool), on any device. They may share memory.
        meta: Plain JSON values without NaN.
        keep: Number of checkpoints to keep; 0: all.

    Returns:
        The path of the checkpoint.

    Raises:
        RunError: The disk is full or not writable. Earlier checkpoints are unchanged.
    """
    folder = Path(folder)
    for leftover in folder.glob(".ckpt_*.part"):
        leftover.unlink(missing_ok=True)
    path = folder / f"ckpt_{step:06d}.safetensors"
    write_tensors(path, tensors, KIND, FORMAT, meta)
    older = [file for number, file in _numbered(folder) if number < step]  # newest first
    for file in older[keep - 1 :] if keep else ():
        file.unlink(missing_ok=True)
    return path


def latest(folder: Path) -> Path | None:
    """Return the newest valid checkpoint in `folder`, or None. Truncated and damaged files are
    skipped with a warning."""
    found = _whole(folder)
    return found[0] if found else None


def newest(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Load the tensors and metadata of the newest valid checkpoint. Return None if there is none.

    Raises InputError if the format version differs.
    """
    found = _whole(folder)
    if found is None:
        return None
    path, tensors, meta = found
    _expect_format(_head(read_metadata(path, CHECKPOINT), KIND, path), KIND, FORMAT, path)
    return tensors, meta


def _whole(folder: Path) -> tuple[Path, dict[str, Tensor], dict[str, Any]] | None:
    for _, path in _numbered(Path(folder)):
        try:
            return path, *read_tensors(path, KIND)
        except InputError as error:
            log.warning("skipped a checkpoint: %s", error)
    return None


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load the tensors (on the CPU) and metadata of a checkpoint.

    Raises InputError if the file does not exist, is damaged, is not a checkpoint or has another
    format version.
    """
    return read_tensors(path, KIND, FORMAT)


def expect(meta: dict[str, Any], *, recipe: str) -> None:
    """Raise InputError if the checkpoint of `meta` was trained with another recipe."""
    found = meta.get("recipe")
    if found != recipe:
        raise InputError(f"expected a checkpoint of recipe '{recipe}', found one of '{found}'; use that recipe, or start in another folder")


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """Return (step, file) of every checkpoint in `folder`, newest first, without verifying the
    files."""
    if not folder.is_dir():
        return []
    found = [(_NAME.fullmatch(file.name), file) for file in folder.iterdir()]
    return sorted(((int(match[1]), file) for match, file in found if match), reverse=True)


# --- one file -----------------------------------------------------------------------------------------------------------------------------


def write_tensors(path: Path, tensors: dict[str, Tensor], kind: str, version: int, meta: dict[str, Any]) -> None:
    """Write tensors and metadata to a safetensors file of `kind` atomically. Raises RunError if the
    disk is full or not writable."""
    plain = _separate(tensors)
    text = json.dumps({"kind": kind, "format": version, "sha256": digest(plain), "meta": meta}, allow_nan=False)

    def write(temporary: Path) -> None:
        try:
            save_file(plain, temporary, metadata={KEY: text})
        except SafetensorError as error:  # safetensors reports a full disk with its own exception
            raise OSError(str(error)) from error

    write_atomic(Path(path), write)


def read_tensors(path: Path, kind: str, version: int | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors (on the CPU, without shared memory) and metadata that `write_tensors` wrote.

    A `version` of None accepts every format version.
    Raises InputError if the file does not exist, is truncated or damaged, or has another type, kind
    or version.
    """
    path = Path(path)
    with guarding(path, CHECKPOINT, f"{kind} file"):
        if version is not None and path.is_file():
            _expect_format(_head(read_metadata(path, CHECKPOINT, f"{kind} file"), kind, path), kind, version, path)
        tensors, metadata = read_safetensors(path, CHECKPOINT, f"{kind} file")
        head = _head(metadata, kind, path)
        if digest(tensors) != head["sha256"]:
            raise Damaged("one whose contents are damaged (checksum)")
        if name := find_not_finite(tensors, FINITE):
            raise Damaged(f"values that are not finite in {name}")
        return tensors, head["meta"]


def _expect_format(head: dict[str, Any], kind: str, version: int, path: Path) -> None:
    if head["format"] != version:
        raise InputError(
            f"expected a {kind} file of format {version} at {path}, found format {shorten(str(head['format']), 60)}; "
            f"use the version of scene-experts that wrote it, or write it again"
        )


def _head(metadata: dict[str, str], kind: str, path: Path) -> dict[str, Any]:
    """Parse and check the description in the metadata of a file."""
    try:
        text = metadata.get(KEY)
        head = parse_json(text) if text else None
    except (ValueError, RecursionError):
        head = None
    if not isinstance(head, dict) or not {"kind", "format", "sha256", "meta"} <= head.keys() or not isinstance(head["meta"], dict):
        raise InputError(f"expected a {kind} file of scene-experts at {path}, found another safetensors file; check the path")
    if head["kind"] != kind:
        raise InputError(f"expected a {kind} file at {path}, found a {shorten(str(head['kind']), 60)} file; check the path")
    return head


def digest(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of the names, dtypes, shapes and bytes of CPU tensors, sorted by name."""
    sha = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name]
        sha.update(f"{name}\0{value.dtype}\0{list(value.shape)}\0".encode())
        sha.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return sha.hexdigest()


def _separate(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return contiguous CPU tensors that share no memory, as safetensors requires."""
    seen: set[int] = set()
    out = {}
    for name, value in tensors.items():
        value = value.detach().cpu().contiguous()
        whole = value.untyped_storage().nbytes() == value.numel() * value.element_size()
        if not whole or value.untyped_storage().data_ptr() in seen:
            value = value.clone()
        seen.add(value.untyped_storage().data_ptr())
        out[name] = value
    return out
