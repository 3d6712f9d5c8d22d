"""Run short trainings: settings, starts, events and the tensors of the last checkpoint."""

from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core import checkpoint
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training.config import RunConfig
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.captures import load

CHANGE = 0.01  # standard deviation, of each parameter before the first step

_start = Training.start  # as it is, for tests that put `start_changed` in its place


def config(recipe="moe-gs", **changes):
    """A recipe on a schedule of 600 iterations that grows within the first 120."""
    cfg = replace(RECIPES[recipe][1], **{"iterations": 600, **changes})
    growth = replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=20))
    return replace(cfg, growth=replace(growth, success_threshold=0.05) if hasattr(growth, "success_threshold") else growth)


@torch.no_grad()
def start_changed(cfg, capture, device="cpu", dtype=torch.float32, change=CHANGE) -> Training:
    """Start a training and change its parameters a little.

    A training starts with the Gaussians of an anchor at one place, and its first steps move them by equal lengths. Depths are then equal up
    to rounding, which decides the order of drawing. It differs between processors, devices and precisions, and so do the pictures.
    """
    training, generator = _start(cfg, capture, device, dtype), torch.Generator().manual_seed(0)
    for group in training.scene.rate_groups().values():
        for p in group:
            p.add_((change * torch.randn(p.shape, generator=generator)).to(device, dtype))
    return training


def events(cfg, folder, out=None, rasterizer="auto", world=None, **run):
    """Train on the capture in `folder` (or on the loaded capture `world`) and yield the events.

    ordered: sum in the order of the views, as `--deterministic` does. init: as `--init`.
    """
    data = Data(folder, init=run.pop("init", "points"))
    capture = world or load(folder, init=data.init)
    options = {"preview_every": 0, **{name: run.pop(name) for name in vars(TrainOptions()) if name in run and name != "device"}}
    config = RunConfig.of(cfg, data, TrainOptions(deterministic=run.pop("ordered", False), **options), "", {})
    made = Job(config, out, options=TrainOptions(**options), **run)
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
