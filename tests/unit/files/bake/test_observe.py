"""Contributions, means over views and least squares of a bake, against what they are by definition."""

import math
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from scene_experts.core.types import Camera, Decoded, Gaussians, Mode
from scene_experts.files.bake import observe
from scene_experts.files.bake.observe import contributions, fit_harmonics, omission, solve, sum_views
from scene_experts.files.gaussians.read import scene_of
from scene_experts.files.measure import Painter
from scene_experts.geometry.poses import look_at
from scene_experts.geometry.sh import basis
from scene_experts.render import choose

STEP = 3


def cameras(count: int) -> list[Camera]:
    K = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    out = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        place = torch.tensor([4 * math.cos(angle), 4 * math.sin(angle), 2 * math.sin(3 * angle)], dtype=torch.float64)
        out.append(Camera(look_at(place, torch.zeros(3, dtype=torch.float64), torch.tensor([0, 0, 1.0]).double()).float(), K, 48, 32))
    return out


def columns(n: int, degree: int = 2) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(4)
    return {
        "means": torch.randn(n, 3, generator=g) * 0.8,
        "log_scales": torch.randn(n, 3, generator=g) * 0.3 - 2,
        "quats": functional.normalize(torch.randn(n, 4, generator=g), dim=1),
        "raw_opacity": torch.randn(n, generator=g),
        "sh_dc": torch.rand(n, 3, generator=g),
        "sh_rest": torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g) * 0.05,
    }


def silent(what: str, done: int, total: int) -> None:
    assert 0 < done <= total


def test_contributions_are_blending_weights():
    draw, (camera,) = choose("auto", "cpu"), cameras(1)
    one = Gaussians(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.2),
        torch.tensor([0.7]),
        torch.ones(1, 3),
        torch.zeros(1).long(),
    )
    assert float(contributions(one, camera, draw)) == pytest.approx(float(draw(one, camera, torch.zeros(3)).alpha.sum()), rel=1e-5)
    scene = scene_of(columns(60), 5.0)
    with torch.no_grad():
        many = scene(camera, STEP, Mode.DRAW, draw.visible).gaussians
        total = float(draw(many, camera, torch.zeros(3)).alpha.sum())
    assert float(contributions(many, camera, draw).sum()) == pytest.approx(total, rel=1e-4)


def test_means_over_views_of_what_does_not_change_are_what_it_is():
    draw, made = choose("auto", "cpu"), columns(60)
    sums = sum_views(Painter.of(scene_of(made, 5.0), STEP, draw), 60, cameras(6), silent)
    seen = sums.weight > 1
    assert seen.sum() > 40 and sums.quats.shape == (60, 4)
    weight = sums.weight[seen, None]
    torch.testing.assert_close(sums.means[seen] / weight, made["means"][seen], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(sums.log_scales[seen] / weight, made["log_scales"][seen], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        (functional.normalize(sums.quats[seen], dim=1) * made["quats"][seen]).sum(1).abs(), torch.ones(int(seen.sum()))
    )
    torch.testing.assert_close(sums.opacity()[seen], made["raw_opacity"][seen].sigmoid(), rtol=1e-4, atol=1e-5)


def test_what_is_left_out_counts_by_its_area():
    draw, made = choose("auto", "cpu"), columns(2) | {"means": torch.zeros(2, 3)}
    scene, (near, far) = scene_of(made, 5.0), (cameras(1)[0], cameras(1)[0])
    pose = far.world_to_cam.clone()
    pose[2, 3] *= 2
    far = replace(far, world_to_cam=pose)

    def shy(camera, step, training, cull):
        """Leaves the first Gaussian out when seen from far away."""
        g = scene(camera, step, training, cull).gaussians
        rows = torch.arange(int(camera is far), len(g))
        names = ("means", "quats", "scales", "opacities", "colors", "source")
        return Decoded(Gaussians(*(getattr(g, name)[rows] for name in names)), rows, None, {})

    sizes = made["log_scales"].amax(1).exp()
    ratio = float((far.position.norm() / near.position.norm()) ** -2)
    for looks, expected in (([near, far], [ratio, 0.0]), ([near, near, far], [ratio / 2, 0.0])):
        found = omission(Painter(shy, STEP, draw), torch.arange(2), 2, made["means"], sizes, looks, silent)
        torch.testing.assert_close(found, torch.tensor(expected), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_least_squares_find_the_harmonics_that_made_the_colours(degree, monkeypatch):
    monkeypatch.setattr(observe, "RIDGE", 1e-9)
    g = torch.Generator().manual_seed(2)
    means, centres = torch.randn(5, 3, generator=g, dtype=torch.float64), 6 * torch.randn(40, 3, generator=g, dtype=torch.float64)
    beta = torch.randn(5, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64)
    Y = basis(functional.normalize(means[:, None] - centres, dim=2), degree)
    weight = torch.rand(5, 40, generator=g, dtype=torch.float64) * 100
    torch.testing.assert_close(solve(means, centres, weight, Y @ beta, degree), beta, rtol=1e-5, atol=1e-6)
    assert torch.equal(solve(means, centres, torch.zeros(5, 40).double(), Y @ beta, degree), torch.zeros_like(beta))
    few = solve(means, centres[:1], weight[:, :1], (Y @ beta)[:, :1], degree)  # one view: its colour, by the constant nearly alone
    assert bool(few.isfinite().all()) and float((Y[:, :1] @ few - (Y @ beta)[:, :1]).abs().max()) < 1e-3


def test_harmonics_of_a_scene_that_has_some_come_back(monkeypatch):
    monkeypatch.setattr(observe, "RIDGE", 1e-7)
    monkeypatch.setattr(observe, "_ROOM", 20 * 16 * 40)  # twenty Gaussians at a time
    monkeypatch.setattr(observe, "_SOLVE", 7)
    draw, made, looks = choose("auto", "cpu"), columns(60, 1), cameras(40)
    painter = Painter.of(scene_of(made, 5.0), STEP, draw)
    sums = sum_views(painter, 60, looks, silent)
    rows = (sums.weight > 20).nonzero().squeeze(1)
    found = fit_harmonics(painter, rows, sums, made["means"][rows], 1, looks, silent)
    torch.testing.assert_close(found, torch.cat([made["sh_dc"][:, None], made["sh_rest"]], 1)[rows], rtol=1e-2, atol=1e-3)
