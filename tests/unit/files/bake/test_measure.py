"""What a file costs: the same pictures score the same, others what they are."""

from dataclasses import replace

import pytest
import torch
from PIL import Image
from scene_experts.files.bake.measure import counted, nothing_counted, picture, scores

from scene_experts.data.capture import load
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.bake.bake import explicit
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from support.synthetic import make_capture


def test_scores_are_means_over_views_of_8_bit_pictures(tmp_path):
    capture = load(make_capture(tmp_path, views=9, size=(48, 32), points=200).folder)
    scene = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent)
    columns = {name: value.detach() for name, value in scene.table.params.items()}
    darker = explicit(columns | {"sh_dc": columns["sh_dc"] - 0.3}, capture.extent)
    draw, said = choose("auto", "cpu"), []
    found = scores({"a": (scene, 0), "b": (darker, 3)}, capture, capture.test, draw, lambda *what: said.append(what))
    assert found["a"].first == 100 and found["b"].first < 60 and said[-1] == ("measuring", 2, 2)
    by_hand = []
    for index in capture.test:
        with torch.no_grad():
            image = picture(darker, 3, capture.views[index].camera, torch.tensor(capture.background), draw)
        assert torch.equal((image * 255).round() / 255, image)
        by_hand.append(psnr(image, capture.frame(index).rgb.float() / 255))
    assert found["b"].photographs == pytest.approx(sum(by_hand) / len(by_hand), abs=1e-6)
    capture.images.close()


def test_views_whose_mask_counts_nothing_are_not_scored(tmp_path):
    folder = make_capture(tmp_path, views=17, size=(24, 16), points=60).folder
    capture = load(folder)
    first, second = (capture.views[i] for i in capture.test[:2])
    capture.images.close()
    assert nothing_counted(replace(capture, test=())) != nothing_counted(capture)
    for view, value in ((first, 0), (second, 255)):
        name = folder / "masks" / f"{view.name}.png"
        name.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (view.camera.width, view.camera.height), value).save(name)
    capture = load(folder)
    assert capture.frame(capture.test[0]).mask is not None and counted(capture) == list(capture.test[1:])
    scene = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent)
    assert scores({"a": (scene, 0)}, capture, counted(capture), choose("auto", "cpu"))["a"].first == 100
    capture.images.close()
