"""Makes the coarse scene of layers: few anchors with coarse values, fitted to the pictures of the whole.

It begins with the Gaussians that give most to the training views. Its values and masks then move
until its pictures are those of the whole scene, at the price of their bits (`training.rate`). The
networks, the classes and the places of the anchors stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from scene_experts.core.schedule import Rate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Mode
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.precision import Precision, from_spread
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.files.anchors.rounding import rounded
from scene_experts.files.bake.views import Views
from scene_experts.files.measure import Painter, Tell
from scene_experts.render import Rasterizer
from scene_experts.scene.anchors.quantise import KEEP, ROUNDED
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.training.optim import FusedAdam
from scene_experts.training.photometric import photometric
from scene_experts.training.rate import MODEL, RATES, RateTerm, values_of
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.sensitivity import evenly
from scene_experts.view.filled import find_first_views, small

SHARE = 0.175  # of the bytes of the whole scene; a fit ends at 0.84 to 0.90 of it
SHIFTS = {"feature": 5, "log_scaling": 4, "offsets": 4}
"""Binary logarithms of the steps, in those of the whole scene."""
ITERATIONS = 500
VIEWS, SIDE = 64, 360  # training views that it is fitted to; px of their shorter side, at most
FREE_VIEWS = 32  # views between training views, whose pictures the whole scene has too
FIRST = 4  # every so many iterations see a first view
WEIGHT, LOOK, MOST_CHANGE = 0.006, 50, 2.0  # of the bits at first; iterations after which it follows the size, by this factor at most
BEGIN = 1.15  # times the size, at which the fit begins
DSSIM = 0.2
ROUNDS = 5  # of the search for the slots at first
LEAST = 64  # anchors, without which a scene has no coarse one
_RATES = {"feature": Rate(0.01, 0.001), "offsets": Rate(0.005, 0.0005), "log_scaling": Rate(0.007, 0.0007)}
_OPEN, _CLOSED = 1.0, -1.0  # logits of masks at first


@dataclass(frozen=True)
class Layered:
    """A scene of N anchors, and its coarse scene."""

    data: AnchorData
    rows: Tensor
    """[n] int64, of the anchors of the coarse scene, ascending"""
    coarse: AnchorData
    given: Tensor
    """[N], what each anchor gives to the first views: the sum of transmittance times opacity"""


@dataclass(frozen=True)
class _Pictures:
    """What the coarse scene is fitted to."""

    painter: Painter
    background: Tensor  # [3]
    views: list[Camera]
    first: list[Camera]
    cache: dict[int, Tensor]

    @torch.no_grad()
    def of(self, number: int) -> Tensor:
        """The picture [H, W, 3] of a view; the first views are numbered after the others."""
        if number not in self.cache:
            image = self.painter.picture_8bit(self.camera(number), self.background)
            self.cache[number] = (image * 255).round().to(torch.uint8)
        return self.cache[number].float() / 255

    def camera(self, number: int) -> Camera:
        return (*self.views, *self.first)[number]

    def given(self, cameras: Sequence[Camera], slots: int) -> Tensor:
        """The sums [slots] of transmittance times opacity over the pixels of some views."""
        out = torch.zeros(slots)
        for camera in cameras:
            g = self.painter.gaussians(camera)
            colors = g.colors.detach().clone().requires_grad_()
            if len(colors):
                self.painter.rasterize(replace(g, colors=colors), camera, self.background).image.sum().backward()
                assert colors.grad is not None
                out.index_add_(0, g.source, colors.grad.sum(1) / 3)
        return out


def make_layers(run: OpenRun, data: AnchorData, world: World, capture: Capture, rasterize: Rasterizer | None, tell: Tell) -> Layered:
    """A scene with its coarse scene.

    data: with its precision, or None for the one that `compact` has then. world: of the data. capture:
    with the cameras of the run.
    """
    data = replace(data, precision=data.precision or from_spread(data.columns, data.networks))
    scene, step = scene_of(run, rounded(data, _precision(data)), world)
    whole = cast(AnchorScene, scene)
    pictures = _make_pictures(Painter.of(whole, step, rasterize, run.config.train.antialias), capture)
    N, K = len(whole.table), whole.K
    given = pictures.given(pictures.first or pictures.views, N * K).view(N, K).sum(1)
    target = SHARE * compact.encode(data)[1].total
    kept = _choose(data, pictures.given(pictures.views + pictures.first, N * K), target)
    if int(kept.any(1).sum()) < LEAST:
        rows = torch.arange(N)
        return Layered(data, rows, _coarse(data, rows, torch.ones(N, K, dtype=torch.bool)), given)
    scene = _begin(whole, data, kept, world.scale)
    _fit(scene, step, run, pictures, lambda: compact.encode(_settle(scene, data))[1].total / target, tell)
    coarse, rows = _settle(scene, data), scene.table.facts["row"][(scene.table.params[KEEP] > 0).any(1)]
    return Layered(data, rows, coarse, given)


def _precision(data: AnchorData) -> Precision:
    assert data.precision is not None
    return data.precision


def _make_pictures(painter: Painter, capture: Capture) -> _Pictures:
    black = torch.zeros(3)
    first = find_first_views(capture, lambda camera: painter.rasterize(painter.gaussians(camera), camera, black))
    every, generator = Views.of(capture), torch.Generator().manual_seed(0)
    views = [capture.views[i].camera for i in evenly(capture.train, VIEWS)] + [every.free(generator) for _ in range(FREE_VIEWS)]
    background, filled = torch.tensor(capture.background), [_limit(view.camera) for view in first]
    return _Pictures(painter, background, [_limit(camera) for camera in views], filled, {})


def _limit(camera: Camera) -> Camera:
    return small(camera, min(SIDE, camera.width, camera.height))


def _coarse_steps(data: AnchorData) -> dict[str, Tensor]:
    return {name: _precision(data).steps[name] * 2.0 ** SHIFTS[name] for name in ROUNDED}


def _coarse(data: AnchorData, rows: Tensor, slots: Tensor, values: dict[str, Tensor] | None = None) -> AnchorData:
    """The coarse scene of anchors with masks [n, K], and of other values than those of the scene."""
    columns = {name: value[rows] for name, value in data.columns.items()} | (values or {})
    columns["slots"] = slots & columns["slots"] if "slots" in columns else slots
    precision = replace(_precision(data), steps=_coarse_steps(data), classes=_precision(data).classes[rows])
    return replace(data, columns=columns, cells=None if data.cells is None else data.cells[rows], precision=precision)


def _choose(data: AnchorData, given: Tensor, target: float) -> Tensor:
    """The slots [N, K] that give most, of as many as a file of BEGIN times `target` bytes holds."""
    N, K = data.columns["offsets"].shape[:2]
    order = given.argsort(descending=True)
    low, high, kept = 0, int((given > 0).sum()), torch.zeros(N * K, dtype=torch.bool)
    for _ in range(ROUNDS):
        middle = (low + high + 1) // 2
        chosen = torch.zeros(N * K, dtype=torch.bool)
        chosen[order[:middle]] = True
        rows = chosen.view(N, K).any(1).nonzero().squeeze(1)
        if compact.encode(_coarse(data, rows, chosen.view(N, K)[rows]))[1].total <= BEGIN * target:
            low, kept = middle, chosen
        else:
            high = middle - 1
    return kept.view(N, K)


def _begin(whole: AnchorScene, data: AnchorData, kept: Tensor, scale: float) -> AnchorScene:
    """The scene of the anchors with kept slots [N, K], which draws values as a coarse file holds
    them."""
    rows, table = kept.any(1).nonzero().squeeze(1), whole.table
    params = {name: value.detach()[rows].clone() for name, value in table.params.items()}
    scene = whole.with_table(Table(params, {**{name: value[rows] for name, value in table.facts.items()}, "row": rows}))
    steps = _coarse_steps(data)
    scene.start_rounding(torch.cat([steps[name] for name in ROUNDED]), _precision(data).classes[rows], scale)
    with torch.no_grad():
        scene.table.params[KEEP].copy_(torch.where(kept[rows], _OPEN, _CLOSED))
    return scene


def _settle(scene: AnchorScene, data: AnchorData) -> AnchorData:
    """The coarse scene as data."""
    table = scene.settled().table
    opened = (scene.table.params[KEEP].detach() > 0).any(1)
    values = {name: table.params[name].detach() for name in ROUNDED}
    values["log_scaling"] = values["log_scaling"] - math.log(scene.steps.scale if scene.steps is not None else 1.0)
    return _coarse(data, scene.table.facts["row"][opened], table.facts["slots"], values)


def _fit(scene: AnchorScene, step: int, run: OpenRun, pictures: _Pictures, size: Callable[[], float], tell: Tell) -> None:
    """Move the values and masks of the scene until its pictures are those that are wanted. size():
    of its file, in that which it should have."""
    term = RateTerm(WEIGHT, 0, run.config.train.growth, ITERATIONS)
    term.first, term.iterations = 0, ITERATIONS
    groups = {name: values for name, values in term.prepare(scene).items() if name in (KEEP, MODEL)}
    assert term.model is not None
    term.model.start(values_of(scene))
    groups |= {name: scene.rate_groups()[name] for name in ROUNDED}
    for parameter in scene.parameters():
        parameter.requires_grad_(any(parameter is one for group in groups.values() for one in group))
    optimizer = FusedAdam([{"params": params, "name": name, "lr": 0.0} for name, params in groups.items()])
    scene.table.attach(optimizer)
    rasterize, generator, queue = pictures.painter.rasterize, torch.Generator().manual_seed(0), list[int]()
    n, first = len(pictures.views), len(pictures.first)
    for i in range(ITERATIONS):
        if not queue:
            queue = torch.randperm(n, generator=generator).tolist()
        number = n + (i // FIRST) % first if first and i % FIRST == 0 else queue.pop()
        camera, target = pictures.camera(number), pictures.of(number)
        for group in optimizer.param_groups:
            group["lr"] = (_RATES | RATES)[group["name"]].at(i + 1, ITERATIONS)
        image = rasterize(scene(camera, step, Mode.TRAIN, rasterize.visible).gaussians, camera, pictures.background).image
        loss = sum(photometric(image, target, DSSIM))
        assert isinstance(loss, Tensor)
        if loss.requires_grad:
            loss.backward()
        term.add_gradients(scene, i + 1)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        if (i + 1) % LOOK == 0 and i + 1 < ITERATIONS:
            term.weight *= min(MOST_CHANGE, max(1 / MOST_CHANGE, size() ** 4))
        tell("fitting the coarse scene", i + 1, ITERATIONS)
