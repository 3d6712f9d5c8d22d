"""Scenes of anchors in the capture's own frame, their description, and the Scaffold-GS result folder."""

import json
import math

import pytest
import torch
from plyfile import PlyData
from safetensors import safe_open

from scene_experts.core.errors import RunError
from scene_experts.core.io import write_json
from scene_experts.data.views import World
from scene_experts.files.anchors import FAMILY, torchscript, write
from scene_experts.files.anchors.data import by_attribute
from scene_experts.files.anchors.read import read_folder, tensors_of
from support.files import run_in_memory
from support.messages import naming

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
WORLD = World(scale=2.5, shift=(1.0, 0.1 + 0.2, -3.0))
RECIPES = ["scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-balance", "scaffold-gs-bank", "octree-gs", "octree-moe-gs"]


def contents(run):
    return write.contents(run, WORLD, FAMILY.describe(run, WORLD) | {"train": 1, "data": 2})


def folder_of(run, out):
    folder, about = out / "point_cloud" / f"iteration_{run.step}", FAMILY.describe(run, WORLD) | {"train": 1, "data": 2}
    settings = FAMILY.write(run, WORLD, folder, about)
    write_json(folder / "scene.json", about)
    (out / "cfg_args").write_text(f"Namespace({', '.join(f'{k}={v!r}' for k, v in settings.items())})")
    return folder


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_folder_there_and_back(recipe, tmp_path):
    run = run_in_memory(recipe)
    folder, wanted = folder_of(run, tmp_path), contents(run)
    found = read_folder(folder)
    assert found.columns.keys() == wanted.columns.keys() and found.networks.keys() == wanted.networks.keys()
    assert all(torch.equal(found.columns[name], value) for name, value in wanted.columns.items())
    assert all(torch.equal(found.networks[name], value) for name, value in wanted.networks.items())
    assert found.about == json.loads(json.dumps(wanted.about)) and found.step == run.step
    assert found.add_dist == wanted.add_dist and found.settings["n_offsets"] == run.scene.K
    if "octree" not in recipe:
        assert torch.equal(found.cells, wanted.cells) and found.voxel == pytest.approx(wanted.voxel, rel=1e-12)
    names = {p.name for p in folder.iterdir()}
    experts = recipe.startswith(("moe", "octree-moe"))
    assert names >= ({"moe.safetensors"} if experts else set(torchscript.FILES.values())) and "point_cloud.ply" in names
    assert PlyData.read(folder / "point_cloud.ply")["vertex"].count == len(run.scene.positions)


