"""Short real trainings on shipped data: the held-out score must not fall below what five seeds gave, and growth must improve the fit.

Record the seeds anew: SCENE_EXPERTS_RECORD=1 python -m pytest tests/system/test_quality.py
"""

import statistics
from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.data.settings import Data
from scene_experts.evaluate.metrics import psnr
from scene_experts.render import choose
from scene_experts.training.config import RunConfig
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.captures import load
from support.golden import recorded
from support.places import DEMO
from support.synthetic import make_capture

BRIGHTON = DEMO / "brighton"


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    coloured = make_capture(tmp_path_factory.mktemp("coloured"), views=24)
    loaded = {"brighton": load(BRIGHTON, resolution="factor:2"), "coloured": load(coloured.folder)}
    yield loaded
    for capture in loaded.values():
        capture.images.close()


@pytest.fixture(scope="module")
def held_out(captures):
    """A function that trains a recipe on a capture and returns the mean PSNR of the held-out (or the training) views.

    `steps` is the length of the schedule. A training that several tests ask for is run once.
    """
    scenes, draw = {}, choose("auto", "cpu", deterministic=True)

    def trained(name: str, recipe: str, seed: int, grow: bool, steps: int):
        capture, last = captures[name], {}

        class Kept(Training):
            def __init__(self, *args):
                super().__init__(*args)
                last["scene"] = self.scene

        cfg = replace(RECIPES[recipe][1], iterations=steps, seed=seed)
        cfg = replace(cfg, growth=replace(cfg.growth, enabled=grow))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("scene_experts.training.start.Training", Kept)
            for _ in train(cfg, Job(RunConfig(cfg, Data(capture.root))), capture, draw):
                pass
        return last["scene"]

    def score(name: str, recipe: str, seed: int = 0, grow: bool = True, views: str = "test", steps: int = 800) -> float:
        key, capture = (name, recipe, seed, grow, steps), captures[name]
        scene = scenes[key] if key in scenes else scenes.setdefault(key, trained(*key))
        scores = []
        with torch.no_grad():
            for i in getattr(capture, views):
                camera, frame = capture.views[i].camera, capture.frame(i)
                decoded = scene(camera, steps, Mode.DRAW, draw.visible)
                image = draw(decoded.gaussians, camera, torch.tensor(capture.background)).image
                scores.append(psnr(image.clamp(0, 1), frame.rgb.float() / 255, frame.mask))
        return statistics.mean(scores)

    return score


@pytest.mark.parametrize(("recipe", "name"), [("scaffold-gs", "brighton"), ("moe-gs", "coloured"), ("3dgs", "coloured")])
@pytest.mark.slow
def test_held_out_psnr_stays_within_three_sigma_of_the_recorded_seeds(name, recipe, held_out):
    key = f"{recipe} on {name}"
    by_seed = lambda: [round(held_out(name, recipe, seed), 4) for seed in range(5)]  # noqa: E731
    seeds = recorded("quality.json", key, by_seed)
    floor = statistics.mean(seeds) - 3 * statistics.stdev(seeds)
    assert held_out(name, recipe) >= floor - 1e-3


@pytest.mark.slow
def test_growth_pays(held_out):
    with_growth, without = (held_out("coloured", "moe-gs", grow=grow, views="train") for grow in (True, False))
    assert with_growth > without + 0.05


@pytest.mark.slow
def test_levels_of_detail_cost_less_than_a_decibel(held_out):
    octree, scaffold = (held_out("brighton", recipe, steps=300) for recipe in ("octree-moe-gs", "scaffold-gs"))
    assert octree > scaffold - 1.0


@pytest.mark.slow
def test_sags_is_near_scaffold_gs(held_out):
    """Both reach 17.4 dB within 300 iterations on brighton at seed 0; after 800, SAGS has 19.9 dB and Scaffold-GS 20.0 dB."""
    sags, scaffold = (held_out("brighton", recipe, steps=300) for recipe in ("sags", "scaffold-gs"))
    assert sags > scaffold - 1.5
