"""Trainings that learn the exposure of their photographs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.scene.exposure import GAMMA, Exposures
from scene_experts.training import run_folder
from scene_experts.training.average import Average
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Stepped
from scene_experts.training.init_from import start_from
from scene_experts.training.shards import check_shard
from scene_experts.training.state import Training
from support.captures import load
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture whose photographs are half a stop brighter and darker in turn."""
    made = make_capture(tmp_path_factory.mktemp("capture"), views=10).folder
    for i, path in enumerate(sorted((made / "images").iterdir())):
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(np.float64)
        brighter = pixels * 2 ** ((0.5 if i % 2 else -0.5) / GAMMA)
        Image.fromarray(brighter.round().clip(0, 255).astype(np.uint8)).save(path)
    return made


def test_resumed_equals_uninterrupted_bit_for_bit(folder, tmp_path):
    cfg = config("scaffold-gs", exposure=True)
    list(events(cfg, folder, tmp_path / "whole", stop_at=20))
    list(events(cfg, folder, tmp_path / "parts", stop_at=10))
    list(events(cfg, folder, tmp_path / "parts", stop_at=20, resume=True))
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))
    assert "exposure.stops" in last_tensors(tmp_path / "whole")


@pytest.mark.slow
def test_exposures_are_found_and_the_pictures_fit_better(folder, tmp_path):
    capture = load(folder)
    fit = {}
    for name, learn in (("with", True), ("without", False)):
        cfg = config("scaffold-gs", exposure=learn, iterations=400)
        steps = [e.psnr for e in events(cfg, folder, tmp_path / name) if isinstance(e, Stepped)]
        fit[name] = np.mean(steps[-8:])
    assert fit["with"] > fit["without"] + 1
    found = Exposures.restore(last_tensors(tmp_path / "with"))
    stops = torch.stack([found.stops_of(capture.views[i].camera) for i in capture.train]).mean(1).detach()
    bright = torch.tensor([int(capture.views[i].name.split(".")[0][-1]) % 2 == 1 for i in capture.train])
    assert float(stops[bright].min()) > float(stops[~bright].max())
    assert float(stops[bright].mean() - stops[~bright].mean()) > 0.25  # of 1; the colour network has learned the rest


def test_a_run_is_opened_with_its_exposures(folder, tmp_path):
    from scene_experts.data.settings import Data
    from scene_experts.training.config import RunConfig

    cfg = config("scaffold-gs", exposure=True)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path, stop_at=4))
    opened = run_folder.open_run(tmp_path)
    assert opened.scene.exposures is not None and len(opened.scene.exposures.stops) == len(load(folder).train)
    picture = torch.rand(2, 2, 3)
    camera = load(folder).views[load(folder).train[0]].camera
    assert not torch.equal(opened.scene.as_photographed(picture, camera), picture)


def test_shards_refuse_exposures():
    with pytest.raises(InputError, match="--exposure"):
        check_shard(replace(config("scaffold-gs"), exposure=True), 0.0, viewer=False)


def test_a_training_goes_on_with_the_exposures_of_another(folder, tmp_path):
    cfg = config("scaffold-gs", exposure=True)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path, stop_at=20))
    earlier = last_tensors(tmp_path)["exposure.stops"]
    made = start_from(cfg.scaled(), tmp_path, load(folder), "cpu", RunConfig(cfg, Data(folder)))
    assert earlier.abs().max() > 0 and torch.equal(made.scene.exposures.stops, earlier)


def test_averages_keep_the_exposures_and_the_poses(folder):
    cfg = replace(config("scaffold-gs", exposure=True, refine_poses=True), average=Average(span=0.2))
    training = Training.start(cfg.scaled(), load(folder), "cpu")
    made = training.averaged_scene()
    assert made is not training.scene
    assert made.exposures is training.scene.exposures and made.poses is training.scene.poses
