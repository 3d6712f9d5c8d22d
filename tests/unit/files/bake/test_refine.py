"""Refinement: Gaussians that were moved away draw again what they should, and the same from run to run."""

from dataclasses import replace

import torch

from scene_experts.core.types import Mode
from scene_experts.files.bake.refine import CLOSE, FAR, FEW, LEAST, MOST, Refine, compare, iterations_for, refine
from scene_experts.files.bake.views import Views
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of
from scene_experts.files.measure import Painter
from scene_experts.render import choose
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.synthetic import make_capture

NOISY = ("log_scales", "quats", "raw_opacity", "sh_dc")


def test_disturbed_gaussians_draw_the_same_picture_again(tmp_path):
    capture = load(make_capture(tmp_path, views=8, size=(48, 32), points=200).folder)
    cfg = replace(RECIPES["3dgs"][1].scene, opacity=0.6)
    true = cfg.start(capture.points, capture.extent)
    draw, background, views = choose("auto", "cpu", deterministic=True), torch.tensor(capture.background), Views.of(capture)
    generator = torch.Generator().manual_seed(0)
    columns = {name: value.detach() for name, value in true.table.params.items()}
    moved = {name: value + 0.1 * torch.randn(value.shape, generator=generator) for name, value in columns.items() if name in NOISY}
    moved = columns | moved

    def error(scene) -> float:
        camera = capture.views[capture.test[0]].camera
        with torch.no_grad():
            a, b = (draw(s(camera, DRAWN_AT, Mode.DRAW, draw.visible).gaussians, camera, background).image for s in (true, scene))
        return float((a - b).square().mean())

    found = []
    for _ in range(2):
        scene, said = scene_of({name: value.clone() for name, value in moved.items()}, capture.extent), []
        before = error(scene)
        painter = Painter.of(true, DRAWN_AT, draw)
        assert compare(true, painter, views, background) > 90 > 60 > compare(scene, painter, views, background)
        assert refine(scene, painter, views, background, Refine(60), 3, lambda *what, said=said: said.append(what)) == 60
        assert said[-1] == ("refining", 60, 60) and error(scene) < 0.5 * before
        found.append(scene.table.params["sh_rest"].detach())
    assert torch.equal(*found)
    capture.images.close()


def test_the_iterations_follow_from_how_far_the_scene_is():
    assert [iterations_for(psnr, FEW + 1) for psnr in (60.0, CLOSE, FAR, 10.0)] == [LEAST, LEAST, MOST, MOST]
    assert iterations_for(FAR, FEW) == LEAST
    assert iterations_for((CLOSE + FAR) / 2, 40) == (LEAST + MOST) // 2