@pytest.mark.parametrize("K", [1, 10, 16, 37])
def test_masks_of_slots_as_numbers_and_back(K):
    slots = torch.rand(50, K, generator=torch.Generator().manual_seed(0)) < 0.5
    numbers = write.pack_slots(slots)
    assert numbers.shape == (50, -(-K // 16)) and numbers.max() < 2**16
    assert torch.equal(write.unpack_slots(numbers, K), slots)


def test_masked_slots_and_the_smoothing_filter_are_in_the_folder(tmp_path):
    run = run_in_memory("moe-gs")
    slots = torch.rand(len(run.scene.positions), run.scene.K, generator=torch.Generator().manual_seed(0)) < 0.5
    intervals = torch.rand(len(slots), generator=torch.Generator().manual_seed(1))
    run.scene.table.facts |= {"slots": slots, "interval": intervals}
    found = read_folder(folder_of(run, tmp_path))
    assert torch.equal(found.columns["slots"], slots)
    torch.testing.assert_close(found.columns["interval"], intervals / 2.5)
    tensors = tensors_of(found, by_attribute(found.networks), WORLD, run.scene.voxel)
    assert torch.equal(tensors["facts.slots"], slots)
    torch.testing.assert_close(tensors["facts.interval"], intervals)


def test_positions_move_lengths_scale_and_networks_see_the_files_distances():
    run = run_in_memory("moe-gs-dist")
    found, p = contents(run), run.scene.table.params
    torch.testing.assert_close(found.columns["xyz"], WORLD.to_input(run.scene.positions.double()).float())
    torch.testing.assert_close(found.columns["log_scaling"], p["log_scaling"].detach() - math.log(2.5))
    assert torch.equal(found.columns["offsets"], p["offsets"]) and found.add_dist == run.scene.config.add_dist
    feature = run.scene.config.F
    x = torch.randn(5, feature + 4)
    y = x.clone()
    y[:, feature + 3] *= 2.5  # the same distance in the trained unit
    own = run.scene.network_tensors()
    for attribute in ("opacity", "cov", "color"):
        seen = y if attribute in found.add_dist else x[:, : feature + 3]
        there = x if attribute in found.add_dist else x[:, : feature + 3]
        torch.testing.assert_close(there @ found.networks[f"{attribute}.experts.w1"][0].T, seen @ own[f"{attribute}.w1"][0].T)
    bank = run_in_memory("scaffold-gs-bank")
    x, y = torch.randn(5, 4), torch.ones(4)
    y[3] = 2.5
    w1 = write.networks(bank.scene, 2.5)["feature_bank.experts.w1"]
    torch.testing.assert_close(x @ w1[0].T, (x * y) @ bank.scene.bank.w1[0].T)


def test_the_description_says_experts_phases_and_the_world():
    dense, sparse = (FAMILY.describe(run_in_memory("moe-gs", step), WORLD) for step in (1, 30_000))
    assert sparse["E"] == dict.fromkeys(("opacity", "cov", "color"), 5) and set(sparse["k"].values()) == {2}
    assert set(sparse["phase"].values()) == {"sparse"} and set(dense["phase"].values()) == {"dense"} and set(dense["k"].values()) == {None}
    assert sparse["world"] == {"scale": 2.5, "shift": [1.0, 0.1 + 0.2, -3.0]}
    assert sparse["voxel_size"]["input"] == sparse["voxel_size"]["trained"] / 2.5
    single = FAMILY.describe(run_in_memory("scaffold-gs"), WORLD)
    assert set(single["phase"].values()) == {"single"} and "nowhere" not in json.dumps(single)


def test_levels_have_columns_and_a_lattice_each():
    run = run_in_memory("octree-gs")
    found, levels = contents(run), run.scene.select.lattices
    assert torch.equal(found.cells, run.scene.table.facts["cell"])
    edges = torch.tensor(found.edges, dtype=torch.float64)[found.columns["level"]]
    places = found.cells.double() * edges[:, None] + torch.tensor(found.origin, dtype=torch.float64)
    torch.testing.assert_close(places.float(), found.columns["xyz"])
    assert found.columns["info"][:3].tolist() == pytest.approx([levels.edge / 2.5, levels.standard / 2.5, 0.0])
    assert torch.equal(found.columns["level"], run.scene.table.facts["level"])
    assert "level" in write.vertices(found) and "nx" not in write.vertices(found)


def test_anchors_off_their_cells_are_on_no_lattice():
    run = run_in_memory("moe-gs")
    assert contents(run).cells is not None
    run.scene.table.facts["xyz"] = run.scene.positions + 0.4 * run.scene.voxel
    assert contents(run).cells is None
    assert write.is_on_lattice(torch.zeros(0, 3), torch.zeros(0, 3), 1.0)


def test_names_and_sizes_in_the_file_of_experts(tmp_path):
    folder = folder_of(run_in_memory("moe-gs"), tmp_path)
    with safe_open(folder / "moe.safetensors", "pt") as file:
        names = ["router.weight", "router.bias", "experts.w1", "experts.b1", "experts.w2", "experts.b2"]
        assert set(file.keys()) == {f"{a}.{n}" for a in ("opacity", "cov", "color") for n in names}
        assert sum(file.get_tensor(name).numel() for name in file.keys()) == 35_925  # noqa: SIM118


def test_an_earlier_export_leaves_nothing_behind(tmp_path):
    folder_of(run_in_memory("moe-gs"), tmp_path)
    folder = folder_of(run_in_memory("scaffold-gs-bank"), tmp_path)
    assert not (folder / "moe.safetensors").exists() and (folder / "feature_bank_mlp.pt").is_file()
    folder = folder_of(run_in_memory("scaffold-gs"), tmp_path)
    assert not (folder / "feature_bank_mlp.pt").exists() and (folder / "color_mlp.pt").is_file()
    assert write.is_plain(read_folder(folder).networks) and not write.is_plain(write.networks(run_in_memory("moe-gs").scene, 1.0))


def test_single_networks_of_another_form_give_a_warning(monkeypatch):
    run = run_in_memory("scaffold-gs")
    assert FAMILY.warnings(run) == [] == FAMILY.warnings(run_in_memory("moe-gs"))
    kind = type(run.scene.heads["color"])
    forward = kind.forward
    monkeypatch.setattr(kind, "forward", lambda self, *given: (forward(self, *given)[0] * (0.9 if self.attribute == "color" else 1), None))
    (line,) = FAMILY.warnings(run)
    assert "color" in line and "opacity" not in line and "scaffold-gs" in line


def test_masks_give_a_warning_only_where_they_hide_something():
    run = run_in_memory("scaffold-gs")
    slots = torch.ones(len(run.scene.positions), run.scene.K, dtype=torch.bool)
    run.scene.table.facts["slots"] = slots
    assert FAMILY.warnings(run) == []
    slots[1, 2] = slots[3, 0] = False
    (line,) = FAMILY.warnings(run)
    assert "also draw the Gaussians that this scene hides (2);" in line


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "point_cloud").write_text("a file")
    with pytest.raises(RunError, match=naming("point_cloud.ply")):
        folder_of(run_in_memory("scaffold-gs"), tmp_path)


def test_networks_by_attribute_are_what_the_scene_computes_with():
    found = by_attribute(write.networks(run_in_memory("moe-gs").scene, 1.0))
    assert found["cov"].keys() == {"w1", "b1", "w2", "b2", "router_w", "router_b"}
