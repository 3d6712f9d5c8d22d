"""The colour behind the scene: by hand, in the command, the API and a run that is resumed."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import scene_experts as se
from scene_experts.cli import main
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from scene_experts.training.background import MOST, mean_colour, with_background
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture

SMALL = ("--iterations", "20", "--device", "cpu", "--preview-every", "0")


@pytest.fixture
def folder(tmp_path):
    return make_capture(tmp_path / "capture", views=5, size=(24, 16), points=60, mixed_sizes=False).folder


def setting(folder, mean=True, **data) -> RunConfig:
    return RunConfig(replace(RECIPES["scaffold-gs"][1], mean_background=mean), Data(folder, **data))


def expected(capture):
    """The mean colour by hand."""
    photographs = [capture.frame(i).rgb.numpy().astype(np.float64) for i in capture.train]
    return np.mean([one.mean((0, 1)) / 255 for one in photographs], 0)


def test_the_mean_is_that_of_the_training_photographs(folder):
    capture = load(folder, split="mod:2")
    assert len(capture.test) > 0
    config, found = with_background(setting(folder), capture)
    assert found.background == config.data.background == mean_colour(capture)
    np.testing.assert_allclose(found.background, expected(capture), atol=5e-4 + 1e-9)
    assert all(round(value, 3) == value for value in found.background)


def test_of_many_photographs_an_even_choice_counts(folder):
    capture = load(folder, split="none")
    seen: list[int] = []
    store = replace(capture, train=tuple(i % 5 for i in range(3 * MOST)))
    object.__setattr__(store, "frame", lambda index: seen.append(index) or capture.frame(index))
    mean_colour(store)
    assert seen == [(3 * k) % 5 for k in range(MOST)]


def test_a_named_colour_and_a_recipe_without_it_are_kept(folder):
    capture = load(folder)
    same = setting(folder, mean=False)
    assert with_background(same, capture) == (same, capture)
    named = setting(folder, background=(0.0, 1.0, 0.0))
    config, found = with_background(named, load(folder, background=(0.0, 1.0, 0.0)))
    assert config == named and found.background == (0.0, 1.0, 0.0)


def test_masked_photographs_keep_the_capture_s_background(folder):
    (folder / "masks").mkdir()
    for path in (folder / "images").iterdir():
        size = Image.open(path).size
        Image.fromarray(np.tile(np.uint8([0, 255]), (size[1], size[0] // 2))).save(folder / "masks" / path.name)
    capture = load(folder)
    assert capture.frame(0).mask is not None
    assert mean_colour(capture) is None
    assert with_background(setting(folder), capture)[1].background == (0.0, 0.0, 0.0)


def test_a_run_stores_the_colour_says_it_and_resumes_with_it(folder, tmp_path, capsys):
    out, args = tmp_path / "run", ["train", "scaffold-gs", "--data", str(folder), "--mean-background", *SMALL]
    assert main([*args, "--out", str(out), "--stop-at", "10"]) == 0
    colour = mean_colour(load(folder))
    assert " ".join(f"{value:g}" for value in colour) in capsys.readouterr().out
    assert run_folder.read_config(out).data.background == colour
    assert main([*args, "--out", str(out), "--resume"]) == 0
    run = se.open_run(out)
    assert run.step == 20 and run.capture.background == colour
    recipe = se.recipe("scaffold-gs", mean_background=True, iterations=20)
    ours = se.Trainer(recipe, str(folder), tmp_path / "api", device="cpu", stop_at=10, deterministic=True)
    assert ours.finish().capture.background == colour
    again = se.Trainer(recipe, str(folder), tmp_path / "api", device="cpu", resume=True, deterministic=True)
    assert again.capture.background == colour and again.finish().step == 20
