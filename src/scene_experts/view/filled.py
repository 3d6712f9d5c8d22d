"""First views that fill a screen: by what a scene's pictures cover, and how many photographs saw it.

A screen is filled where at least FILLED of its pixels are covered and were seen. The pictures are
small, so that a search takes a few renderings of each photograph's place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.types import Camera, Render
from scene_experts.data.views import Capture
from scene_experts.geometry.poses import FREE, look_at, with_fov
from scene_experts.view.paths import analyse_cameras, rank_views

OPAQUE = 0.95  # opacity of a pixel that is covered
SEEN_BY = 3  # photographs that saw what a pixel shows
FILLED = 0.98  # share of the pixels that are covered and were seen
SHOWN = 2 / 3  # of a photograph's width or height that a first view shows at least
MOSTLY = 0.9  # share of pixels below which a scene is a lone object, or has gaps that no view avoids
ASPECTS = (9 / 19, 3 / 4, 1.0, 4 / 3, 16 / 9, 21 / 9)
"""Width to height of the screens that first views are chosen for."""
_SAFE = 0.01  # more than FILLED in small pictures
_MOST_VIEWS = 32  # whose pictures say what was seen
_TRIED = 5  # places that a first view is looked for at
_BEYOND = 1.5  # times a photograph's width and height that is looked at
HEIGHT = 1000  # px of a first view
_SIDE = 96  # px of the shorter side of the small picture of a photograph
_FINEST = 1.02  # between two fields of view that are tried
_BEHIND = 1.1  # times the depth up to which a point counts as the surface that a picture shows
Draw = Callable[[Camera], Render]


@dataclass(frozen=True)
class First:
    """A first view for screens of an aspect."""

    camera: Camera  # of that aspect, with a centred principal point
    share: float  # of its pixels that are covered and were seen, by the small picture


@dataclass(frozen=True)
class Evidence:
    """What photographs saw: the depths that a scene's pictures have at their places."""

    cameras: tuple[Camera, ...]  # small
    depths: tuple[Tensor, ...]  # [h, w] each; beyond it a point is hidden

    @classmethod
    def of(cls, capture: Capture, draw: Draw, most: int = _MOST_VIEWS, side: int = _SIDE) -> Evidence:
        """The evidence of at most `most` training views, evenly spread, whose pictures have a shorter
        side of `side` px."""
        chosen = capture.train or capture.test
        picked = np.linspace(0, len(chosen) - 1, min(len(chosen), most)).round().astype(int)
        cameras = tuple(small(capture.views[chosen[i]].camera, side) for i in picked)
        return cls(cameras, tuple(_farthest(draw(camera)) for camera in cameras))

    @property
    def least(self) -> int:
        """The photographs that have to have seen a point."""
        return min(SEEN_BY, len(self.cameras))

    def count(self, points: Tensor) -> Tensor:
        """By how many photographs each of the points [P, 3] was seen, [P]."""
        found = torch.zeros(len(points), dtype=torch.int64)
        for camera, depth in zip(self.cameras, self.depths):
            local = points @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]
            z = local[:, 2]
            x = (camera.fx * local[:, 0] / z.clamp_min(1e-9) + camera.cx).floor()
            y = (camera.fy * local[:, 1] / z.clamp_min(1e-9) + camera.cy).floor()
            inside = (z > camera.near) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            at = (y.nan_to_num(0).clamp(0, camera.height - 1) * camera.width + x.nan_to_num(0).clamp(0, camera.width - 1)).long()
            found += inside & (z <= depth.flatten()[at])
        return found

    def covered(self, camera: Camera, picture: Render) -> Tensor:
        """The pixels of a picture that are covered and that enough photographs saw, [H, W] bool."""
        rows, columns = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        z = picture.depth / picture.alpha.clamp_min(1e-6)
        local = torch.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], -1)
        points = (local.reshape(-1, 3) - camera.world_to_cam[:3, 3]) @ camera.world_to_cam[:3, :3]
        return (picture.alpha >= OPAQUE) & (self.count(points) >= self.least).reshape(picture.alpha.shape)


