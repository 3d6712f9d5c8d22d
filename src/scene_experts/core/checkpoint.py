"""Checkpoints: named tensors and a JSON description in one safetensors file, written whole or not at all, checked when read.

A file is a safetensors file whose header carries one JSON string under "scene_experts": {"kind", "format", "sha256", "meta"}. The digest
covers every tensor's name, dtype, shape and bytes, so a file that was cut, overwritten or damaged is told from a whole one. Nothing is
pickled.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic

FORMAT = 1
KIND = "checkpoint"
KEY = "scene_experts"
_NAME = re.compile(r"ckpt_(\d{6,})\.safetensors")

log: logging.Logger = logging.getLogger(__name__)


# --- a folder of checkpoints --------------------------------------------------------------------------------------------------------------


def save(folder: Path, step: int, tensors: dict[str, Tensor], meta: dict[str, Any], keep: int = 2) -> Path:
    """Write `folder/ckpt_<step>.safetensors` atomically, then remove all but the newest `keep` files up to this step.

    tensors: any dtype that safetensors has (float64 to bfloat16, integers, bool), any device; they may share memory.
    meta: plain JSON values without NaN. What a killed save left behind is removed first.
    Raises RunError when the disk is full or not writable; the checkpoints before this one are then untouched.
    """
    folder = Path(folder)
    for leftover in folder.glob(".ckpt_*.part"):
        leftover.unlink(missing_ok=True)
    path = folder / f"ckpt_{step:06d}.safetensors"
    write_tensors(path, tensors, KIND, FORMAT, meta)
    older = [file for number, file in _numbered(folder) if number < step]  # newest first
    for file in older[max(keep, 1) - 1 :]:
        file.unlink(missing_ok=True)
    return path


def latest(folder: Path) -> Path | None:
    """The newest checkpoint in `folder` that is whole, or None; files cut short or damaged are skipped with a warning."""
    found = _whole(folder)
    return found[0] if found else None


def newest(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Tensors and meta of the newest whole checkpoint, read once; None where there is none.

    Raises InputError for another format version.
    """
    found = _whole(folder)
    if found is None:
        return None
    path, tensors, meta = found
    with safe_open(path, framework="pt", device="cpu") as file:
        _expect_format(_head((file.metadata() or {}).get(KEY), KIND, path), KIND, FORMAT, path)
    return tensors, meta


def _whole(folder: Path) -> tuple[Path, dict[str, Tensor], dict[str, Any]] | None:
    for _, path in _numbered(Path(folder)):
        try:
            return path, *read_tensors(path, KIND)
        except InputError as error:
            log.warning("skipped a checkpoint: %s", error)
    return None


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors (CPU) and meta of a checkpoint. Raises InputError when it is absent, damaged, of another format version, or none at all."""
    return read_tensors(path, KIND, FORMAT)


def expect(meta: dict[str, Any], *, recipe: str) -> None:
    """Raises InputError when the checkpoint that `meta` describes was trained with another recipe."""
    found = meta.get("recipe")
    if found != recipe:
        raise InputError(f"expected a checkpoint of recipe '{recipe}', found one of '{found}'; use that recipe, or start in another folder")


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """(step, file) of every checkpoint in `folder`, newest first, whole or not."""
    if not folder.is_dir():
        return []
    found = [(_NAME.fullmatch(file.name), file) for file in folder.iterdir()]
    return sorted(((int(match[1]), file) for match, file in found if match), reverse=True)


# --- one file -----------------------------------------------------------------------------------------------------------------------------


def write_tensors(path: Path, tensors: dict[str, Tensor], kind: str, version: int, meta: dict[str, Any]) -> None:
    """Write tensors and meta to a safetensors file of `kind`, atomically. Raises RunError when the disk is full or not writable."""
    plain = _separate(tensors)
    text = json.dumps({"kind": kind, "format": version, "sha256": digest(plain), "meta": meta}, allow_nan=False)

    def write(temporary: Path) -> None:
        try:
            save_file(plain, temporary, metadata={KEY: text})
        except SafetensorError as error:  # the library reports a full disk in its own type
            raise OSError(str(error)) from error

    write_atomic(Path(path), write)


def read_tensors(path: Path, kind: str, version: int | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors (CPU, in memory of their own) and meta that `write_tensors` wrote; `version` None admits every format version.

    Raises InputError: no such file, not one of ours, of another kind or version, cut short, or damaged.
    """
    path = Path(path)
    what = f"a {kind} file"
    if not path.is_file():
        raise InputError(f"expected {what} at {path}, found none; check the path")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            head = _head((file.metadata() or {}).get(KEY), kind, path)
            if version is not None:
                _expect_format(head, kind, version, path)
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"expected {what} at {path}, found one cut short or damaged ({error}); use an older one or copy it again"
        ) from error
    if digest(tensors) != head["sha256"]:
        raise InputError(f"expected {what} at {path}, found one whose contents are damaged (checksum); use an older one or copy it again")
    return tensors, head["meta"]


def _expect_format(head: dict[str, Any], kind: str, version: int, path: Path) -> None:
    if head["format"] != version:
        raise InputError(
            f"expected a {kind} file of format {version} at {path}, found format {head['format']}; "
            f"use the version of scene-experts that wrote it, or write it again"
        )


def _head(text: str | None, kind: str, path: Path) -> dict[str, Any]:
    """The description in a file's header, its form checked."""
    try:
        head = json.loads(text) if text else None
    except json.JSONDecodeError:
        head = None
    if not isinstance(head, dict) or not {"kind", "format", "sha256", "meta"} <= head.keys() or not isinstance(head["meta"], dict):
        raise InputError(f"expected a {kind} file of scene-experts at {path}, found another safetensors file; check the path")
    if head["kind"] != kind:
        raise InputError(f"expected a {kind} file at {path}, found a {head['kind']} file; check the path")
    return head


def digest(tensors: dict[str, Tensor]) -> str:
    """SHA-256 of names, dtypes, shapes and bytes of CPU tensors, in the order of names."""
    sha = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name]
        sha.update(f"{name}\0{value.dtype}\0{list(value.shape)}\0".encode())
        sha.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return sha.hexdigest()


def _separate(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors on the CPU, contiguous, each in memory of its own, as safetensors wants them."""
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
