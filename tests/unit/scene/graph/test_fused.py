"""The Triton kernels of the graph points against the same in plain torch: values, gradients, ties, duplicates, few points, fine cells."""

import pytest
import torch

from scene_experts.native import triton
from scene_experts.scene.graph import fused
from scene_experts.scene.graph.hash_grid import HashGrid
from scene_experts.scene.graph.network import Graph, blend_neighbours
from support.graph_scenes import CAMERA as SEEN
from support.graph_scenes import start_graph
from support.interpret import DEVICE, kernels

ODD = HashGrid(levels=5, features=3, log2_table=7, base=2, growth=1.6)
CUBE = ((-1.5, -2.0, -1.0), 3.0)  # smaller than the cloud: positions outside count as on its sides
CAMERA = torch.tensor([0.1, 0.2, 5.0])


@pytest.fixture(scope="module", autouse=True)
def _triton():
    kernels("scene_experts.scene.graph.triton_kernels")


def cloud(n: int, seen: int, F: int, config: HashGrid):
    torch.manual_seed(n)
    xyz, rows = torch.randn(n, 3), torch.randperm(n)[:seen]
    grid = config.build(*CUBE)
    grid.table.data.normal_()
    return xyz, rows, torch.randn(n, F), grid


def by_torch(f, grid, graph, xyz, rows, share, camera):
    own = f.index_select(0, rows)
    parts = [grid(xyz[rows]), blend_neighbours(own, *graph.among(rows), share)]
    if camera is not None:
        gap = xyz[rows] - camera
        parts += [gap / gap.norm(dim=1, keepdim=True), gap.norm(dim=1, keepdim=True)]
    return torch.cat(parts, dim=1), own.amax(0) if len(rows) else f.new_zeros(f.shape[1])


def both(xyz, rows, f, grid, k, share=0.5, camera=None):
    """Values and gradients of the inputs and the maxima: of the kernels and of plain torch in float64, on the CPU."""
    leaf = f.clone().requires_grad_()
    exact = (f.double().requires_grad_(), grid.config.build(*CUBE).double())
    exact[1].table.data.copy_(grid.table.data)
    graph = Graph.of(xyz, k)
    up, to = torch.randn(len(rows), grid.config.width + f.shape[1] + 4 * (camera is not None)), torch.randn(f.shape[1])
    moved = (grid.to(DEVICE), graph.change(lambda t: t.to(DEVICE)), xyz.to(DEVICE), rows.to(DEVICE))
    out = fused.encode(leaf.to(DEVICE), *moved, share, None if camera is None else camera.to(DEVICE))
    found = torch.autograd.grad([*out], (leaf, grid.table), [up.to(DEVICE), to.to(DEVICE)], allow_unused=True)
    wanted = by_torch(
        exact[0], exact[1], graph.change(lambda t: t.double() if t.is_floating_point() else t), xyz.double(), rows, share, camera
    )
    loss = (wanted[0] * up.double()).sum() + (wanted[1] * to.double()).sum()
    gradients = torch.autograd.grad(loss, (exact[0], exact[1].table))
    return [t.detach().cpu() for t in (*out, *found)], [t.detach().float() for t in (*wanted, *gradients)]


@pytest.mark.parametrize(
    ("n", "seen", "F", "k", "config"),
    [(90, 61, 32, 10, ODD), (40, 40, 5, 4, HashGrid(levels=2, features=1)), (20, 0, 8, 10, ODD), (1, 1, 1, 10, ODD), (3, 2, 3, 2, ODD)],
)
def test_values_and_gradients_are_those_of_torch(n, seen, F, k, config):
    for one, other in zip(*both(*cloud(n, seen, F, config), k, camera=CAMERA)):
        torch.testing.assert_close(one, other, rtol=2e-4, atol=2e-5)


def test_ties_share_a_gradient_and_duplicates_are_neighbours():
    xyz, rows, f, grid = cloud(60, 45, 6, ODD)
    xyz[30:] = xyz[:30]
    for values in (f.round(), torch.zeros_like(f)):
        for one, other in zip(*both(xyz, rows, values, grid, 7, 0.7)):
            torch.testing.assert_close(one, other, rtol=2e-4, atol=2e-5)


