"""Graph points: SAGS's numbers, its starting cloud, its decode against a slow form, finite differences, resume and a short training."""

import copy

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.types import Mode, Points
from scene_experts.geometry.curvature import curvature, find_flat
from scene_experts.geometry.neighbours import knn_d2
from scene_experts.scene.graph.hash_grid import HashGrid
from scene_experts.scene.graph.network import Graph, blend_neighbours
from scene_experts.scene.graph.scene import GraphPoints, GraphRates, GraphScene
from scene_experts.training.recipes import RECIPES
from support.graph_scenes import CAMERA, cloud, everyone, start_graph
from support.messages import naming


def test_networks_have_the_sizes_of_sags():
    scene = start_graph()
    sizes = {name: sum(p.numel() for p in group) for name, group in scene.rate_groups().items()}
    assert {k: sizes[k] for k in ("opacity", "color", "cov", "offsets")} == {"opacity": 4256, "color": 4320, "cov": 4448, "offsets": 6336}
    assert sizes["affine"] == 2 * 96 and sizes["grid"] == 2 * sum(HashGrid().rows())
    assert 4 * scene.file_values == 196


def test_rates_of_sags():
    rates = GraphRates()
    assert [rates.at("opacity", t, 100, 7.0) for t in (0, 100)] == pytest.approx([0.002, 2e-5])
    assert [rates.at("cov", t, 100, 7.0) for t in (0, 100)] == pytest.approx([0.004, 4e-5])
    assert [rates.at("color", t, 100, 7.0) for t in (0, 100)] == pytest.approx([0.008, 5e-5])
    for group in ("offsets", "grid", "affine"):
        assert [rates.at(group, t, 100, 7.0) for t in (0, 100)] == pytest.approx([0.005, 0.001])


def test_the_cloud_starts_as_the_midpoints_of_pairs_on_the_lattice():
    voxel, config = 0.05, GraphPoints(voxel_size=0.05)
    cells = torch.unique(torch.round(cloud().xyz / voxel).long(), dim=0)
    flat = find_flat(curvature(cells.double(), 10))
    assert 0 < int(flat.sum()) < len(cells)
    distance = torch.cdist(cells.double(), cells.double(), compute_mode="donot_use_mm_for_euclid_dist")
    scene = config.start(cloud(), 5.0)
    wanted = torch.cat([cells.double(), (cells.double()[:, None] + cells.double()[None]).flatten(0, 1) / 2]) * voxel
    xyz = scene.table.facts["xyz"].double()
    assert float(torch.cdist(xyz, wanted).amin(1).max()) < 1e-6  # nothing but midpoints
    assert float(torch.cdist(cells.double() * voxel, xyz).amin(1).max()) < 1e-6  # every point itself
    fewest = len(cells) + (int(flat.sum()) * 9 + int((~flat).sum()) * 5) / 2  # each pair found from both of its ends
    assert fewest <= len(xyz) <= 2 * fewest - len(cells) and len(distance) == len(cells)
    assert torch.equal(scene.table.facts["cell"], torch.floor(xyz / voxel + 0.5 + 1e-4).long())
    torch.testing.assert_close(
        scene.table.params["log_scaling"][:, 0].double(), knn_d2(xyz).clamp_min(1e-7).sqrt().log(), rtol=1e-5, atol=1e-5
    )
    assert not bool(scene.table.params["feature"].any())


def test_no_points_and_points_of_one_voxel():
    with pytest.raises(InputError, match="--init random"):
        GraphPoints().start(Points(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.uint8)), 5.0)
    one = GraphPoints(voxel_size=100.0).start(cloud(5), 5.0, [CAMERA])
    assert len(one.table) == 1 and torch.isfinite(one(CAMERA, 1, Mode.TRAIN, everyone).gaussians.means).all()


def slow(scene: GraphScene, rows: torch.Tensor) -> dict[str, torch.Tensor]:
    """The decode as the paper states it, row by row, with offsets and all networks for every row."""
    f, xyz, found = scene.table.params["feature"][rows], scene.table.facts["xyz"][rows], {}
    near = blend_neighbours(f, *Graph.of(scene.table.facts["xyz"], 10).among(rows), 0.5)
    weights = {k: v.detach() for k, v in scene.network_tensors().items()}
    for i, x in enumerate(xyz):
        encoded = torch.cat([scene.grid(x[None])[0], near[i], f.max(0).values]) * weights["affine.alpha"] + weights["affine.beta"]
        distance = (x - CAMERA.position).norm()
        seen = torch.cat([encoded, (x - CAMERA.position) / distance, distance[None]])
        out = {}
        for name in ("opacity", "cov", "color"):
            y = weights[f"{name}.0"] @ seen
            y = weights[f"{name}.1"] @ y.relu()
            out[name] = weights[f"{name}.2"] @ y.relu()
        scaling = scene.table.params["log_scaling"][rows[i]].exp()
        offset = weights["offsets.1"] @ (weights["offsets.0"] @ encoded)
        values = {
            "raw": out["opacity"].tanh(),
            "means": x + offset * scaling[:3],
            "quats": out["cov"][3:] / out["cov"][3:].norm(),
            "scales": scaling[3:] * out["cov"][:3].sigmoid(),
            "colors": out["color"].sigmoid(),
        }
        for name, value in values.items():
            found.setdefault(name, []).append(value)
    return {name: torch.stack(values).detach() for name, values in found.items()}


