"""Explicit Gaussians: initialisation, and visibility, which misses no Gaussian that would be drawn."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Mode, Points
from scene_experts.geometry.sh import sh_to_rgb
from scene_experts.render import choose
from scene_experts.scene.gaussians import COLUMNS, Explicit, ExplicitRates, GaussianScene

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32, 0.2)
PLAIN = Explicit()


def everything(means, scales, camera):
    return torch.ones(len(means), dtype=torch.bool)


def make(n=300, seed=0, config=PLAIN, dtype=torch.float32) -> GaussianScene:
    torch.manual_seed(seed)
    params = {
        "means": torch.randn(n, 3, dtype=dtype) * 2 + torch.tensor([0.0, 0.0, 3.0], dtype=dtype),
        "log_scales": torch.randn(n, 3, dtype=dtype) - 2.5,
        "quats": torch.randn(n, 4, dtype=dtype),
        "raw_opacity": torch.randn(n, dtype=dtype),
        "sh_dc": torch.randn(n, 3, dtype=dtype),
        "sh_rest": torch.randn(n, (config.sh_degree + 1) ** 2 - 1, 3, dtype=dtype) * 0.2,
    }
    return GaussianScene(config, Table(params, {}), 5.0)


def test_it_starts_as_3dgs_does():
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]], dtype=torch.float64)
    rgb = torch.tensor([[255, 0, 128]] * 5, dtype=torch.uint8)
    scene = Explicit().start(Points(xyz, rgb), 5.0)
    p = scene.table.params
    assert set(p) == set(COLUMNS) and len(scene.table) == 5 and scene.K == 1
    torch.testing.assert_close(p["log_scales"][0].detach(), torch.full((3,), math.log(math.sqrt((1 + 4 + 9) / 3))))
    assert torch.equal(p["quats"].detach(), torch.tensor([[1.0, 0, 0, 0]] * 5))
    torch.testing.assert_close(p["raw_opacity"].detach(), torch.full((5,), -2.1972246))  # logit(0.1)
    torch.testing.assert_close(p["sh_dc"][0].detach(), (torch.tensor([1.0, 0, 128 / 255]) - 0.5) / 0.28209479177387814)
    assert p["sh_rest"].shape == (5, 15, 3) and not p["sh_rest"].any()
    half = Explicit(opacity=0.5, size=0.1).start(Points(xyz, rgb), 5.0).table.params
    torch.testing.assert_close(half["log_scales"].detach(), p["log_scales"].detach() + math.log(0.1))
    assert not half["raw_opacity"].any()
    with pytest.raises(InputError, match="--init random"):
        Explicit().start(Points(xyz[:0], rgb[:0]), 5.0)


def test_coinciding_points_have_a_size():
    scene = Explicit().start(Points(torch.zeros(4, 3, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.uint8)), 5.0)
    torch.testing.assert_close(scene.table.params["log_scales"].detach(), torch.full((4, 3), math.log(math.sqrt(1e-7))))


def test_the_degree_grows_every_thousand_iterations():
    scene = make(2)
    assert [scene.degree(step) for step in (1, 999, 1000, 1999, 2000, 3000, 30_000)] == [0, 0, 1, 1, 2, 3, 3]
    assert make(2, config=Explicit(sh_degree=1)).degree(30_000) == 1
    assert Explicit().scaled(0.1).sh_ramp == 100 and Explicit(sh_ramp=1).scaled(0.1).sh_ramp == 1


def test_decoded_gaussians_are_the_activated_columns():
    scene, rows = make(), torch.tensor([7, 3, 250])
    decoded, p = scene.decode(rows, CAMERA, 2500), scene.table.params
    g = decoded.gaussians
    assert torch.equal(g.source, rows) and decoded.raw_opacity is None and decoded.routing == {}
    torch.testing.assert_close(g.quats.norm(dim=1), torch.ones(3))
    torch.testing.assert_close(g.scales, p["log_scales"][rows].exp())
    torch.testing.assert_close(g.opacities, p["raw_opacity"][rows].sigmoid())
    sh = torch.cat([p["sh_dc"][rows][:, None], p["sh_rest"][rows]], 1)
    torch.testing.assert_close(g.colors, sh_to_rgb(sh, p["means"][rows] - CAMERA.position, 2), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_left_out_would_not_have_been_drawn(seed):
    scene, draw = make(2000, seed), choose("auto", "cpu")
    with torch.no_grad():
        some, every = scene(CAMERA, 3000, Mode.DRAW, draw.visible), scene(CAMERA, 3000, Mode.DRAW, everything)
        a, b = (draw(d.gaussians, CAMERA, torch.zeros(3)) for d in (some, every))
    assert len(some.rows) < len(every.rows)
    assert set(every.rows[b.radii > 0].tolist()) <= set(some.rows.tolist())
    assert torch.equal(a.image, b.image)


def test_gradients_are_finite_differences():
    scene = make(4, dtype=torch.float64)
    rows, columns = torch.tensor([2, 0, 3]), dict(scene.table.params)

    def decode(*values):
        scene.table.params.update({name: torch.nn.Parameter(v) for name, v in zip(columns, values)})
        for name, value in zip(columns, values):  # the leaves themselves, not copies
            scene.table.params._parameters[name] = value  # type: ignore[assignment]
        g = scene.decode(rows, CAMERA, 3000).gaussians
        return g.means, g.quats, g.scales, g.opacities, g.colors + 0 * g.means

    with torch.no_grad():
        columns["sh_dc"] += 5.0  # no colour is cut
    assert torch.autograd.gradcheck(decode, [v.detach().requires_grad_() for v in columns.values()])


def test_columns_of_another_scene_are_refused():
    scene = make(3)
    params = {name: value.detach() for name, value in scene.table.params.items()}
    assert Explicit().load(Table(params, {}), scene.meta()).extent == 5.0
    with pytest.raises(InputError):
        Explicit(sh_degree=2).load(Table(params, {}), scene.meta())
    with pytest.raises(InputError):
        Explicit().load(Table({"means": params["means"]}, {}), scene.meta())


def test_rates_are_3dgs_s():
    rates = ExplicitRates()
    assert rates.at("means", 30_000, 30_000, 5.0) == pytest.approx(5 * 1.6e-6)
    assert rates.at("means", 15_000, 30_000, 1.0) == pytest.approx(1.6e-5)
    assert rates.at("sh_rest", 1, 30_000, 5.0) == pytest.approx(rates.at("sh_dc", 1, 30_000, 5.0) / 20) == pytest.approx(1.25e-4)


def test_file_sizes_and_impossible_settings():
    assert make(1).file_values == 62 and make(1, config=Explicit(sh_degree=0)).file_values == 17
    for config, flag in ((Explicit(sh_degree=4), "sh-degree"), (Explicit(opacity=1.0), "opacity"), (replace(Explicit(), size=0.0), "size")):
        with pytest.raises(InputError, match=flag):
            check_fields(config, "scene")
