"""Reads published weights of networks: a dict of tensors by name, as `torch.save` writes it. Nothing
in the file is executed."""

from __future__ import annotations

import zipfile
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import InputError, few
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.numbers import all_finite
from scene_experts.core.reading.source import opening


def read_state(path: Path, budget: Budget, wanted: dict[str, tuple[int, ...]], advice: str) -> dict[str, Tensor]:
    """Return the tensors of the file at `path`, which must have the names and shapes `wanted` and
    finite values.

    advice: What the user can do where the names or shapes are others: it ends the sentence.

    Raises InputError if the file is absent, damaged, beyond its budget, or has other tensors.
    """
    with opening(path, budget) as source:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as packed:
                members = packed.infolist()
            source.spend_items(len(members))
            source.spend_bytes(sum(member.file_size for member in members))
        with source.stream() as stream:
            found = torch.load(stream, map_location="cpu", weights_only=True)
        if not isinstance(found, dict) or not all(isinstance(name, str) and isinstance(value, Tensor) for name, value in found.items()):
            raise Damaged("no tensors by name")
        shapes = {name: tuple(value.shape) for name, value in found.items()}
        if odd := sorted(name for name in wanted.keys() | shapes.keys() if wanted.get(name) != shapes.get(name)):
            raise InputError(f"expected {len(wanted)} tensors of known shapes in {path}, found differences in {few(odd)}; {advice}")
        if bad := [name for name, value in found.items() if value.layout != torch.strided or not all_finite(value)]:
            raise Damaged(f"values that are not finite in {few(bad)}")
        return {name: value.float().contiguous() if value.is_floating_point() else value for name, value in found.items()}
