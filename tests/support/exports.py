"""Short runs to export, and the PSNR of their files."""

from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import registry
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of, table_columns
from scene_experts.files.measure import Painter
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.loop import Run, train
from support.synthetic import make_capture

SHORT = {"sh_degree": 1, "refine": 5}


def short_run(recipe: str, root: Path) -> Path:
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=250, scale=3.0).folder
    config = RunConfig(replace(RECIPES[recipe][1], iterations=300), Data(folder), stop_at=20)
    run_folder.prepare(root / "run", config, resume=False)
    capture = run_folder.load_capture(config.data)
    list(train(config.train, Run(config, root / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    return root / "run"


def measured(short: Path, file: Path, world: World | None = None) -> float:
    """PSNR of the held-out views as our own renderer draws the file."""
    opened = run_folder.open_run(short)
    capture, draw, total = run_folder.load_capture(opened.config.data), choose("auto", "cpu"), 0.0
    scene = scene_of(table_columns(registry.read(file), world or capture.world), capture.extent)
    painter = Painter.of(scene, DRAWN_AT, draw)
    with torch.no_grad():
        for index in capture.test:
            image = painter.picture_8bit(capture.views[index].camera, torch.tensor(capture.background))
            total += psnr(image, capture.frame(index).rgb.float() / 255)
    capture.images.close()
    return total / len(capture.test)