def test_the_finest_cells_and_a_point_on_the_far_corner():
    config = HashGrid(levels=2, base=2**21 - 1, growth=1.5, log2_table=9)
    xyz, rows, f, grid = cloud(12, 12, 2, config)
    xyz[0], xyz[1] = 1.5, torch.tensor(CUBE[0])  # one is outside on one axis
    xyz[2] = torch.tensor(CUBE[0]) + CUBE[1]
    rows = torch.arange(12)
    graph = Graph.of(xyz, 3)
    moved = (f.to(DEVICE), grid.to(DEVICE), graph.change(lambda t: t.to(DEVICE)), xyz.to(DEVICE), rows.to(DEVICE))
    found, _ = fused.encode(*moved, 0.5)
    torch.testing.assert_close(found[:, :4].cpu(), grid.cpu()(xyz), rtol=1e-4, atol=1e-4)


def test_a_gradient_of_the_grid_has_the_same_bits_in_any_order_and_keeps_small_values():
    xyz, rows, f, grid = cloud(50, 50, 2, ODD)
    xyz[25:] = xyz[:25]  # the same cells
    graph, up = Graph.of(xyz, 3).change(lambda t: t.to(DEVICE)), torch.randn(50, ODD.width + 2)
    up[7] *= 1e6
    up[11] *= 1e-6

    def gradient(rows: torch.Tensor) -> torch.Tensor:
        grid.to(DEVICE).table.grad = None
        out, _ = fused.encode(f.to(DEVICE), grid, graph, xyz.to(DEVICE), rows.to(DEVICE), 0.5)
        (found,) = torch.autograd.grad(out, grid.table, up[rows].to(DEVICE))
        return found.cpu()

    first = gradient(rows)
    assert torch.equal(first, gradient(rows.flip(0)))
    exact = ODD.build(*CUBE).double()
    (wanted,) = torch.autograd.grad(exact(xyz.double()), exact.table, up[:, : ODD.width].double())
    torch.testing.assert_close(first.double(), wanted, rtol=1e-4, atol=1e-4)


def test_a_gradient_that_is_not_a_number_stays_visible():
    xyz, rows, f, grid = cloud(8, 8, 2, ODD)
    graph = Graph.of(xyz, 3).change(lambda t: t.to(DEVICE))
    out, _ = fused.encode(f.to(DEVICE), grid.to(DEVICE), graph, xyz.to(DEVICE), rows.to(DEVICE), 0.5)
    assert torch.autograd.grad(out, grid.table, torch.full_like(out, torch.nan), retain_graph=True)[0].isnan().all()
    assert not torch.autograd.grad(out, grid.table, torch.zeros_like(out))[0].any()


def test_a_gradient_by_finite_differences():
    """Of a feature and of a row of the table, in steps that float32 resolves."""
    xyz, rows, f, grid = cloud(9, 9, 2, HashGrid(levels=1, features=1, log2_table=4, base=2))
    graph, up = Graph.of(xyz, 4).change(lambda t: t.to(DEVICE)), torch.randn(9, 3)

    def value(f: torch.Tensor) -> torch.Tensor:
        out, _ = fused.encode(f.to(DEVICE), grid.to(DEVICE), graph, xyz.to(DEVICE), rows.to(DEVICE), 0.5)
        return (out.cpu() * up).sum()

    leaf = f.clone().requires_grad_()
    by_feature, by_table = torch.autograd.grad(value(leaf), (leaf, grid.table))
    step = torch.zeros_like(f)
    step[4, 1] = 1e-2
    assert float((value(f + step) - value(f - step)) / 2e-2) == pytest.approx(float(by_feature[4, 1]), rel=1e-2, abs=1e-3)
    row, before = int(by_table.abs().argmax()), grid.table.data.clone()
    grid.table.data[row] = before[row] + 0.5
    high = value(f)
    grid.table.data[row] = before[row] - 0.5
    assert float(high - value(f)) == pytest.approx(float(by_table[row]), rel=1e-3)


