"""Records of invented runs with known scores."""

from dataclasses import replace
from pathlib import Path

from scene_experts.data.settings import Data
from scene_experts.reproduce.store import Record
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES


def record(
    recipe="moe-gs", scene="fox", seed=0, psnr=30.0, views=4, iterations=3000, mb=10.0, active=0.6, seconds=100.0, **results
) -> Record:
    """A record whose view v scores psnr + v, so that the mean is psnr + (views - 1) / 2."""
    per_view = {f"{v}.png": {"psnr": psnr + v, "ssim": 0.9} for v in range(views)}
    found = {
        "psnr": psnr + (views - 1) / 2,
        "ssim": 0.9,
        "lpips_3dgs": 0.2,
        "size": {"MB": mb},
        "anchors": 1000,
        "activation_ratio": active,
        "train_seconds": seconds,
        "experts": {"cov": {"share": [0.5, 0.3, 0.2], "mean_gate": [0.4, 0.3, 0.3]}},
        **results,
    }
    cfg = replace(RECIPES[recipe][1], iterations=iterations, seed=seed)
    curves = [{"step": s, "seconds": s / 10, "psnr": 20.0, "scene_routing": {"cov": [0.5, 0.3, 0.2]}} for s in (10, 20, 30)]
    return Record(scene, RunConfig(cfg, Data(Path(scene))), found, per_view, curves, 20.0)
