from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from types import ModuleType

import pytest
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.render import gsplat as adapter
from scene_experts.render.reference import ReferenceRasterizer, _blend, _pixel_centres, add_absolute, project
from support.gaussians import make_camera, make_scene

NAMES = ("means", "quats", "scales", "opacities", "colors")
BACKGROUND = torch.tensor([0.2, 0.7, 0.1])


def single(g: Gaussians, device: str = "cpu", grad: bool = False) -> Gaussians:
    parts = {n: getattr(g, n).to(device, torch.float32).detach().clone().requires_grad_(grad) for n in NAMES}
    return replace(g, **parts, source=g.source.to(device))


class FakeGsplat(ModuleType):
    """The four functions that the adapter calls, in plain torch, with the parameters, shapes and meanings of gsplat 1.5.3.

    It tests how the adapter orders, shapes and converts arguments and results, not gsplat itself.
    """

    def __init__(self) -> None:
        super().__init__("gsplat")
        self.seen: dict[str, object] = {}

    def fully_fused_projection(
        self,
        means: Tensor,
        covars: Tensor | None,
        quats: Tensor,
        scales: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        eps2d: float = 0.3,
        near_plane: float = 0.01,
        far_plane: float = 1e10,
        radius_clip: float = 0.0,
        packed: bool = False,
        sparse_grad: bool = False,
        calc_compensations: bool = False,
        camera_model: str = "pinhole",
        opacities: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
        assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and covars is None and not packed
        self.seen.update(eps2d=eps2d, near=near_plane, camera_model=camera_model)
        p = project(means, quats, scales, Camera(viewmats[0], Ks[0], width, height, near_plane))
        radii = p.radii[:, None].expand(-1, 2).clone()
        if opacities is not None:
            assert not opacities.requires_grad
            radii[opacities < 1 / 255] = 0
        radii[-1] = 77  # drawn by gsplat, but not by the 3 sigma rule
        return radii[None], p.mean2d[None], p.depth[None], p.conic[None], p.compensation[None] if calc_compensations else None

    def isect_tiles(
        self, means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
    ) -> tuple[Tensor, ...]:
        assert radii.shape == means2d.shape and radii.dtype == torch.int32 and depths.shape == means2d.shape[:2]
        drawn = torch.where((radii[0] > 0).all(1))[0]
        order = drawn[depths[0, drawn].argsort(stable=True)]
        return order, order, order

    def isect_offset_encode(self, isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
        return torch.zeros(n_images, tile_height, tile_width, dtype=torch.int32)

    def rasterize_to_pixels(
        self,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        image_width: int,
        image_height: int,
        tile_size: int,
        isect_offsets: Tensor,
        flatten_ids: Tensor,
        backgrounds: Tensor | None = None,
        absgrad: bool = False,
    ) -> tuple[Tensor, Tensor]:
        assert isect_offsets.shape == (1, -(-image_height // tile_size), -(-image_width // tile_size))
        assert backgrounds is not None and backgrounds.shape == (1, colors.shape[2]) and opacities.shape == colors.shape[:2]
        splats = torch.cat([means2d[0], conics[0], opacities[0, :, None], colors[0]], dim=1)[flatten_ids]
        if absgrad:
            means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
        see = partial(add_absolute, means2d.absgrad[0], flatten_ids) if absgrad else None  # type: ignore[attr-defined]
        out = _blend(splats, _pixel_centres((0, 0), (image_height, image_width), splats), False, see)
        out = out.view(1, image_height, image_width, 5)
        return out[..., :4] + out[..., 4:] * backgrounds[:, None, None], 1 - out[..., 4:]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeGsplat:
    module = FakeGsplat()
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(adapter, "explain_missing", lambda: None)
    return module


def backward(render: Render, g: Gaussians) -> list[Tensor]:
    weights = torch.linspace(-1, 1, render.alpha.numel(), device=render.alpha.device).view(render.alpha.shape)
    (render.image.square().sum() + (weights * (render.depth + 3 * render.alpha)).sum()).backward()
    return [render.mean2d_grad, *(getattr(g, n).grad for n in NAMES)]


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("antialias", [False, True])
def test_the_adapter_converts_arguments_and_results(fake: FakeGsplat, antialias: bool, absolute: bool) -> None:
    scene, camera = make_scene(80, size=0.05), make_camera(45, 37, 14.2, 25.1, near=0.33).to(dtype=torch.float32)
    scene.means[-1, 0] = 50.0  # far outside: the 3 sigma rule gives it no radius
    results = []
    how = {"antialias": antialias, "absolute": absolute}
    for rasterizer in (adapter.GsplatRasterizer(**how), ReferenceRasterizer(**how)):
        g = single(scene, grad=True)
        render = rasterizer(g, camera, BACKGROUND)
        results.append([render.image, render.alpha, render.depth, render.radii, *backward(render, g)])
    assert fake.seen == {"eps2d": 0.3, "near": 0.33, "camera_model": "pinhole"}
    for ours, expected in zip(*results, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_faint_gaussians_keep_their_radius(fake: FakeGsplat) -> None:
    g, camera = single(make_scene(20)), make_camera().to(dtype=torch.float32)
    g = replace(g, opacities=torch.full((20,), 1e-3))
    render = adapter.GsplatRasterizer()(g, camera, BACKGROUND)
    assert render.alpha.max() == 0
    assert torch.equal(render.radii, ReferenceRasterizer()(g, camera, BACKGROUND).radii) and (render.radii > 0).any()


def test_no_gaussians(fake: FakeGsplat) -> None:
    render = adapter.GsplatRasterizer()(single(make_scene(0)), make_camera().to(dtype=torch.float32), BACKGROUND)
    torch.testing.assert_close(render.image, BACKGROUND.expand(37, 45, 3))


def test_without_gsplat_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "explain_missing", lambda: "gsplat 1.5.3 or newer is required")
    with pytest.raises(InputError, match=r"1\.5\.3"):
        adapter.GsplatRasterizer()(single(make_scene(1)), make_camera(), BACKGROUND)


def test_projection_is_that_of_gsplat_s_own_torch_reference() -> None:
    published = pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")
    from scene_experts.geometry.rotation import covariance

    g, camera = make_scene(500, spread=1.5), make_camera(45, 37, 9.3, 14.8)
    _, means2d, depths, conics, compensations = published._fully_fused_projection(
        g.means,
        covariance(g.quats, g.scales),
        camera.world_to_cam[None],
        camera.K[None],
        camera.width,
        camera.height,
        near_plane=camera.near,
        calc_compensations=True,
    )
    ours = project(g.means, g.quats, g.scales, camera)
    drawn = ours.radii > 0
    for theirs, mine in (
        (means2d, ours.mean2d),
        (depths, ours.depth),
        (conics, ours.conic),
        (compensations.clamp_min(0.005), ours.compensation),
    ):
        torch.testing.assert_close(mine[drawn], theirs[0][drawn])


@pytest.fixture(scope="module")
def real() -> None:
    reason = adapter.explain_missing()  # here, not at import: gsplat may have to compile
    if reason is not None:
        pytest.skip(reason)


@pytest.mark.gpu
@pytest.mark.usefixtures("real")
@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("center", [(None, None), (301.0, 95.5)], ids=["centred", "off-centre"])
def test_the_real_gsplat_agrees_with_the_reference(antialias: bool, center: tuple[float | None, float | None], absolute: bool) -> None:
    scene = make_scene(3000, size=0.04)
    scene = replace(scene, opacities=scene.opacities.clamp_max(0.98))  # below both clamps of alpha
    camera = make_camera(333, 217, *center, f=300.0).to("cuda", torch.float32)
    results = []
    how = {"antialias": antialias, "absolute": absolute}
    for rasterizer in (adapter.GsplatRasterizer(**how), ReferenceRasterizer(**how)):
        g = single(scene, "cuda", grad=True)
        render = rasterizer(g, camera, BACKGROUND.cuda())
        results.append((render, backward(render, g)))
    (ours, our_grads), (expected, grads) = results
    assert torch.equal(ours.radii, expected.radii)
    # Single pixels differ where an alpha is on the other side of a threshold, so means are compared.
    assert (ours.image - expected.image).abs().mean() < 1e-5
    assert (ours.depth - expected.depth).abs().mean() < 1e-4
    assert (ours.alpha - expected.alpha).abs().mean() < 1e-5
    tangent = grads[2] - (grads[2] * scene.quats.to(grads[2])).sum(1, keepdim=True) * scene.quats.to(grads[2])
    grads[2] = tangent  # gsplat normalises quaternions inside
    for ours_, expected_ in zip(our_grads, grads, strict=True):
        assert (ours_ - expected_).norm() < 2e-3 * expected_.norm()
