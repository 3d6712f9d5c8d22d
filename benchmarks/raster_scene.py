"""The benchmark scene of the rasterisers, which `scene-experts bench` uses too."""

from scene_experts.bench.cloud import POINTS, Cloud, make_cloud, make_scene, read_cloud

__all__ = ["POINTS", "Cloud", "make_cloud", "make_scene", "read_cloud"]
