"""Chooses how precisely a compact file holds a scene: by what the training views may lose, or by
the size of the file. One number scales all steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import islice
from typing import cast

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.data.views import Capture, World
from scene_experts.evaluate.metrics import LEAST_MSE
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.precision import Precision
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.files.anchors.rounding import rounded
from scene_experts.files.anchors.sensitivity import keep, kept, measure
from scene_experts.files.measure import LOSS, Painter, Tell
from scene_experts.files.options import Options
from scene_experts.files.placed import AROUND, place_cameras
from scene_experts.files.scene_folder import origin_of
from scene_experts.render import Rasterizer, as_trained, choose
from scene_experts.scene import Scene
from scene_experts.scene.anchors.quantise import CLASS
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.sensitivity import MOST_VIEWS, evenly

VIEWS = 16  # that judge a precision
FEW = 4  # of them, that find about where it lies
START = -40.0  # first guess of log2 of the mean square error that every value adds
FINEST, COARSEST = -60.0, 0.0  # places that are tried: beyond, nothing is lost that 8 bits show, or nothing is left
ROUNDS = 10
UNKNOWN_ERROR = 10**-3.2  # mean square error of pictures without photographs: that of 32 dB
WORST_ERROR = 10**-2.6  # of a scene with 26 dB: what a worse one may lose is as if it had these
MEGABYTE = 1_000_000
UNJUDGED = "no photographs say what may be lost, so all values keep fine steps; --data CAPTURE makes a smaller file, by --quality"
NETWORKS = 0.1  # share of the loss that networks may have where a training has rounded the other values


@dataclass(frozen=True)
class Judge:
    """What a precision costs on the training views."""

    run: OpenRun
    world: World  # of the contents
    capture: Capture
    rasterize: Rasterizer | None

    @cached_property
    def views(self) -> list[int]:
        """The training views that judge."""
        chosen = evenly(self.capture.train, VIEWS)
        if not self.has_photographs:
            return chosen
        shown = (i for i in self.capture.train if _shows(self.capture, i))
        return [i for i in chosen if _shows(self.capture, i)] or list(islice(shown, 1))

    @property
    def has_photographs(self) -> bool:
        """Whether the loss is that against photographs. Without them it is estimated from the
        difference between the pictures, as if the run had 32 dB."""
        return len(self.capture.images) > 0

    @property
    def who(self) -> str:
        """What the views are called."""
        if self.has_photographs:
            return "training views"
        return AROUND if self.capture.kind == AROUND else f"cameras of {self.capture.kind}"

    @property
    def caveat(self) -> str:
        """What limits the loss, as the end of a sentence."""
        if self.has_photographs:
            return ""
        far = "; nearer views may lose many times as much" if self.capture.kind == AROUND else ""
        return f" (estimated, without photographs{far})"

    def _painter(self, scene: Scene, step: int) -> Painter:
        return Painter.of(scene, step, self.rasterize, self.run.config.train.antialias)

    @cached_property
    def _own(self) -> tuple[Painter, dict[int, tuple[Tensor, float]]]:
        """What draws the run, and what it has drawn: see `_before`."""
        return self._painter(self.run.scene, self.run.step), {}

    def _before(self, index: int) -> tuple[Tensor, float]:
        """The run's picture of a view as bytes, and its mean square error."""
        painter, drawn = self._own
        if index not in drawn:
            image = painter.picture_8bit(self.capture.views[index].camera, torch.tensor(self.capture.background))
            drawn[index] = (image * 255).round().to(torch.uint8), self._error(index, image)
        return drawn[index]

    def _error(self, index: int, image: Tensor) -> float:
        if not self.has_photographs:
            return UNKNOWN_ERROR
        frame = self.capture.frame(index)
        image = self.run.scene.as_photographed(image, self.capture.views[index].camera)
        return max(_mean_square(image, frame.rgb.float() / 255, frame.mask), LEAST_MSE)

    @torch.no_grad()
    def loss(self, contents: AnchorData, most: int = VIEWS) -> float:
        """What contents lose against the run, dB: the mean over at most `most` of the views. Of a
        scene whose errors a rounding happens to mend, it is what the difference between the
        pictures would cost."""
        painter, total, views = self._painter(*scene_of(self.run, contents, self.world)), 0.0, evenly(self.views, most)
        background = torch.tensor(self.capture.background)
        for index in views:
            own, error = self._before(index)
            image = painter.picture_8bit(self.capture.views[index].camera, background)
            away = _mean_square(image, own.float() / 255)
            after = max(error + away, self._error(index, image) if self.has_photographs else 0.0)
            total += max(10 * math.log10(after / error), 10 * math.log10(1 + away / WORST_ERROR))
        return total / len(views)


