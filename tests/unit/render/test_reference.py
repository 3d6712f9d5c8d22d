from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from scene_experts.core.types import Camera, Gaussians
from scene_experts.render.reference import ReferenceRasterizer, project
from support.gaussians import F64, make_camera, make_scene

BLACK = torch.zeros(3, dtype=F64)


def plain_camera(width: int = 33, height: int = 21, f: float = 40.0, cx: float = 16.5, cy: float = 10.5) -> Camera:
    """Return a camera at the origin that looks along z."""
    return Camera(torch.eye(4, dtype=F64), torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]], dtype=F64), width, height)


def one(
    z: float = 2.0, x: float = 0.0, y: float = 0.0, size: float = 0.1, opacity: float = 0.5, color: tuple[float, ...] = (1.0, 0.5, 0.25)
) -> Gaussians:
    return Gaussians(
        torch.tensor([[x, y, z]], dtype=F64),
        torch.tensor([[1.0, 0, 0, 0]], dtype=F64),
        torch.full((1, 3), size, dtype=F64),
        torch.tensor([opacity], dtype=F64),
        torch.tensor([color], dtype=F64),
        torch.zeros(1, dtype=torch.int64),
    )


def join(*parts: Gaussians) -> Gaussians:
    fields = ("means", "quats", "scales", "opacities", "colors", "source")
    return Gaussians(**{name: torch.cat([getattr(p, name) for p in parts]) for name in fields})


def matrix_of(q: list[float]) -> Tensor:
    """Return the rotation of a quaternion from its action on the axes: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[0], torch.tensor(q[1:], dtype=F64)
    eye = torch.eye(3, dtype=F64)
    turned = [e + 2 * w * torch.linalg.cross(u, e) + 2 * torch.linalg.cross(u, torch.linalg.cross(u, e)) for e in eye]
    return torch.stack(turned, dim=1)


def slow(g: Gaussians, camera: Camera, background: Tensor, antialias: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Return image, alpha and depth of the published per-pixel algorithm, with a loop over pixels and one over Gaussians."""
    fx, fy, cx, cy, W, H = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    R, t = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    splats = []
    for i in range(len(g)):
        x, y, z = (R @ g.means[i] + t).tolist()
        if z <= camera.near:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        tx = z * min(max(x / z, -cx / fx - 0.15 * W / fx), (W - cx) / fx + 0.15 * W / fx)
        ty = z * min(max(y / z, -cy / fy - 0.15 * H / fy), (H - cy) / fy + 0.15 * H / fy)
        J = torch.tensor([[fx / z, 0, -fx * tx / z**2], [0, fy / z, -fy * ty / z**2]], dtype=F64)
        M = J @ R @ matrix_of(g.quats[i].tolist()) @ torch.diag(g.scales[i])
        sharp = M @ M.T
        cov = sharp + 0.3 * torch.eye(2, dtype=F64)
        values = torch.linalg.eigvalsh(cov).tolist()
        mid = sum(values) / 2
        radius = math.ceil(3 * math.sqrt(mid + math.sqrt(max(0.1, mid**2 - values[0] * values[1]))))
        if u + radius <= 0 or v + radius <= 0 or u - radius >= 16 * math.ceil(W / 16) or v - radius >= 16 * math.ceil(H / 16):
            continue
        opacity = g.opacities[i].item()
        if antialias:
            opacity *= math.sqrt(max(0.005**2, (torch.linalg.det(sharp) / torch.linalg.det(cov)).item()))
        inverse = torch.linalg.inv(cov).tolist()
        splats.append((z, i, u, v, inverse[0][0], inverse[0][1], inverse[1][1], opacity, g.colors[i]))
    splats.sort(key=lambda s: s[:2])
    image, alphas, depth = torch.zeros(H, W, 3, dtype=F64), torch.zeros(H, W, dtype=F64), torch.zeros(H, W, dtype=F64)
    for row in range(H):
        for column in range(W):
            T, color, far = 1.0, torch.zeros(3, dtype=F64), 0.0
            for z, _, u, v, a, b, c, opacity, rgb in splats:
                dx, dy = u - (column + 0.5), v - (row + 0.5)
                power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
                alpha = min(0.99, opacity * math.exp(min(power, 0.0)))
                if power > 0 or alpha < 1 / 255:
                    continue
                if T * (1 - alpha) < 1e-4:
                    break
                color, far, T = color + T * alpha * rgb, far + T * alpha * z, T * (1 - alpha)
            image[row, column], alphas[row, column], depth[row, column] = color + T * background, 1 - T, far
    return image, alphas, depth


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("center", [(None, None), (9.3, 14.8)], ids=["centred", "off-centre"])
def test_same_as_the_slow_loop(antialias: bool, center: tuple[float | None, float | None]) -> None:
    opaque = replace(make_scene(4, seed=1, size=0.2, spread=0.1), opacities=torch.ones(4, dtype=F64))
    g, camera = join(make_scene(60, size=0.1), opaque), make_camera(27, 21, *center)
    background = torch.tensor([0.2, 0.7, 0.1], dtype=F64)
    image, alpha, depth = slow(g, camera, background, antialias)
    render = ReferenceRasterizer(antialias=antialias)(g, camera, background)
    assert alpha.max() > 0.999 and alpha.min() < 0.3  # the scene has both
    torch.testing.assert_close(render.image, image)
    torch.testing.assert_close(render.alpha, alpha)
    torch.testing.assert_close(render.depth, depth)


