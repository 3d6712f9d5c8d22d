"""Recipes of every composition on a shipped capture in thumbnails: train, change rows, resume to the bit, are scored."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.core import checkpoint
from scene_experts.core.types import Points
from scene_experts.data.capture import Capture
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.score import evaluate
from scene_experts.render import choose
from scene_experts.scene import restore_scene
from scene_experts.training.config import Train
from scene_experts.training.events import Densified, Finished, Started
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.lanes import slow_except
from support.places import DEMO
from support.trainings import assert_same, events, last_tensors

BUDDHA = DEMO / "buddha"
LAST, STOP = 40, 14  # densification runs before and after the stop; Top-k and all levels are in use


@pytest.fixture(scope="module")
def buddha():
    """Twelve views, two of them held out, and every 30th point."""
    capture = load(BUDDHA, resolution="longest:64", max_views=12)
    yield replace(capture, points=Points(capture.points.xyz[::30], capture.points.rgb[::30]))
    capture.images.close()


def short(recipe: str) -> Train:
    """The whole schedule in 40 iterations, with densification every 4 instead of every 100 iterations."""
    cfg = replace(RECIPES[recipe][1], iterations=LAST)
    return replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=4)))


def rows(cfg: Train, capture: Capture, out: Path, **run) -> tuple[list[int], list[int]]:
    """How many rows a training begins with and has after each adjustment, and the iterations that it begins and ends at."""
    seen = list(events(cfg, BUDDHA, out, world=capture, **run))
    assert isinstance(seen[0], Started) and isinstance(seen[-1], Finished)
    return [seen[0].anchors, *(e.edit.anchors for e in seen if isinstance(e, Densified))], [seen[0].step, seen[-1].step]


FAMILIES = ("moe-gs", "3dgs", "octree-gs", "sags")
PARTS = (
    "scene-experts-wide",
    "scaffold-gs-dist",
    "scaffold-gs-depth3",
    "moe-gs-posrouter",
    "moe-gs-no-cl",
    "moe-gs-e4-dense",
    "moe-gs-e3-top1",
)
"""Compositions that no other training of the tests has; those of `support.scenes.METHODS` are resumed in unit/training/test_loop.py."""


@pytest.mark.parametrize("recipe", slow_except((*FAMILIES, *PARTS), *FAMILIES))
def test_it_trains_grows_resumes_to_the_bit_and_is_scored(recipe, buddha, tmp_path):
    cfg = short(recipe)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    counts, _ = rows(cfg, buddha, whole)
    before, first = rows(cfg, buddha, parts, stop_at=STOP)
    after, second = rows(cfg, buddha, parts, resume=True)
    assert (first, second) == ([0, STOP], [STOP, LAST])
    assert before[-1] > before[0] and after[-1] > after[0], "rows come on both sides of the stop"
    assert before + after[1:] == counts and after[0] == before[-1]
    assert_same(last_tensors(whole), last_tensors(parts))

    tensors, meta = checkpoint.load(checkpoint.latest(parts / "checkpoints"))
    scene = restore_scene(cfg.scaled_scene(), tensors, meta)
    evaluate(scene, buddha, choose("auto", "cpu", deterministic=True), tmp_path, EvalOptions(lpips=False), step=LAST)
    results, per_view = (json.loads((tmp_path / name).read_text()) for name in ("results.json", "per_view.json"))
    assert math.isfinite(results["psnr"]) and results["anchors"] == counts[-1]
    assert len(per_view) == results["view_count"] == len(buddha.test) == 2
    assert all(math.isfinite(view["psnr"]) for view in per_view.values())
