"""The dense start: points of the surfaces that the training photographs show, by a plane sweep.

1. `pictures`: the training photographs are reduced.
2. `pairs`: each view gets a few others to be compared with, and a range of depths.
3. `sweep`: each pixel gets the depth at which the others look most alike, if two of them find it too.
4. A point in front of a confirmed depth of any view goes: it would be fog before that view.
5. `cells`: the points are thinned until they are as many as wanted.
6. `holes`: parts of a picture without depth get points at the depth around them, or far away.

A point of the capture is kept where the new ones leave it uncovered.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data.dense.cells import SizedPoints, fuse, thin
from scene_experts.data.dense.holes import add_points, fill_holes
from scene_experts.data.dense.pairs import MARGINS, choose_pairs
from scene_experts.data.dense.pictures import SmallPictures, reduce_pictures
from scene_experts.data.dense.sweep import DepthMaps
from scene_experts.data.views import Capture

SIDE = 200  # px, longer side of the reduced pictures
PLANES = 64
COMPARED = 5  # views that a view is compared with
FEWEST = 3  # views with a sweep
IN_FRONT, FILL_IN_FRONT = 0.04, 0.02  # share of a depth by which a point, and one of a hole, may lie before it
SEEN = 3  # views whose depth a point must lie on, its own among them
THROUGH = 0.1  # views that may see through a point, per view that sees it
LEAST_DEPTH = 0.01  # share of the pictures that must have depth
WANTED = 13_000  # points, or as many as the capture has if those are more
PART = 1 / 3  # largest share of the points in holes, and of the capture's own
MANY = 12  # pixels looked at per point that is wanted; of more, every nth is taken
OF_CAP = 0.8  # share of the largest number of rows that the points may be, so that growth has room


class NoDenseStartError(InputError):
    """A capture for which no points can be computed. expected, why: What is needed and what was
    found, as parts of a sentence."""

    def __init__(self, expected: str, why: str, mend: str = "leave --init dense out") -> None:
        super().__init__(f"expected {expected} for --init dense, found {why}; {mend}")
        self.expected, self.why = expected, why


@dataclass(frozen=True)
class DenseStart:
    """Points to start a training from."""

    points: Points  # trained world
    views: int  # that were swept
    holes: float  # share of their pictures that has no depth, 0 to 1
    kept: int  # points of the capture among them
    seconds: float  # CPU time of this process

    def describe(self) -> str:
        """Return one line for the user."""
        also = f", {self.kept:,} of them the capture's own" if self.kept else ""
        return (
            f"{len(self.points.xyz):,} points by a plane sweep over {self.views} views{also} ({self.seconds:.1f} s CPU); "
            f"{100 * self.holes:.0f} % of the picture without depth"
        )


def start_densely(capture: Capture, most: int = 0) -> DenseStart:
    """Compute points from the training photographs of a capture. Its own points give the range of
    depths. The result is the same at any number of threads.

    There are about 13,000 points, or as many as the capture has if those are more: 0.6 to 0.9 times
    the anchors after 1,500 iterations on fox, banana, brighton and bonsai, so that growth has
    something left to do. That number hardly depends on the resolution (banana: 19,319 at 400 px,
    18,262 at 800 px). There are fewer points where the pictures have too little texture.

    most: Rows at which growth stops; 0: no limit. There are at most 0.8 times as many points.

    Raises:
        NoDenseStartError: The capture has no points, fewer than 3 of its training views overlap, or
            hardly any pixel has a depth.
        InputError: A photograph cannot be read, or there is no compiled library.
        RunError: Memory ran out.
    """
    began = time.process_time()
    if capture.points is None or len(capture.points.xyz) == 0:
        raise NoDenseStartError("3D points in the capture, which tell how far things are,", "none", "use --init random")
    if len(capture.train) < FEWEST:
        raise NoDenseStartError(f"at least {FEWEST} training views", f"{len(capture.train)}")
    own = SizedPoints.of(capture.points.xyz.double().numpy(), capture.points.rgb.numpy())
    maps = sweep_views(capture, own)
    own = clear_points(maps, own, IN_FRONT)
    holes, share = hole_points(maps, own)
    wanted = choose_number(len(capture.points.xyz), most)
    part = max(1, int(PART * wanted))
    if len(holes) > part:
        holes, _ = thin(holes, part)
    surface = surface_points(maps, MANY * wanted)
    first, edge = thin(surface, wanted - len(holes), least=2)
    own = own.pick(find_uncovered(own, first, edge)).spread(part)
    thinned, _ = thin(surface, wanted - len(holes) - len(own), least=2)
    parts = (own, clear_points(maps, thinned, IN_FRONT), holes)
    xyz, rgb = (np.concatenate(columns) for columns in zip(*((part.xyz, part.rgb) for part in parts)))
    points = Points(torch.from_numpy(xyz), torch.from_numpy(rgb.clip(0, 255).round().astype(np.uint8)))
    return DenseStart(points, maps.pairs.swept, share, len(own), time.process_time() - began)


def sweep_views(capture: Capture, own: SizedPoints) -> DepthMaps:
    """Return the confirmed depths of the training views. Raises NoDenseStartError as `start_densely`."""
    pictures = reduce_pictures(capture, SIDE)
    pairs = choose_pairs(pictures, own.xyz, COMPARED)
    if pairs.swept < FEWEST:
        raise NoDenseStartError(f"at least {FEWEST} training views that each overlap with two others", f"{pairs.swept} such views")
    maps = DepthMaps(pictures, pairs, PLANES)
    maps.keep_confirmed()
    swept = (pairs.planes[:, 1] > 0).repeat_interleave(pictures.start.diff())
    share = float((maps.inverse[swept] > 0).double().mean())
    if share < LEAST_DEPTH:
        raise NoDenseStartError("photographs that show depth", f"it in {100 * share:.1f} % of their pixels")
    return maps


def choose_number(own: int, most: int) -> int:
    """Return how many points are wanted. own: the number of the capture's points; most: the rows at
    which growth stops, or 0."""
    wanted = max(WANTED, own)
    return max(1, min(wanted, int(OF_CAP * most))) if most else wanted


def clear_points(maps: DepthMaps, cloud: SizedPoints, front: float, seen: int = 0) -> SizedPoints:
    """Return the points that `seen` views see or more, and through which hardly any view sees: one
    through which many see would be fog."""
    before, on = maps.compare(cloud.xyz, front)
    return cloud.pick((before <= THROUGH * on) & (on >= seen))


def find_uncovered(own: SizedPoints, surface: SizedPoints, edge: float) -> np.ndarray:
    """Return which points [n] have no point of the surface in reach of one cell. edge: of the
    cells, in footprints."""
    from scipy.spatial import KDTree  # takes long to import, and most trainings do not need it

    if len(own) == 0 or len(surface) == 0:
        return np.ones(len(own), dtype=np.bool_)
    distance, nearest = KDTree(surface.xyz).query(own.xyz)
    return distance > edge * surface.size[nearest]


def surface_points(maps: DepthMaps, most: int) -> SizedPoints:
    """Return points of pixels with a depth that enough views see and that hardly any view sees
    through: of every pixel, or of every nth so that there are about `most`."""
    every = max(1, int((maps.inverse > 0).sum()) // max(most, 1))
    cloud = SizedPoints.join([_cloud_of(maps.pictures, view, *_known(maps, view, every)) for view in range(len(maps.pictures))])
    return clear_points(maps, cloud, IN_FRONT, SEEN)


def hole_points(maps: DepthMaps, own: SizedPoints) -> tuple[SizedPoints, float]:
    """Return points for the parts of the pictures without depth and without a point of the
    capture's `own`, one in a cell of their spacing, and the share of these parts."""
    parts, cells = [], 0
    for view in range(len(maps.pictures)):
        width, height = maps.pictures.size[view].tolist()
        first, last = maps.pictures.start[view : view + 2].tolist()
        far, near = maps.pairs.planes[view].tolist()
        if near == 0:
            continue
        counts = maps.pictures.grey[first:last].numpy() >= 0
        pixels, depth = maps.pictures.find_pixels(view, own.xyz)
        known = add_points(maps.inverse[first:last].double().numpy().reshape(height, width), pixels, 1 / depth)
        found = fill_holes(known, far * MARGINS[1])  # at the depth of the farthest points
        inside = counts[found.pixels]
        part = _cloud_of(maps.pictures, view, found.pixels[inside], found.inverse[inside], np.ones(int(inside.sum())))
        parts.append(replace(part, size=part.size * found.edge))
        cells += found.cells
    cloud = SizedPoints.join(parts)
    share = len(cloud) / max(cells, 1)
    return fuse(clear_points(maps, cloud, FILL_IN_FRONT), 1.0), share


def _known(maps: DepthMaps, view: int, every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    first, last = maps.pictures.start[view : view + 2].tolist()
    inverse, score = maps.inverse[first:last].double().numpy(), maps.score[first:last].double().numpy()
    pixels = np.flatnonzero(inverse > 0)[view % every :: every]
    return pixels, inverse[pixels], score[pixels]


def _cloud_of(pictures: SmallPictures, view: int, pixels: np.ndarray, inverse: np.ndarray, weight: np.ndarray) -> SizedPoints:
    depth = 1 / inverse
    rgb = pictures.rgb[int(pictures.start[view]) + torch.from_numpy(pixels)].double().numpy()
    return SizedPoints(pictures.unproject(view, pixels, depth), rgb, depth / float(pictures.cameras[view, 12]), weight)