def test_opaque_stack_stops_before_the_last_transmittance() -> None:
    stack = join(*[one(z=2 + 0.1 * i, size=1.0, opacity=0.97, color=(float(i == 2), 0.0, 1.0)) for i in range(4)])
    camera = plain_camera(5, 5, cx=2.5, cy=2.5)
    render = ReferenceRasterizer()(stack, camera, BLACK)
    # 0.03^2 = 9e-4 stays, 0.03^3 = 2.7e-5 would fall below 1e-4: the third is not blended.
    assert render.alpha[2, 2].item() == pytest.approx(1 - 0.03**2, rel=1e-9)
    assert render.image[2, 2, 0] == 0
    torch.testing.assert_close(render.image, slow(stack, camera, BLACK)[0])


def test_one_splat_is_the_gaussian_at_pixel_centres() -> None:
    # Centre of the middle pixel: x = 0 projects to cx = 16.5, the centre of column 16.
    render = ReferenceRasterizer()(one(), plain_camera(), BLACK)
    variance = (40 * 0.1 / 2) ** 2 + 0.3
    for column in (16, 17, 20):
        expected = 0.5 * math.exp(-((column - 16) ** 2) / (2 * variance))
        assert render.alpha[10, column].item() == pytest.approx(expected, rel=1e-12)
        assert render.depth[10, column].item() == pytest.approx(2 * expected, rel=1e-12)
        torch.testing.assert_close(render.image[10, column], expected * torch.tensor([1, 0.5, 0.25], dtype=F64))
    torch.testing.assert_close(render.alpha, render.alpha.flip(1))
    torch.testing.assert_close(render.alpha, render.alpha.flip(0))
    assert render.radii.item() == math.ceil(3 * math.sqrt(variance + math.sqrt(0.1))) and render.radii.dtype == torch.int32


def test_near_hides_far_and_ties_go_by_index() -> None:
    red, blue = one(z=2.0, opacity=0.9, color=(1, 0, 0)), one(z=2.1, opacity=0.9, color=(0, 0, 1))
    pixel = ReferenceRasterizer()(join(blue, red), plain_camera(), BLACK).image[10, 16]
    torch.testing.assert_close(pixel, torch.tensor([0.9, 0, 0.09], dtype=F64))
    tied = replace(join(blue, red), means=red.means.expand(2, 3))
    pixel = ReferenceRasterizer()(tied, plain_camera(), BLACK).image[10, 16]
    torch.testing.assert_close(pixel, torch.tensor([0.09, 0, 0.9], dtype=F64))


