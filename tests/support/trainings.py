"""Run short trainings: settings, events and the tensors of the last checkpoint."""

from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core import checkpoint
from scene_experts.data.capture import load
from scene_experts.data.settings import Data
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.training.config import RunConfig
from scene_experts.training.loop import Run, train


def config(recipe="moe-gs", **changes):
    """A recipe on a schedule of 600 iterations that grows within the first 120."""
    cfg = replace(RECIPES[recipe][1], **{"iterations": 600, **changes})
    growth = replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=20))
    return replace(cfg, growth=replace(growth, success_threshold=0.05) if hasattr(growth, "success_threshold") else growth)


def events(cfg, folder, out=None, rasterizer="auto", world=None, **run):
    """Train on the capture in `folder` (or on the loaded capture `world`) and yield the events.

    ordered: sum in the order of the views, as `--deterministic` does.
    """
    capture = world or load(folder)
    made = Run(RunConfig(cfg, Data(folder), deterministic=run.pop("ordered", False), stop_at=run.pop("stop_at", None)), out=out, **run)
    try:
        yield from train(cfg, made, capture, choose(rasterizer, "cpu", deterministic=True))
    finally:
        if world is None:
            capture.images.close()


def last_tensors(out: Path) -> dict[str, torch.Tensor]:
    """The tensors of the last checkpoint of a run."""
    return checkpoint.load(checkpoint.latest(out / "checkpoints"))[0]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name
