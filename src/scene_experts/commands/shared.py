"""What several commands share: the choice of device and rasteriser."""

from __future__ import annotations

from scene_experts.api.backend import Device, Raster, backend

__all__ = ["Device", "Raster", "backend"]