def test_background_shows_through_what_is_left() -> None:
    background = torch.tensor([0.2, 0.4, 0.8], dtype=F64)
    empty, full = (ReferenceRasterizer()(one(), plain_camera(), b) for b in (BLACK, background))
    torch.testing.assert_close(full.image, empty.image + (1 - empty.alpha)[..., None] * background)


@pytest.mark.parametrize("tile", [5, 16, 64])
def test_tiles_do_not_change_the_picture_or_its_gradients(tile: int) -> None:
    g, camera = make_scene(120), make_camera(45, 37, 14.2, 25.1)
    results = []
    for rasterizer in (ReferenceRasterizer(tile=tile), ReferenceRasterizer(tile=None)):
        leaves = {n: getattr(g, n).clone().requires_grad_() for n in ("means", "quats", "scales", "opacities", "colors")}
        render = rasterizer(replace(g, **leaves), camera, BLACK)
        (render.image.square().sum() + render.depth.sin().sum()).backward()
        results.append([render.image, render.alpha, render.depth, render.mean2d_grad, *(x.grad for x in leaves.values())])
    for ours, dense in zip(*results, strict=True):
        torch.testing.assert_close(ours, dense, rtol=1e-9, atol=1e-11)


def test_recomputing_tiles_in_backward_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    g, camera, grads = make_scene(50), make_camera(), []
    for limit in (1 << 24, 0):
        monkeypatch.setattr("scene_experts.render.reference._CHECKPOINT", limit)
        means = g.means.clone().requires_grad_()
        render = ReferenceRasterizer()(replace(g, means=means), camera, BLACK)
        render.image.square().sum().backward()
        grads.append((means.grad, render.mean2d_grad))
    assert grads[0][1].abs().sum() > 0
    torch.testing.assert_close(grads[0], grads[1])


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("center", [(None, None), (5.1, 13.4)], ids=["centred", "off-centre"])
def test_gradients_are_those_of_finite_differences(antialias: bool, center: tuple[float | None, float | None]) -> None:
    # Steps of 1e-6 cross no threshold of alpha or transmittance at this seed.
    g, camera = make_scene(9, seed=3, size=0.2, spread=0.5), make_camera(17, 13, *center, f=16.0)
    wide = make_scene(2, seed=5, size=0.9)
    wide = replace(wide, means=torch.tensor([[2.6, 0.2, -0.5], [-3.4, -1.7, 0.1]], dtype=F64))  # outside the limits of the Jacobian
    flat = replace(make_scene(2, seed=6, size=1.5, spread=0.1), opacities=torch.ones(2, dtype=F64))  # alpha above 0.99
    g = join(g, wide, flat)
    inputs = [x.clone().requires_grad_() for x in (g.means, g.quats, g.scales, g.opacities, g.colors, torch.rand(3, dtype=F64))]

    # Gradients of random sums of the outputs: as strict as output by output, with a hundredth of the backward passes.
    gen = torch.Generator().manual_seed(1)
    mixes = [torch.randn(6, 17 * 13 * channels, generator=gen, dtype=F64) for channels in (3, 1, 1)]

    def draw(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, background: Tensor) -> tuple[Tensor, ...]:
        r = ReferenceRasterizer(antialias=antialias)(Gaussians(means, quats, scales, opacities, colors, g.source), camera, background)
        return tuple(mix @ x.flatten() for mix, x in zip(mixes, (r.image, r.alpha, r.depth)))

    assert (project(g.means, g.quats, g.scales, camera).radii > 0).all()
    view = g.means @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]
    assert ((view[9:11, 0] / view[9:11, 2]).abs() > 1.3 * 17 / 32).all()
    assert _sum_of_opacity_gradients(g, camera, True) != _sum_of_opacity_gradients(g, camera, False)  # the clamp is reached
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def _sum_of_opacity_gradients(g: Gaussians, camera: Camera, clamp_gradient: bool) -> float:
    opacities = g.opacities.clone().requires_grad_()
    ReferenceRasterizer(clamp_gradient=clamp_gradient)(replace(g, opacities=opacities), camera, BLACK).image.sum().backward()
    assert opacities.grad is not None
    return opacities.grad.sum().item()


