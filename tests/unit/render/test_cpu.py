"""The compiled rasteriser against the reference in float64, for every instruction set and number of threads."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.native import library as native
from scene_experts.render import Rasterizer
from scene_experts.render.cpu import CpuRasterizer
from scene_experts.render.reference import ReferenceRasterizer
from support.messages import naming

pytestmark = pytest.mark.skipif(native.load() is None, reason=str(native.explain_missing()))
LEVELS = [name for name in native.list_levels() if native.find(name)]
NAMES = ("means", "quats", "scales", "opacities", "colors", "background", "mean2d")
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def make(
    m: int = 500, width: int = 70, height: int = 51, aspect: float = 3.0, size: float = 0.05, opacity: float | None = None, seed: int = 0
) -> tuple[tuple[Tensor, ...], Camera]:
    """Return M Gaussians and a rotated camera with an off-centre principal point. Some are behind it, some outside the picture."""
    rng = torch.Generator().manual_seed(seed)
    uniform = lambda *shape: torch.rand(*shape, generator=rng)  # noqa: E731
    means = torch.stack([4 * uniform(m) - 2, 3 * uniform(m) - 1.5, 5 * uniform(m) - 1], dim=1)
    quats = torch.nn.functional.normalize(torch.randn(m, 4, generator=rng), dim=1)
    scales = size * torch.exp(0.4 * torch.randn(m, 3, generator=rng)) * torch.tensor([1.0, 1.0, 1 / aspect])
    opacities = 0.01 + 0.95 * uniform(m) if opacity is None else torch.full((m,), opacity)
    K = torch.tensor([[60.0, 0, width / 2 + 7.3], [0, 64.0, height / 2 - 5.2], [0, 0, 1]])
    pose = torch.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(0.1)
    pose[0, 2] = math.sin(0.1)
    pose[2, 0] = -math.sin(0.1)
    pose[2, 3] = 1.2
    return (means, quats, scales, opacities, uniform(m, 3)), Camera(pose, K, width, height)


def draw(
    rasterizer: Rasterizer, inputs: tuple[Tensor, ...], camera: Camera, dtype: torch.dtype, parts: str = "image alpha depth"
) -> tuple[Render, dict[str, Tensor]]:
    """Return the picture, and the gradients of a fixed random weighting of its `parts`."""
    leaves = [t.detach().to(dtype).clone().requires_grad_() for t in (*inputs, BACKGROUND)]
    render = rasterizer(Gaussians(*leaves[:5], torch.arange(len(leaves[0]))), camera, leaves[5])
    rng = torch.Generator().manual_seed(5)
    chosen = [getattr(render, part) for part in parts.split()]
    torch.stack([(torch.randn(t.shape, generator=rng, dtype=torch.float64).to(dtype) * t).sum() for t in chosen]).sum().backward()
    grads = [torch.zeros_like(t) if t.grad is None else t.grad for t in leaves]
    return render, dict(zip(NAMES, [*grads, render.mean2d_grad], strict=True))


def relative(expected: Tensor, found: Tensor) -> float:
    return float((expected - found.double()).detach().norm() / expected.detach().norm().clamp_min(1e-30))


def agree(inputs: tuple[Tensor, ...], camera: Camera, tolerance: float = 1e-5, parts: str = "image alpha depth", **kw: object) -> None:
    reference = ReferenceRasterizer(antialias=bool(kw.get("antialias")), absolute=bool(kw.get("absolute")))
    expected, grads = draw(reference, inputs, camera, torch.float64, parts)
    found, ours = draw(CpuRasterizer(**kw), inputs, camera, torch.float32, parts)  # type: ignore[arg-type]
    assert found.image.shape == (camera.height, camera.width, 3) and found.image.is_contiguous()
    for part in ("image", "alpha", "depth"):
        assert relative(getattr(expected, part), getattr(found, part)) < 5e-6, part
    differ = (expected.radii - found.radii).abs()  # a radius is rounded up: float32 may land on the other side of an integer
    assert differ.max() <= 1 and differ.sum() <= 1 + len(differ) // 200
    errors = {name: relative(grads[name], ours[name]) for name in NAMES}
    assert max(errors.values()) < tolerance, errors


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("antialias", [False, True])
def test_agrees_with_float64(level: str, deterministic: bool, antialias: bool) -> None:
    agree(*make(), level=level, deterministic=deterministic, antialias=antialias)


@pytest.mark.parametrize("level", LEVELS)
def test_saturated_scene(level: str) -> None:
    agree(*make(size=0.4, opacity=0.97), tolerance=1e-4, level=level)


KINDS = [{"aspect": 10.0}, {"size": 0.01}, {"size": 0.003}, {"opacity": 1.0}, {"m": 17}, {"m": 3000, "width": 64, "height": 48}]


@pytest.mark.parametrize("kw", KINDS)
@pytest.mark.parametrize("antialias", [False, True])
def test_kinds_of_scenes(kw: dict[str, float], antialias: bool) -> None:
    agree(*make(**kw), antialias=antialias)  # type: ignore[arg-type]


def test_needles() -> None:
    inputs, camera = make(aspect=1.0, size=0.02)
    inputs[2][:, 0] *= 40
    inputs[2][:, 1:] /= 2
    _, exact = draw(ReferenceRasterizer(), inputs, camera, torch.float64)
    _, single = draw(ReferenceRasterizer(), inputs, camera, torch.float32)
    _, ours = draw(CpuRasterizer(), inputs, camera, torch.float32)
    for name in NAMES:
        assert relative(exact[name], ours[name]) < 10 * max(relative(exact[name], single[name]), 1e-6), name


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("length, width", [(100, 0.3), (500, 0.03)])
def test_thin_gaussians_keep_their_digits(length: float, width: float, antialias: bool, level: str) -> None:
    """In pixels; a backward pass through the inverse of the 2D covariance loses up to 50 % here."""
    rng = torch.Generator().manual_seed(1)
    camera = Camera(torch.eye(4), torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]), 64, 64)
    worst = 0.0
    for _ in range(5):
        mean = torch.tensor([[0.0, 0, 2]]) + 0.2 * torch.randn(1, 3, generator=rng)
        quat = torch.nn.functional.normalize(torch.randn(1, 4, generator=rng), dim=1)
        inputs = (mean, quat, torch.tensor([[length, width, width]]) / 32, torch.tensor([0.5]), torch.rand(1, 3, generator=rng))
        _, exact = draw(ReferenceRasterizer(antialias=antialias), inputs, camera, torch.float64, "image")
        _, ours = draw(CpuRasterizer(antialias=antialias, level=level), inputs, camera, torch.float32, "image")
        worst = max(worst, *(relative(exact[name], ours[name]) for name in ("means", "quats", "scales")))
    assert worst < 2e-2


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (3, 40), (100, 5), (300, 3)])
def test_any_picture_size(size: tuple[int, int]) -> None:
    agree(*make(width=size[0], height=size[1], size=0.1))


@pytest.mark.parametrize("parts", ["image", "alpha", "depth", "image depth"])
def test_each_output_alone(parts: str) -> None:
    agree(*make(), parts=parts)


@pytest.mark.parametrize(("m", "tolerance"), [(700, 1e-5), (1100, 1e-4)])  # two and three batches; with 1100 some alphas lie near 1/255
def test_many_gaussians_on_one_pixel(m: int, tolerance: float) -> None:
    inputs, camera = make(m=m)
    inputs[0][:] = torch.tensor([0.0, 0.0, 1.0]) + 0.01 * inputs[0]
    inputs[3][:] = 0.02
    agree(inputs, camera, tolerance)


def test_equal_depths_keep_their_order() -> None:
    inputs, camera = make(m=64)
    inputs[0][:] = torch.tensor([0.0, 0.0, 1.0])
    inputs[2][:] = 0.1
    agree(inputs, camera)


def test_depths_close_together_and_one_far_away() -> None:
    """The two passes of the sort cannot distinguish these depths, so its last step must."""
    inputs, camera = make(m=400)
    camera.world_to_cam[:3, :3] = torch.eye(3)
    inputs[0][:, 2] = 1 + 1e-6 * torch.randperm(400, generator=torch.Generator().manual_seed(1)).float()
    inputs[0][0, 2] = 1e9
    agree(inputs, camera)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("steps", [1e6, 30.0], ids=["single depths", "equal depths"])
def test_order_across_chunks(level: str, steps: float) -> None:
    """Gaussians that are already sorted by depth give the same bits."""
    inputs, camera = make(m=20_000, width=250, height=190, size=0.02)
    camera.world_to_cam[:] = torch.eye(4)
    inputs[0][:, 2] = torch.round(inputs[0][:, 2] * steps) / steps
    inputs[2][::1000] *= 100  # some overlap many areas
    order = torch.sort(inputs[0][:, 2], stable=True).indices
    drawn = [
        CpuRasterizer(level=level, threads=2)(Gaussians(*tensors, torch.arange(len(order))), camera, BACKGROUND)
        for tensors in (inputs, [t[order] for t in inputs])
    ]
    assert torch.equal(drawn[0].image, drawn[1].image) and torch.equal(drawn[0].depth, drawn[1].depth)


@pytest.mark.parametrize("level", LEVELS)
def test_from_a_pixel_to_all_the_picture(level: str) -> None:
    inputs, camera = make(m=150, width=330, height=210, size=0.01)
    inputs[2][:] *= 10 ** (2.5 * torch.rand(150, 1, generator=torch.Generator().manual_seed(2)))
    agree(inputs, camera, 1e-4, level=level)


@pytest.mark.parametrize("level", LEVELS)
def test_deterministic_whatever_the_threads(level: str) -> None:
    inputs, camera = make(m=20000, width=150, height=130)
    first = None
    for threads in (1, 2, 4, 2):
        render, grads = draw(CpuRasterizer(deterministic=True, level=level, threads=threads), inputs, camera, torch.float32)
        values = [render.image, render.alpha, render.depth, *grads.values()]
        first = first or values
        assert all(torch.equal(a, b) for a, b in zip(first, values, strict=True))


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("parts", ["image", "image alpha depth"])
def test_absolute_gradients_agree_with_float64(level: str, deterministic: bool, parts: str) -> None:
    agree(*make(m=3000), absolute=True, level=level, deterministic=deterministic, parts=parts)
    agree(*make(m=200, size=1.5, aspect=40), tolerance=1e-4, absolute=True, level=level, deterministic=deterministic, antialias=True)


def test_absolute_gradients_change_no_other_bits() -> None:
    inputs, camera = make(m=5000)
    first = None
    for threads in (1, 3):
        draws = [CpuRasterizer(deterministic=True, absolute=absolute, threads=threads) for absolute in (False, True)]
        (_, signed), (_, absolute) = [draw(how, inputs, camera, torch.float32) for how in draws]
        assert all(torch.equal(signed[name], absolute[name]) for name in NAMES[:-1])
        size = signed["mean2d"].abs()
        assert (absolute["mean2d"] >= size * (1 - 1e-4) - 1e-5).all() and (absolute["mean2d"] > size).any()
        first = absolute["mean2d"] if first is None else first
        assert torch.equal(first, absolute["mean2d"])


def test_fast_mode_with_threads_agrees() -> None:
    inputs, camera = make(m=5000)
    for threads in (2, 4, 9):
        agree(inputs, camera, threads=threads)


def test_nothing_to_draw() -> None:
    inputs, camera = make(m=5)
    for count, shift in ((0, 0.0), (5, -100.0)):
        few = tuple(t[:count].clone() for t in inputs)
        few[0][:, 2] += shift
        render, grads = draw(CpuRasterizer(), few, camera, torch.float32)
        assert torch.equal(render.image, BACKGROUND.expand_as(render.image))
        assert not render.alpha.any() and not render.depth.any() and not render.radii.any()
        assert all(not grads[name].any() for name in NAMES if name != "background")


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_bad_numbers_harm_only_themselves(level: str, bad: float) -> None:
    inputs, camera = make(m=60)
    clean, _ = draw(CpuRasterizer(level=level), tuple(t[4:] for t in inputs), camera, torch.float32)
    for number in range(4):  # means, quats, scales, opacities
        inputs[number][number] = bad
    render, grads = draw(CpuRasterizer(level=level), inputs, camera, torch.float32)
    if not math.isfinite(bad):
        assert not render.radii[:3].any()
        assert torch.equal(render.image, clean.image)
    assert all(torch.isfinite(grads[name][4:] if name != "background" else grads[name]).all() for name in NAMES if math.isnan(bad))


def test_opacity_zero_and_negative_are_not_drawn() -> None:
    inputs, camera = make(m=50)
    inputs[3][:25] = 0.0
    inputs[3][25:] = -0.5
    render, grads = draw(CpuRasterizer(), inputs, camera, torch.float32)
    assert torch.equal(render.image, BACKGROUND.expand_as(render.image)) and (render.radii > 0).any()
    assert all(torch.isfinite(g).all() for g in grads.values())


@pytest.mark.parametrize("level", LEVELS)
def test_visible_is_the_reference_filter(level: str) -> None:
    inputs, camera = make(m=3001, size=0.02)
    expected = ReferenceRasterizer().visible(inputs[0].double(), inputs[2].double(), camera)
    found = CpuRasterizer(level=level).visible(inputs[0], inputs[2], camera)
    assert found.dtype == torch.bool and torch.equal(expected, found) and 0 < int(found.sum()) < 3001


def test_backward_twice_and_without_any() -> None:
    inputs, camera = make(m=100)
    leaf = inputs[0].clone().requires_grad_()
    rasterizer = CpuRasterizer(deterministic=True)
    render = rasterizer(Gaussians(leaf, *inputs[1:], torch.arange(100)), camera, BACKGROUND)
    for _ in range(3):  # graphs without a backward pass
        rasterizer(Gaussians(leaf, *inputs[1:], torch.arange(100)), camera, BACKGROUND)
    first = torch.autograd.grad(render.image.sum(), leaf, retain_graph=True)[0]
    second = torch.autograd.grad(render.image.sum(), leaf)[0]
    assert torch.equal(first, second) and render.mean2d_grad.any()


@pytest.mark.parametrize("threads", [1, 3])
def test_forward_alone_draws_the_same_bits(threads: int) -> None:
    inputs, camera = make(m=40000, width=300, height=200)
    kept, _ = draw(CpuRasterizer(threads=threads), inputs, camera, torch.float32)
    for _ in range(2):
        with torch.no_grad():
            alone = CpuRasterizer(threads=threads)(Gaussians(*inputs, torch.arange(40000)), camera, BACKGROUND)
        assert all(torch.equal(getattr(kept, part), getattr(alone, part)) for part in ("image", "alpha", "depth", "radii"))


def test_wrong_shapes_are_refused() -> None:
    inputs, camera = make(m=10)
    with pytest.raises(InputError, match=naming("quats", "(10, 4)", "(5, 4)")):
        CpuRasterizer()(Gaussians(inputs[0], inputs[1][:5], *inputs[2:], torch.arange(10)), camera, BACKGROUND)


@pytest.mark.parametrize("shape", [(), (1,), (5,), (3, 1)])
def test_a_background_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    inputs, camera = make(m=10)
    with pytest.raises(InputError, match=naming("background", "(3,)", str(shape))):
        CpuRasterizer()(Gaussians(*inputs, torch.arange(10)), camera, torch.zeros(shape))


@pytest.mark.parametrize("means, scales", [((10, 2), (10, 3)), ((10, 3), (3, 3)), ((30,), (10, 3))])
def test_visible_refuses_wrong_shapes(means: tuple[int, ...], scales: tuple[int, ...]) -> None:
    _, camera = make(m=10)
    with pytest.raises(InputError, match=naming("expected", "found")):
        CpuRasterizer().visible(torch.ones(means), torch.ones(scales), camera)


def test_another_instruction_set_is_refused_with_those_that_run_here() -> None:
    with pytest.raises(InputError, match=naming("avx5120", *LEVELS)):
        CpuRasterizer(level="avx5120")


@pytest.mark.parametrize("size", [(1_100_000, 1), (1, 1_100_000), (20_000, 20_000), (2**31 - 1, 1)])
def test_an_image_with_too_many_tiles_is_refused(size: tuple[int, int]) -> None:
    inputs, camera = make(m=10)
    with pytest.raises(InputError, match=naming(f"{size[0]:,} x {size[1]:,}")):
        CpuRasterizer()(Gaussians(*inputs, torch.arange(10)), replace(camera, width=size[0], height=size[1]), BACKGROUND)


def test_the_largest_side_is_drawn() -> None:
    inputs, camera = make(m=10)
    camera = replace(camera, width=65_535 * 16, height=1, K=torch.tensor([[9e5, 0, 5e5], [0, 9e5, 0.5], [0, 0, 1]]))
    render = CpuRasterizer()(Gaussians(*inputs, torch.arange(10)), camera, BACKGROUND)
    assert render.image.shape == (1, 65_535 * 16, 3) and bool(render.image.isfinite().all())