def _mean_square(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """The mean square difference of two pictures, in single precision."""
    squared = (image - target).square()
    return float(squared.mean() if mask is None else (squared * mask[..., None]).sum() / (3 * mask.sum()))


def _shows(capture: Capture, index: int) -> bool:
    mask = capture.frame(index).mask
    return mask is None or bool(mask.any())


def search(
    value: Callable[[float], float], wanted: float, start: float, slope: float, close: float, least: float = FINEST, most: float = COARSEST
) -> float | None:
    """A place u, `least` to `most`, where an increasing function is at most `wanted` and at least
    `close` times it, or the largest place with at most `wanted` that was tried; None: there is none.

    start: the first place. slope: about how much log2 of the function rises with u.
    """
    low: float | None = None
    high: float | None = None
    at = start
    for _ in range(ROUNDS):
        found = value(at)
        if found <= wanted:
            low = at if low is None else max(low, at)
            if found >= close * wanted:
                break
        else:
            high = at if high is None else min(high, at)
        guess = at + max(-8.0, min(8.0, math.log2(max(0.5 * (1 + close) * wanted, 1e-12) / max(found, wanted / 64, 1e-12)) / slope))
        if low is not None and high is not None and not low + 0.1 * (high - low) < guess < high - 0.1 * (high - low):
            guess = 0.5 * (low + high)
        guess = max(least, min(most, guess))
        if guess == at or (low is not None and high is not None and high - low < 0.02):
            break
        at = guess
    if low is None and high is not None and high > least and value(least) <= wanted:  # the slope was far away
        low = least
        for _ in range(ROUNDS // 2):
            at = 0.5 * (low + high)
            low, high = (at, high) if value(at) <= wanted else (low, at)
    return low


@contextmanager
def judging_capture(run: OpenRun, world: World, capture: Capture | None) -> Iterator[Capture]:
    """The capture, or the run's cameras without photographs where it is gone or has no training
    views."""
    if capture is not None and capture.train:
        yield capture
        return
    trained = run.scene.positions.detach().cpu().double()
    origin = origin_of(run, world)
    yield place_cameras(run.path, trained, world, origin, run.config.data.background)


def with_learned(precision: Precision, scene: AnchorScene) -> Precision:
    """The precision with the steps and classes that the training of a scene learned, if it did."""
    if scene.steps is None or CLASS not in scene.table.facts:
        return precision
    return replace(precision, steps=scene.steps.by_column(scene.config.F), classes=scene.table.facts[CLASS].cpu(), learned=True)


def explain_smallest(asked: float, smallest: float, learned: bool) -> str:
    """The error of a scene that does not fit into the size [MB] that was asked for."""
    more = ", or train with a larger --rate" if learned else ""
    return f"expected a --target-mb that this scene fits into, found {asked:g}; the smallest file has {smallest:.3f} MB, give more{more}"


def choose_precision(
    run: OpenRun,
    contents: AnchorData,
    world: World,
    options: Options,
    capture: Capture | None,
    rasterize: Rasterizer | None,
    tell: Tell,
    size: Callable[[AnchorData], int],
) -> tuple[AnchorData, list[str]]:
    """Contents with the precision that the options ask for, and a sentence about it.

    options: `quality` or `target_mb`. capture: whose training views judge; None: it is gone, and
    the run's cameras judge. world: of the run, in the frame of the capture. size: bytes of a file.
    Raises InputError for a size that no precision reaches.
    """
    if not len(contents.columns["xyz"]):
        return contents, []
    with judging_capture(run, world, capture) as views:
        precision = kept(run)
        if precision is None:
            cameras = [views.views[i].camera for i in evenly(views.train, MOST_VIEWS)]
            draws = as_trained(rasterize or choose("auto", "cpu"), run.config.train.antialias)
            precision = measure(cast(AnchorScene, run.scene), run.step, cameras, torch.tensor(views.background), draws, tell)
            keep(run, precision)
        if views.kind == AROUND and not options.target_mb:
            return contents, [UNJUDGED]
        unit, quality = with_learned(precision, cast(AnchorScene, run.scene)), options.quality
        if unit.learned:
            quality *= NETWORKS
        also = "; the training (--rate) has fixed the steps of all values but the networks'" if unit.learned else ""
        judge = Judge(run, world.seen_from(origin_of(run, world)), views, rasterize)

        @cache
        def loss(at: float, most: int = VIEWS) -> float:
            return judge.loss(rounded(contents, unit.at(2.0**at)), most)

        @cache
        def sized(at: float) -> int:
            return size(replace(contents, precision=unit.at(2.0**at)))

        if options.target_mb:
            wanted = options.target_mb * MEGABYTE
            place = search(lambda u: sized(-u), wanted, -START - 2, 0.12, 0.98, -COARSEST, -FINEST)
            if place is None:
                raise InputError(explain_smallest(options.target_mb, sized(COARSEST) / MEGABYTE, unit.learned))
            at = -place
        else:
            start = search(lambda at: loss(at, FEW), quality, START, 1.0, 0.85) if len(judge.views) > 2 * FEW else None
            found = search(loss, quality, START if start is None else start, 1.0, 0.85)
            at = FINEST if found is None else found
        lost = loss(at)
        lines = [f"{len(judge.views)} {judge.who} lose {lost:.3f} dB{judge.caveat}{also}"]
        if lost > LOSS:
            asked = "a larger --target-mb" if options.target_mb else "a smaller --quality"
            lines.append(f"warning: values are rounded so coarsely that pictures change; ask for {asked}")
        return replace(contents, precision=unit.at(2.0**at)), lines
