"""The bake: what is kept, what is averaged, and that a scene that needs none comes out as it was."""

from dataclasses import replace

import pytest
import torch

from scene_experts import render
from scene_experts.core.errors import InputError
from scene_experts.files.bake.bake import DRAWN_AT, LEAST_ALPHA, Bake, Refine, bake, choose, closed_form, without_faint
from scene_experts.files.bake.observe import Sums
from scene_experts.files.gaussians.read import scene_of
from scene_experts.files.measure import Painter, scores
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.files import run_in_memory
from support.synthetic import make_capture

STILL = Refine(iterations=0)


def as_run(scene, step):
    return replace(run_in_memory("3dgs", step), scene=scene)


def silent(what: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    found = load(make_capture(tmp_path_factory.mktemp("capture"), views=9, size=(48, 32), points=250).folder)
    yield found
    found.images.close()


def test_what_is_kept_contributes_most():
    weight, opacity = torch.tensor([5.0, 0.0, 1.0, 90.0, 3.0, 1.0]), torch.tensor([0.5, 0.5, 0.5, 0.5, 0.5, 0.5 * LEAST_ALPHA])
    assert choose(weight, opacity, Bake()).tolist() == [0, 2, 3, 4]  # no invisible and no faint Gaussians
    assert choose(weight, opacity, Bake(max_gaussians=2)).tolist() == [0, 3]
    assert choose(weight, opacity, Bake(prune=0.05)).tolist() == [0, 3]
    assert choose(weight, opacity, Bake(prune=0.5)).tolist() == [3]


def test_means_are_sums_over_contributions():
    weight = torch.tensor([[5.0], [90.0]])
    sums = Sums(weight[:, 0], weight[:, 0] / 0.5, weight * torch.ones(3), weight * -2.0, weight * torch.tensor([0.0, 0, 3, 0]), ())
    columns = closed_form(sums, torch.tensor([1, 0]))
    torch.testing.assert_close(columns["means"], torch.ones(2, 3))
    torch.testing.assert_close(columns["log_scales"], torch.full((2, 1), -2.0))
    torch.testing.assert_close(columns["quats"], torch.tensor([[0.0, 0, 1, 0]]).repeat(2, 1))
    torch.testing.assert_close(sums.opacity(), torch.full((2,), 0.5))


def test_explicit_gaussians_keep_everything_but_cut_harmonics(capture):
    scene = replace(RECIPES["3dgs"][1].scene, opacity=0.7).start(capture.points, capture.extent)
    draw = render.choose("auto", "cpu")
    for degree in (0, 3):
        baked = bake(as_run(scene, 0), capture, Bake(sh_degree=degree, refine=STILL), draw, silent)
        assert baked.scene is baked.closed_form and baked.scene.config.sh_degree == degree
        assert len(baked.scene.table) == baked.about["contributing"] > 150
        painters = {"run": Painter.of(scene, 0, draw), "bake": Painter.of(baked.scene, DRAWN_AT, draw)}
        found = scores(painters, capture, capture.test)
        assert found["bake"].first > 40


def test_a_trained_anchor_scene_comes_near_and_refinement_nearer(capture):
    cfg = RECIPES["moe-gs"][1]
    torch.manual_seed(0)
    scene = cfg.scene.start(capture.points, capture.extent)
    with torch.no_grad():  # as if it had learned something that depends on the view
        for name, size in (("feature", 2.0), ("offsets", 2.0)):
            scene.table.params[name].normal_().mul_(size)
        for weight in scene.heads.parameters():  # pyright: ignore
            weight.mul_(3)
    draw = render.choose("auto", "cpu")
    baked = bake(as_run(scene, 1000), capture, Bake(sh_degree=1, refine=Refine(iterations=60)), draw, silent)
    steps = {"run": (scene, 1000), "first": (baked.closed_form, DRAWN_AT), "last": (baked.scene, DRAWN_AT)}
    found = scores({name: Painter.of(*scene, draw) for name, scene in steps.items()}, capture, capture.test)
    assert found["first"].first > 20 and found["last"].first > found["first"].first + 0.5
    assert baked.about["contributing"] <= len(scene.table) * scene.K and baked.scene.extent == scene.extent
    less = bake(as_run(scene, 1000), capture, Bake(sh_degree=0, max_gaussians=100, refine=STILL), draw, silent)
    assert len(less.scene.table) == 100 and less.scene.table.params["sh_rest"].shape == (100, 0, 3)


def test_what_is_too_faint_goes():
    columns = {"means": torch.zeros(3, 3), "log_scales": torch.zeros(3, 3), "quats": torch.ones(3, 4), "sh_dc": torch.zeros(3, 3)}
    scene = scene_of(columns | {"raw_opacity": torch.tensor([0.0, -9.0, 3.0]), "sh_rest": torch.zeros(3, 8, 3)}, 2.0)
    out = without_faint(scene)
    assert out.table.params["raw_opacity"].tolist() == [0.0, 3.0] and out.config.sh_degree == 2 and out.extent == 2.0


def test_a_scene_that_shows_nothing_is_refused(capture):
    scene = RECIPES["3dgs"][1].scene.start(capture.points, capture.extent)
    with torch.no_grad():
        scene.table.params["raw_opacity"].fill_(-20)
    with pytest.raises(InputError):
        bake(as_run(scene, 0), capture, Bake(refine=STILL), None, silent)