def test_the_clamp_stops_the_gradient_unless_told() -> None:
    opaque = replace(one(size=0.5), opacities=torch.ones(1, dtype=F64).requires_grad_())
    for passes in (False, True):
        opaque.opacities.grad = None
        render = ReferenceRasterizer(clamp_gradient=passes)(opaque, plain_camera(), BLACK)
        assert render.alpha[10, 16].item() == pytest.approx(0.99)
        render.alpha[10, 16].backward()
        assert opaque.opacities.grad is not None
        assert opaque.opacities.grad.item() == pytest.approx(1.0 if passes else 0.0)


def test_mean2d_gradient_is_in_ndc_units() -> None:
    g, camera = replace(one(x=0.05, y=0.1), means=torch.tensor([[0.05, 0.1, 2.0]], dtype=F64).requires_grad_()), plain_camera()
    weights = torch.rand(21, 33, generator=torch.Generator().manual_seed(0), dtype=F64)
    render = ReferenceRasterizer()(g, camera, BLACK)
    assert (render.mean2d_grad == 0).all() and not render.mean2d_grad.requires_grad
    (render.alpha * weights).sum().backward()

    def loss(cx: float, cy: float) -> float:  # inside the limits of the Jacobian, the principal point moves only the centre
        r = ReferenceRasterizer()(g, plain_camera(cx=cx, cy=cy), BLACK)
        return (r.alpha * weights).sum().item()

    h = 1e-5
    pixel = [(loss(16.5 + h, 10.5) - loss(16.5 - h, 10.5)) / (2 * h), (loss(16.5, 10.5 + h) - loss(16.5, 10.5 - h)) / (2 * h)]
    torch.testing.assert_close(render.mean2d_grad[0], torch.tensor([pixel[0] * 33 / 2, pixel[1] * 21 / 2], dtype=F64), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("limit", [1 << 24, 0])
def test_absolute_gradients_are_sums_over_pixels(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scene_experts.render.reference._CHECKPOINT", limit)
    g, camera = one(x=0.05, y=0.1, size=0.3), plain_camera()
    means = g.means.clone().requires_grad_()
    weights = torch.randn(21, 33, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    draw = ReferenceRasterizer(absolute=True)
    render = draw(replace(g, means=means), camera, BLACK)
    assert (render.mean2d_grad == 0).all()
    loss = (render.image * weights).sum()
    loss.backward(retain_graph=True)
    h, expected = 1e-5, []
    for dx, dy, side in ((h, 0.0, 33), (0.0, h, 21)):  # inside the limits of the Jacobian, the principal point moves only the centre
        up, down = (draw(g, plain_camera(cx=16.5 + s * dx, cy=10.5 + s * dy), BLACK).image for s in (1, -1))
        moved = ((up - down).abs() < 1e-3).all(2)  # not the pixels whose alpha passes 1/255 between the two
        expected.append((((up - down) / (2 * h) * weights).sum(2) * moved).abs().sum() * side / 2)
    torch.testing.assert_close(render.mean2d_grad[0], torch.stack(expected), rtol=1e-6, atol=1e-9)
    loss.backward()  # overwrites
    torch.testing.assert_close(render.mean2d_grad[0], torch.stack(expected), rtol=1e-6, atol=1e-9)


def test_mean2d_gradient_without_gradients_of_the_means() -> None:
    scales = one().scales.requires_grad_()
    render = ReferenceRasterizer()(replace(one(x=0.05), scales=scales), plain_camera(), BLACK)
    render.alpha[:, :16].sum().backward()
    assert render.mean2d_grad[0, 0] < 0
    with torch.no_grad():
        assert not ReferenceRasterizer()(replace(one(), scales=scales), plain_camera(), BLACK).image.requires_grad


def test_near_plane_is_the_camera_s() -> None:
    camera = plain_camera()
    for z, near, drawn in (
        (0.2, 0.2, False),
        (0.2001, 0.2, True),
        (0.05, 0.2, False),
        (0.05, 0.01, True),
        (-1.0, 0.01, False),
        (0.0, 0.0, False),
    ):
        g = one(z=z, size=0.01)
        render = ReferenceRasterizer()(g, replace(camera, near=near), BLACK)
        assert bool(render.radii.item() > 0) == drawn == bool(render.alpha.max() > 0)
        assert ReferenceRasterizer().visible(g.means, g.scales, replace(camera, near=near)).tolist() == [drawn]


def test_what_the_picture_cannot_show_has_no_radius() -> None:
    camera = plain_camera(33, 21)  # tiles cover 48 x 32 pixels
    left, right = one(x=-3.0), one(x=3.0)
    just = one(x=(40 - 16.5) / 40 * 2, size=0.02)  # centre at column 40: outside the picture, inside its last tile
    render = ReferenceRasterizer()(join(left, right, just), camera, BLACK)
    assert (render.radii > 0).tolist() == [False, False, True]
    assert render.alpha.max() == 0
    assert ReferenceRasterizer().visible(join(left, right, just).means, join(left, right, just).scales, camera).tolist() == [
        False,
        False,
        True,
    ]


def test_radius_does_not_depend_on_opacity() -> None:
    faint = ReferenceRasterizer()(one(opacity=1e-3), plain_camera(), BLACK)
    assert faint.alpha.max() == 0
    assert faint.radii.item() == ReferenceRasterizer()(one(opacity=1.0), plain_camera(), BLACK).radii.item() > 0


@pytest.mark.parametrize("g", [make_scene(0), one(z=-5.0), one(opacity=1e-3)], ids=["none", "all behind", "all too faint"])
def test_an_empty_picture_is_the_background_and_can_go_backward(g: Gaussians) -> None:
    means = g.means.clone().requires_grad_()
    background = torch.tensor([0.1, 0.2, 0.3], dtype=F64, requires_grad=True)
    render = ReferenceRasterizer()(replace(g, means=means), make_camera(), background)
    torch.testing.assert_close(render.image, background.expand(37, 45, 3))
    assert render.alpha.sum() == 0 and render.depth.sum() == 0
    assert render.radii.shape == (len(g),) and render.mean2d_grad.shape == (len(g), 2)
    (render.image.sum() + render.depth.sum()).backward()
    assert means.grad is not None and (means.grad == 0).all()
    assert background.grad is not None and background.grad.tolist() == [45 * 37] * 3


def test_float32_agrees_with_float64() -> None:
    g, camera = make_scene(200), make_camera()
    single = Gaussians(*(getattr(g, n).float() for n in ("means", "quats", "scales", "opacities", "colors")), g.source)
    ours, exact = ReferenceRasterizer()(single, camera, BLACK.float()), ReferenceRasterizer()(g, camera, BLACK)
    assert ours.image.dtype == torch.float32
    assert (ours.image - exact.image).abs().mean() < 1e-6


def test_bad_numbers_are_not_drawn() -> None:
    for name in ("means", "scales", "opacities"):
        for value in (float("nan"), float("inf")):
            g = join(one(), one(x=0.1))
            bad = getattr(g, name).clone()
            bad[1] = value
            if (name, value) == ("opacities", float("inf")):
                continue  # draws as fully opaque
            picture = ReferenceRasterizer()(replace(g, **{name: bad}), plain_camera(), BLACK).image
            torch.testing.assert_close(picture, ReferenceRasterizer()(one(), plain_camera(), BLACK).image)


def test_antialias_dims_splats_smaller_than_a_pixel() -> None:
    g, camera = one(size=0.02, opacity=0.8), plain_camera()
    sharp = (40 * 0.02 / 2) ** 2
    alpha = ReferenceRasterizer(antialias=True)(g, camera, BLACK).alpha[10, 16].item()
    assert alpha == pytest.approx(0.8 * sharp / (sharp + 0.3), rel=1e-9)
    tiny = ReferenceRasterizer(antialias=True)(one(size=1e-5, opacity=1.0), camera, BLACK).alpha[10, 16].item()
    assert tiny == pytest.approx(0.005, rel=1e-9)