@dataclass(frozen=True)
class _Standpoint:
    """A photograph's place with what is covered around its picture."""

    camera: Camera  # of the photograph, small, perhaps turned
    wide: Camera
    covered: Tensor  # [H, W] of the wide picture
    away: float  # from what all photographs look at

    @cached_property
    def _sums(self) -> Tensor:
        return torch.nn.functional.pad(self.covered.double().cumsum(0).cumsum(1), (1, 0, 1, 0))

    def share(self, across: float, up: float) -> float:
        """The covered share of a view with these tangents of half its fields of view."""
        c = self.wide
        x, y = max(1, round(across * c.fx)), max(1, round(up * c.fy))
        left, right = max(0, c.width // 2 - x), min(c.width, c.width // 2 + x)
        top, low = max(0, c.height // 2 - y), min(c.height, c.height // 2 + y)
        s = self._sums
        return float(s[low, right] - s[top, right] - s[low, left] + s[top, left]) / ((right - left) * (low - top))

    def widest(self, aspect: float) -> _View:
        """The widest view of an aspect that is filled; without one, the view that is covered best."""
        X, Y = _tangents(self.camera)
        fitted, best = min(Y, X / aspect), _View(self, 0.0, 0.0, -1.0)
        tries = round(math.log(_BEYOND / SHOWN) / math.log(_FINEST))
        for up in (fitted * _BEYOND / _FINEST**i for i in range(tries + 1)):
            if aspect * up > _BEYOND * X or up > _BEYOND * Y or (up > Y and aspect * up > X):
                continue  # more than was looked at, or than the whole photograph
            view = _View(self, up, min(up, aspect * up) * self.away, self.share(aspect * up, up))
            if view.is_filled:
                return view
            best = max(best, view, key=lambda found: found.share)
        return best


@dataclass(frozen=True)
class _View:
    """A view from a place."""

    place: _Standpoint
    up: float  # tangent of half its height
    size: float  # half the height or width that it shows, the smaller one, where all photographs look
    share: float  # that is covered

    @property
    def is_filled(self) -> bool:
        return self.share >= FILLED + _SAFE

    @property
    def rank(self) -> tuple[bool, float]:
        """Larger for better views."""
        return self.is_filled, self.size if self.is_filled else self.share

    def camera(self, aspect: float) -> Camera:
        return with_fov(self.place.camera, 2 * math.atan(self.up), round(HEIGHT * aspect), HEIGHT)


@torch.no_grad()
def find_first_views(capture: Capture, draw: Draw, aspects: Sequence[float] = ASPECTS) -> list[First]:
    """First views for screens of some aspects, from places of training photographs.

    draw: draws the scene over black. A view looks as its photograph does, or at the point that all
    photographs look at. Of the filled views that show at least SHOWN of a photograph's width or
    height, the one is taken that shows the largest piece of the scene; without one, the view that
    is covered best. An aspect whose best view is covered by less than MOSTLY has none.
    """
    if not capture.views:
        return []
    rig, evidence, places = analyse_cameras(capture), Evidence.of(capture, draw), []
    for index in rank_views(capture)[:_TRIED]:
        camera = small(capture.views[index].camera)
        away = float((camera.position.double() - rig.centre).norm())
        aimed = replace(camera, world_to_cam=look_at(camera.position.double(), rig.centre, rig.up).float())
        for turned in (camera, aimed):
            wide = _widened(turned)
            places.append(_Standpoint(turned, wide, evidence.covered(wide, draw(wide)), away))
    best = [max((place.widest(aspect) for place in places), key=lambda view: view.rank) for aspect in aspects]
    return [First(view.camera(aspect), view.share) for view, aspect in zip(best, aspects) if view.share >= MOSTLY]


def _tangents(camera: Camera) -> tuple[float, float]:
    """Of half the fields of view across and up, of the smaller half of a picture off its centre."""
    across, up = min(camera.cx, camera.width - camera.cx) / camera.fx, min(camera.cy, camera.height - camera.cy) / camera.fy
    return max(across, 0.25 * camera.width / camera.fx), max(up, 0.25 * camera.height / camera.fy)


def small(camera: Camera, side: int = _SIDE) -> Camera:
    """A free camera with the view of another one, whose shorter side has `side` px."""
    scale = side / min(camera.width, camera.height)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    K = camera.K * torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    return replace(camera, K=K, width=width, height=height, id=FREE)


def _widened(camera: Camera) -> Camera:
    """A camera that sees _BEYOND times as much in both directions, with a centred principal point."""
    width, height = 2 * math.ceil(0.5 * _BEYOND * camera.width), 2 * math.ceil(0.5 * _BEYOND * camera.height)
    K = torch.tensor([[camera.fx, 0.0, width / 2], [0.0, camera.fy, height / 2], [0.0, 0.0, 1.0]])
    return replace(camera, K=K, width=width, height=height)


def _farthest(picture: Render) -> Tensor:
    """The depth beyond which a point is hidden: the largest of a pixel's neighbours."""
    depth = picture.depth / picture.alpha.clamp_min(1e-6)
    return _BEHIND * torch.nn.functional.max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
