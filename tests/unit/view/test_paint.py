"""Each kind of picture against its definition."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode, Render
from scene_experts.render import choose
from scene_experts.scene import Traits
from scene_experts.view.paint import PALETTE, Look, available_shows, color_ramp, color_rows, paint, to_picture
from scene_experts.view.show import SHOWS
from support.messages import naming
from support.scenes import CAMERA, start_scene

BLACK = torch.zeros(3)
DRAW = choose("auto", "cpu")


def decoded(recipe="moe-gs", step=2000):
    with torch.no_grad():
        return start_scene(recipe)(CAMERA, step, Mode.DRAW, DRAW.visible)


def test_the_plain_picture_is_the_render():
    scene = start_scene("moe-gs")
    with torch.no_grad():
        image = DRAW(scene(CAMERA, 2000, Mode.DRAW, DRAW.visible).gaussians, CAMERA, BLACK).image
    assert torch.equal(paint(scene, CAMERA, 2000, DRAW, BLACK), image.clamp(0, 1))


@pytest.mark.parametrize("show", SHOWS)
def test_a_frozen_scene_gives_the_same_picture(show):
    scene = start_scene("moe-gs")
    draws = scene.frozen(2000)
    assert torch.equal(
        paint(scene, CAMERA, 2000, DRAW, BLACK, Look(show=show), draws), paint(scene, CAMERA, 2000, DRAW, BLACK, Look(show=show))
    )


@pytest.mark.parametrize("show", SHOWS)
def test_every_mode_gives_a_picture(show):
    picture = paint(start_scene("moe-gs"), CAMERA, 2000, DRAW, BLACK, Look(show=show))
    assert picture.shape == (32, 48, 3) and picture.min() >= 0 and picture.max() <= 1 and torch.isfinite(picture).all()


def test_expert_colours_are_the_weighted_palette():
    made = decoded()
    colours, routing = color_rows(made, Look(show="experts", attribute="cov")), made.routing["cov"]
    assert routing.chosen is not None
    a, b = routing.chosen[0].tolist()
    w = torch.softmax(routing.gates[0, [a, b]].log(), 0)
    palette = torch.tensor(PALETTE)
    assert torch.allclose(colours[0], w[0] * palette[a] + w[1] * palette[b], atol=1e-5)


def test_entropy_of_even_gates_is_light_and_activation_counts_slots():
    made = decoded()
    assert torch.allclose(
        color_rows(made, Look(show="entropy"))[0], color_ramp(torch.tensor(1.0)), atol=0.02
    )  # a fresh router is nearly even
    share = (made.raw_opacity[3] > 0).float().mean()
    assert torch.allclose(color_rows(made, Look(show="activation"))[3], color_ramp(share))


def test_one_expert_alone_draws_less_and_all_together_the_whole():
    scene = start_scene("moe-gs")
    whole = paint(scene, CAMERA, 2000, DRAW, BLACK)
    assert torch.equal(paint(scene, CAMERA, 2000, DRAW, BLACK, Look(only=(0, 1, 2, 3, 4))), whole)
    assert paint(scene, CAMERA, 2000, DRAW, BLACK, Look(show="alpha", only=())).max() == 0


def test_a_scene_without_experts_has_no_expert_picture():
    with pytest.raises(InputError, match="color"):
        paint(start_scene("scaffold-gs"), CAMERA, 1, DRAW, BLACK, Look(show="experts"))
    assert paint(start_scene("scaffold-gs"), CAMERA, 1, DRAW, BLACK, Look(show="activation")).shape == (32, 48, 3)


@pytest.mark.parametrize("look", [Look(show="experts"), Look(show="entropy"), Look(only=(0,))])
def test_a_scene_before_its_split_says_from_when_on_it_has_experts(look):
    with pytest.raises(InputError, match=naming("10001", "500", "--only")):
        paint(start_scene("scene-experts"), CAMERA, 500, DRAW, BLACK, look)


def test_what_can_be_shown_follows_the_traits_of_a_scene():
    plain = ("picture", "depth", "alpha")
    assert available_shows(Traits("x", "points")) == plain
    assert available_shows(Traits("x", "points", activation=True)) == (*plain, "activation")
    assert available_shows(start_scene("moe-gs").traits) == SHOWS


def test_depth_is_shown_where_half_of_the_light_is_stopped():
    """Near is light: equal steps of disparity between the nearest and the farthest pixel seen. Fainter pixels are black."""
    alpha = torch.tensor([[0.51, 0.8, 1.0, 0.49, 0.2, 0.0]])
    depth = torch.tensor([[2.0, 3.0, 6.0, 1.0, 50.0, 0.0]])

    def picture_of(alpha):
        return to_picture(Render(torch.ones(1, 6, 3), alpha, depth * alpha, torch.zeros(0), torch.zeros(0, 2)), "depth")[0]

    picture = picture_of(alpha)
    near, far = torch.quantile(torch.tensor([2.0, 3.0, 6.0]), torch.tensor([0.02, 0.98])).tolist()
    torch.testing.assert_close(picture[:3], color_ramp(torch.tensor([1.0, (1 / 3 - 1 / far) / (1 / near - 1 / far), 0.0])))
    assert not picture[3:].any()
    assert not picture_of(0.5 * alpha).any()


def test_the_ramp_runs_dark_to_light():
    light = color_ramp(torch.linspace(0, 1, 5)).sum(1)
    assert (light.diff() > 0).all()
