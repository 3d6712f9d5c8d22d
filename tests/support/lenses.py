"""One lens of every camera model."""

from __future__ import annotations

from scene_experts.data.lens import Lens

LENSES = [
    Lens("SIMPLE_PINHOLE", 160, 120, (130.0, 83.0, 57.0)),
    Lens("PINHOLE", 160, 120, (130.0, 133.0, 83.0, 57.0)),
    Lens("SIMPLE_RADIAL", 160, 120, (130.0, 83.0, 57.0, -0.12)),
    Lens("RADIAL", 160, 120, (130.0, 78.0, 61.0, 0.08, -0.03)),
    Lens("OPENCV", 160, 120, (130.0, 133.0, 83.0, 57.0, -0.2, 0.05, 0.001, -0.002)),
    Lens("OPENCV_FISHEYE", 160, 120, (110.0, 112.0, 82.0, 58.0, 0.03, -0.01, 0.004, -0.001)),
    Lens("FULL_OPENCV", 160, 120, (130.0, 133.0, 83.0, 57.0, -0.1, 0.03, 0.002, -0.001, 0.01, 0.05, -0.01, 0.002)),
    Lens("FOV", 160, 120, (130.0, 133.0, 83.0, 57.0, 0.7)),
    Lens("SIMPLE_RADIAL_FISHEYE", 160, 120, (110.0, 83.0, 57.0, 0.02)),
    Lens("RADIAL_FISHEYE", 160, 120, (110.0, 83.0, 57.0, 0.02, -0.01)),
    Lens("THIN_PRISM_FISHEYE", 160, 120, (110.0, 112.0, 83.0, 57.0, 0.02, -0.01, 0.001, 0.002, 0.003, -0.001, 0.001, -0.002)),
]
IDS = [lens.model for lens in LENSES]
