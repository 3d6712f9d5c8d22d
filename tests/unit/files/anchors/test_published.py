"""What published results do not state: lattices, levels, recipes."""

from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.published import cells_of, levels_of, meta_of, recipe_of, recover_voxel
from scene_experts.files.placed import AROUND
from support.messages import naming


def positions(cells, voxel, origin=(0.0, 0.0, 0.0)):
    return (cells.double() * voxel + torch.tensor(origin, dtype=torch.float64)).float()


def test_cells_are_found_again_from_positions_and_other_lattices_are_not():
    cells = torch.randint(-(2**20), 2**20, (1000, 3))
    for voxel, origin in ((0.0013, (0.0, 0.0, 0.0)), (0.0013 / 2.5, (-1.0, 20.0, -0.125))):
        found = cells_of(positions(cells, voxel, origin), voxel, origin)
        assert found is not None and torch.equal(found, cells)
    assert cells_of(positions(cells, 0.0013), 0.0013 * 1.01) is None
    assert cells_of(torch.zeros(0, 3), 0.0013).shape == (0, 3)


@pytest.mark.parametrize("voxel", [0.001, 0.0173, 3.7])
def test_the_edge_of_a_lattice_is_recovered(voxel):
    cells = torch.unique(torch.randint(-300, 300, (2000, 3), generator=torch.Generator().manual_seed(0)), dim=0)
    assert recover_voxel(positions(cells, voxel)) == pytest.approx(voxel, rel=1e-6)
    assert recover_voxel(torch.randn(500, 3, generator=torch.Generator().manual_seed(1))) is None
    assert recover_voxel(torch.zeros(4, 3)) is None


def test_files_must_say_what_the_levels_are():
    anchors = {"level": torch.tensor([1, 0, 2]), "xyz": torch.arange(9.0).reshape(3, 3), "info": torch.tensor([0.5, 8.0, 0.0])}
    found = levels_of(anchors, [])
    assert (found.count, found.edge, found.standard, found.origin) == (3, 0.5, 8.0, (3.0, 4.0, 5.0))
    with pytest.raises(InputError, match="info"):
        levels_of({**anchors, "info": torch.zeros(3)}, [])
    for rule, ours in (("floor", "floor"), ("ceil", "ceil"), ("progressive", "blend")):
        found = levels_of(anchors, [], {"fork": 3, "dist2level": rule})
        assert (found.fork, found.rule) == (3, ours)
    for settings in ({"fork": 1}, {"fork": "2"}, {"dist2level": "nearest"}, {"dist2level": [1]}):
        with pytest.raises(InputError, match="cfg_args"):
            levels_of(anchors, [], settings)


def data(**columns):
    columns = {"offsets": torch.zeros(2, 4, 3), "feature": torch.zeros(2, 8), **columns}
    networks = {"opacity.experts.w1": torch.zeros(1, 16, 11), "opacity.middle.0.weight": torch.zeros(16, 16)}
    return AnchorData(columns, networks, None, voxel=0.5, add_dist=("cov",), step=70)


def test_the_recipe_has_the_numbers_of_the_files():
    found = recipe_of(data())
    assert (found.recipe, found.iterations) == ("scaffold-gs", 70)
    scene = found.scene
    assert (scene.K, scene.F, scene.hidden, scene.add_dist, scene.voxel_size, scene.decoder.depth) == (4, 8, 16, ("cov",), 0.5, 3)
    assert recipe_of(data(level=torch.zeros(2, dtype=torch.int64))).recipe == "octree-gs"


def test_codes_need_as_many_training_views():
    found = data()
    found.networks["appearance.table"] = torch.zeros(3, 4)
    assert meta_of(found, SimpleNamespace(train=(1, 2, 5), kind="colmap"))["views"] == [1, 2, 5]
    with pytest.raises(InputError, match=naming(3, 2, "--split")):
        meta_of(found, SimpleNamespace(train=(1, 2), kind="colmap"))
    assert meta_of(found, SimpleNamespace(train=(0, 1), kind=AROUND))["views"] == [0, 1, 2]  # without a capture
