"""Reads files of named tensors (safetensors), which hold no code. Their memory is that of the
file."""

from __future__ import annotations

from pathlib import Path

from safetensors import safe_open
from torch import Tensor

from scene_experts.core.reading.budget import Budget, CutShort
from scene_experts.core.reading.numbers import all_finite
from scene_experts.core.reading.source import Source, opening

_HEADER_LIMIT = 32 << 20  # bytes of the JSON header, which the library parses at once


def read_safetensors(path: Path, budget: Budget, what: str | None = None) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors (on the CPU, each with memory of its own) and the metadata of a
    safetensors file.

    Raises InputError if the file is absent, damaged or beyond its budget.
    """
    with opening(path, budget, what) as source:
        check_header(source)
        with safe_open(path, framework="pt", device="cpu") as file:
            names = list(file.keys())
            source.spend_items(len(names))
            tensors = {name: file.get_tensor(name).clone() for name in names}
            return tensors, file.metadata() or {}


def read_metadata(path: Path, budget: Budget, what: str | None = None) -> dict[str, str]:
    """Return the metadata of a safetensors file without its tensors. Raises InputError as
    `read_safetensors` does."""
    with opening(path, budget, what) as source:
        check_header(source)
        with safe_open(path, framework="pt", device="cpu") as file:
            return file.metadata() or {}


def check_header(source: Source) -> None:
    """Raise Damaged for a header that is longer than the file or than any honest one."""
    size = int.from_bytes(source.head(8), "little")
    if not 2 <= size <= min(source.size - 8, _HEADER_LIMIT):
        raise CutShort(f"a header of {size:,} bytes in a file of {source.size:,}")


def find_not_finite(tensors: dict[str, Tensor], prefixes: tuple[str, ...]) -> str | None:
    """Return the name of the first tensor with one of the prefixes that has values that are not
    finite, or None."""
    return next((name for name, value in tensors.items() if name.startswith(prefixes) and not all_finite(value)), None)
