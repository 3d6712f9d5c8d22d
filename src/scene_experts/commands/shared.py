"""What several commands share: the choice of device and rasteriser, first words that stand for a flag."""

from __future__ import annotations

from scene_experts.api.backend import Device, Raster, backend

__all__ = ["Device", "Raster", "backend", "positional"]


def positional(args: list[str], flag: str) -> list[str]:
    """Let the first argument stand for `flag`: `info CAPTURE` for `info --data CAPTURE`."""
    return [flag, *args] if args and not args[0].startswith("-") else args