@pytest.mark.parametrize(("H", "width", "F", "view"), [(35, 96, 32, True), (3, 40, 7, False), (1, 2, 1, True)])
def test_a_folded_layer_is_that_of_the_scene(H, width, F, view):
    torch.manual_seed(H)
    values = [torch.randn(H, width + 4 * view), torch.randn(width), torch.randn(width), torch.randn(F)]
    up, to = torch.randn(H, width - F + 4), torch.randn(H)
    leaves, exact = [t.to(DEVICE).requires_grad_() for t in values], [t.double().requires_grad_() for t in values]
    found = fused.fold(*leaves, width - F + 4)
    weight, alpha, beta, strongest = exact
    own = (weight[:, :width] * alpha)[:, : width - F]
    shared = (weight[:, width - F : width] * alpha[width - F :]) @ strongest
    wanted = torch.cat([own, weight[:, width:] if view else own.new_zeros(H, 4)], dim=1), shared + weight[:, :width] @ beta
    gradients = torch.autograd.grad([*found], leaves, [up.to(DEVICE), to.to(DEVICE)])
    for one, other in zip((*found, *gradients), (*wanted, *torch.autograd.grad([*wanted], exact, [up.double(), to.double()]))):
        torch.testing.assert_close(one.cpu(), other.float(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("A", "M"), [(150, 131), (5, 1), (4, 0)])
def test_gaussians_are_those_of_the_scene(A, M):
    scene = start_graph(torch.float32)
    torch.manual_seed(M)
    rows, keep = torch.randperm(len(scene.table))[:A].sort().values, torch.randperm(A)[:M].sort().values
    source, values = rows[keep], [torch.randn(M, 3), torch.randn(M, 7), torch.randn(M, 3), torch.rand(A, 1)]
    values[1][: M // 50] = 0  # quaternions without a length
    xyz, log_scaling = scene.table.facts["xyz"], scene.table.params["log_scaling"]
    exact = [log_scaling, *(t.clone().requires_grad_() for t in values)]
    leaves = [t.detach().to(DEVICE).requires_grad_() for t in exact]
    g = scene.place(keep, source, *exact[1:])
    wanted = (g.means, g.quats, g.scales, g.opacities, g.colors)
    found = fused.place(keep.to(DEVICE), source.to(DEVICE), xyz.to(DEVICE), *leaves)
    ups = [torch.randn(t.shape) for t in wanted]
    ups[1][: M // 50] *= 1e-12  # their gradients are divided by EPS
    gradients = torch.autograd.grad([*found], leaves, [u.to(DEVICE) for u in ups])
    for one, other in zip((*found, *gradients), (*wanted, *torch.autograd.grad([*wanted], exact, ups))):
        torch.testing.assert_close(one.cpu(), other, rtol=1e-4, atol=1e-5)


def test_a_scene_decodes_with_them_as_without(monkeypatch):
    scene = start_graph(torch.float32)
    rows = torch.arange(0, len(scene.table), 3)

    def decode() -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        decoded = scene.decode(rows, SEEN)
        g = decoded.gaussians
        values = [g.means, g.quats, g.scales, g.opacities, g.colors, decoded.raw_opacity]
        leaves = [scene.table.params["feature"], scene.table.params["log_scaling"], *scene.network_tensors().values()]
        gradients = torch.autograd.grad(sum((v * v).sum() for v in values), leaves)
        return [*values, scene.slot_points(rows, rows[::5])], [*gradients]

    plain = decode()
    if DEVICE == "cuda":
        scene.to(DEVICE)
        rows = rows.to(DEVICE)
    else:
        monkeypatch.setattr(triton, "covers", lambda *tensors: all(t.dtype == torch.float32 for t in tensors))
    found = decode()
    for one, other in zip(found[0], plain[0]):
        torch.testing.assert_close(one.cpu(), other, rtol=1e-3, atol=1e-4)
    for one, other in zip(found[1], plain[1]):
        assert float((one.cpu() - other).norm()) <= 1e-4 * float(other.norm())