@pytest.mark.slow
def test_the_decode_is_that_of_the_text():
    scene = start_graph()
    rows = torch.arange(0, len(scene.table), 2)
    decoded, wanted = scene.decode(rows, CAMERA), slow(scene, rows)
    torch.testing.assert_close(decoded.raw_opacity.detach(), wanted["raw"])
    keep = wanted["raw"][:, 0] > 0
    assert 0 < int(keep.sum()) < len(rows)
    assert torch.equal(decoded.gaussians.source, rows[keep])
    for name in ("means", "quats", "scales", "colors"):
        torch.testing.assert_close(getattr(decoded.gaussians, name).detach(), wanted[name][keep])
    torch.testing.assert_close(decoded.gaussians.opacities.detach(), wanted["raw"][keep, 0])


def test_gradients_by_finite_differences():
    scene = start_graph(F=3, hidden=4, offset_hidden=4, grid=HashGrid(levels=2, features=1, log2_table=6, base=2))
    rows = torch.arange(0, len(scene.table), 12)
    leaves = [scene.table.params["feature"], scene.table.params["log_scaling"], *scene.network_tensors().values()]

    def drawn(*_: torch.Tensor) -> torch.Tensor:
        g = scene.decode(rows, CAMERA).gaussians
        return torch.cat([v.reshape(-1) for v in (g.means, g.quats, g.scales, g.opacities, g.colors)])

    assert torch.autograd.gradcheck(drawn, tuple(leaves), fast_mode=True)


def test_gaussians_stand_where_the_whole_graph_puts_them():
    scene = start_graph()
    everybody = torch.arange(len(scene.table))
    with torch.no_grad():
        own, strongest = scene.encode(everybody)
        whole = torch.cat([own, strongest.expand(len(own), -1)], dim=1) * scene.alpha + scene.beta
        offset = whole @ scene.offsets.layers[0].T @ scene.offsets.layers[1].T * scene.table.params["log_scaling"][:, :3].exp()
        rows = torch.tensor([7, 3, 30])
        torch.testing.assert_close(scene.slot_points(rows, rows), scene.table.facts["xyz"][rows] + offset[rows])


def test_a_view_that_sees_nothing():
    scene = start_graph()
    decoded = scene(CAMERA, 1, Mode.TRAIN, lambda means, scales, camera: torch.zeros(len(means), dtype=torch.bool))
    assert len(decoded.gaussians) == len(decoded.rows) == 0 and decoded.raw_opacity.shape == (0, 1)


def test_the_graph_is_made_again_when_rows_change_and_only_then():
    scene = start_graph(torch.float32)
    first = scene.graph()
    scene.table.params["feature"].data.add_(1)
    assert scene.graph() is first
    scene.table.append(scene.new_rows(torch.tensor([[0, 0, 100]]), 0.8, torch.ones(1, 32)))
    grown = scene.graph()
    assert len(grown.index) == len(first.index) + 1
    scene.table.keep(torch.arange(len(scene.table)) != 4)
    again = Graph.of(scene.table.facts["xyz"].clone(), 10)
    assert torch.equal(scene.graph().index, again.index) and torch.equal(scene.graph().closeness, again.closeness)


def test_the_graph_moves_with_the_scene_and_is_kept_if_no_position_changes(monkeypatch):
    scene = start_graph(torch.float32)
    first, built = scene.graph(), []
    monkeypatch.setattr(Graph, "of", classmethod(lambda cls, xyz, k: built.append(len(xyz)) or first))
    scene.to("cpu")
    scene.table.append(scene.new_rows(torch.zeros(0, 3, dtype=torch.int64), 0.8, torch.zeros(0, 32)))
    assert torch.equal(scene.graph().index, first.index) and scene.graph() is scene.graph() and not built
    scene.to("meta")
    assert scene.graph().index.device.type == scene.graph().closeness.device.type == "meta" and not built
    again = start_graph(torch.float32)
    built.clear()
    again.double()
    assert again.graph() is first and built == [len(again.table)], "other distances"


@pytest.mark.parametrize("seed", range(6))
def test_whatever_the_seed_something_is_drawn_at_first(seed):
    torch.manual_seed(seed)
    scene = RECIPES["sags"][1].scene.start(cloud(), 5.0, [CAMERA])
    raw = scene(CAMERA, 1, Mode.TRAIN, everyone).raw_opacity
    assert raw is not None and float(raw.detach().mean()) > 0
    turned = copy.deepcopy(scene)
    turned.heads["opacity"].layers[-1].data.neg_()
    turned.face([CAMERA])
    assert all(torch.equal(a, b) for a, b in zip(scene.parameters(), turned.parameters()))


def test_settings_that_cannot_be():
    for changes, flag in (
        ({"F": 0}, "F"),
        ({"low": 0}, "low"),
        ({"voxel_size": -1.0}, "voxel-size"),
        ({"offset_hidden": 0}, "offset-hidden"),
    ):
        with pytest.raises(InputError, match=naming(f"--scene.{flag}")):
            check_fields(GraphPoints(**changes), "scene")
