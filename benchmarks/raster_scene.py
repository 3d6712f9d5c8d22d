"""The benchmark scene of the rasterisers: the package's own, which `scene-experts bench` draws too."""

from scene_experts.bench.cloud import POINTS, Cloud, read, scene, synthetic

__all__ = ["POINTS", "Cloud", "read", "scene", "synthetic"]
