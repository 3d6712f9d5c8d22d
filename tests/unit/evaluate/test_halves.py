"""Appearance codes fitted to left halves: the true code is found again, and only right halves are scored."""

import json
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.types import Mode
from scene_experts.evaluate import halves
from scene_experts.evaluate.options import EvalOptions
from scene_experts.evaluate.score import evaluate
from scene_experts.render import choose
from scene_experts.scene.exposure import Exposures
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture

STEP = 10


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    made = load(make_capture(tmp_path_factory.mktemp("halves"), views=9, size=(48, 32)).folder)
    yield made
    made.images.close()


def started(capture, appearance=8):
    torch.manual_seed(0)
    config = replace(RECIPES["scaffold-gs"][1].scene, appearance=appearance)
    scene = config.start(capture.points, capture.extent, [capture.views[i].camera for i in capture.train])
    scene.table.params["feature"].data.normal_()
    return scene


def test_halves_share_no_pixel():
    for width in (6, 7):
        left, right = halves.left_half(4, width), halves.right_half(None, 4, width)
        assert torch.equal(left + right, torch.ones(4, width)) and left[0].sum() == width // 2
    mask = torch.zeros(4, 6)
    mask[:, 2:4] = 1
    assert halves.right_half(mask, 4, 6).sum() == 4


@pytest.mark.parametrize("stops", [None, 1.5])
def test_the_code_is_fitted_to_the_left_half_only(capture, stops):
    scene, draw = started(capture), choose("auto", "cpu", deterministic=True)
    if stops is not None:
        scene.exposures = Exposures([capture.views[i].camera for i in capture.train])
        scene.exposures.stops.data[: len(capture.train) // 2] = stops
    camera, black = capture.views[capture.test[0]].camera, torch.zeros(3)
    code = scene.codes.table[2].detach() * 1.5
    scene.codes.fitted[camera.id] = code
    with torch.no_grad():
        photo = scene.as_photographed(draw(scene(camera, STEP, Mode.DRAW, draw.visible).gaussians, camera, black).image, camera).clamp(0, 1)
    left = halves.left_half(camera.height, camera.width)
    misled = photo.clone()
    misled[:, camera.width // 2 :] = torch.rand_like(misled[:, camera.width // 2 :])  # pixels that do not count have no effect
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    found = halves.fit_code(scene, scene.codes, draw, camera, misled, left, STEP, black)
    errors = {}
    for name, value in (("mean", scene.codes.table.detach().mean(0)), ("found", found)):
        scene.codes.fitted[camera.id] = value
        with torch.no_grad():
            image = draw(scene(camera, STEP, Mode.DRAW, draw.visible).gaussians, camera, black).image
            image = scene.as_photographed(image, camera).clamp(0, 1)
        errors[name] = float((image - photo).abs()[:, camera.width // 2 :].mean())  # on the other half
    assert errors["found"] < 0.35 * errors["mean"], errors
    assert all(torch.equal(before[name], p) and p.grad is None for name, p in scene.named_parameters())


def test_right_halves_are_scored_beside_the_usual_results(capture, tmp_path):
    scene, draw = started(capture), choose("auto", "cpu")
    usual = evaluate(scene, capture, draw, tmp_path, EvalOptions(lpips=False), step=STEP)
    half = evaluate(scene, capture, draw, tmp_path, EvalOptions(appearance="half", lpips=False), step=STEP)
    assert not scene.codes.fitted, "later pictures of the scene know nothing of the held-out photographs"
    assert "appearance" not in usual and half["appearance"] == "half" and half["masked"]
    assert half["psnr"] > usual["psnr"]  # these codes fit the photographs
    assert json.loads((tmp_path / "results.json").read_text())["psnr"] == usual["psnr"]
    assert json.loads((tmp_path / "results_half.json").read_text())["psnr"] == half["psnr"]
    assert any((tmp_path / "test_half" / "masks").iterdir()) and (tmp_path / "per_view_half.json").is_file()

    def stop(what: str, done: int, total: int) -> None:
        raise RunError(what)

    with pytest.raises(RunError, match="fitting"):
        evaluate(scene, capture, draw, tmp_path, EvalOptions(appearance="half", lpips=False), step=STEP, progress=stop)
    assert not scene.codes.fitted
    for wrong, options in ((started(capture, 0), {}), (scene, {"views": "train"})):
        with pytest.raises(InputError, match="--appearance half"):
            evaluate(wrong, capture, draw, tmp_path, EvalOptions(appearance="half", lpips=False, **options), step=STEP)
