"""Levels, feature banks and codes to files and back; whole folders are in test_export_run.py and test_export_incoming.py."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.extras import (
    extra_networks,
    level_columns,
    level_facts,
    levels_in,
    published_levels,
    rescaled,
    trained_names,
)
from support.messages import naming
from support.scenes import start_scene


def test_the_distance_of_a_feature_bank_changes_its_unit_and_back():
    scene = start_scene("scaffold-gs-bank")
    files = extra_networks(scene, 4.0)
    assert files.keys() == {"feature_bank"}
    x = torch.randn(5, 4)
    y = x.clone()
    y[:, 3] *= 4.0  # the same distance in the trained unit
    torch.testing.assert_close(x @ files["feature_bank"]["w1"][0].T, y @ scene.mix.w1[0].T)
    back = trained_names({**files, "color": {}}, 4.0)
    assert back.keys() == {"mix", "color"}
    torch.testing.assert_close(back["mix"]["w1"], scene.mix.w1.detach())
    assert extra_networks(start_scene("scaffold-gs"), 4.0) == {} == trained_names({}, 4.0)
    assert torch.equal(rescaled(files["feature_bank"], 1.0)["w1"], files["feature_bank"]["w1"])


def test_levels_to_columns_and_back():
    scene = start_scene("octree-gs")
    levels, facts = scene.select.lattices, scene.table.facts
    columns = level_columns(scene, 2.0)
    assert columns["info"][:2].tolist() == pytest.approx([levels.edge / 2, levels.standard / 2])
    assert level_columns(start_scene("scaffold-gs"), 2.0) == {}
    again = level_facts(levels_in(scene.meta()), {"xyz": facts["xyz"] + 1e-6, **columns}, exact=True)
    assert all(torch.equal(again[name], facts[name]) for name in ("cell", "xyz", "level", "extra_level"))
    assert not torch.equal(level_facts(levels, {"xyz": facts["xyz"] + 1e-6, **columns}, exact=False)["xyz"], facts["xyz"])
    assert levels_in({"voxel": 1.0}) is None


def test_published_files_must_say_what_the_levels_are():
    anchors = {"level": torch.tensor([1, 0, 2]), "xyz": torch.arange(9.0).reshape(3, 3), "info": torch.tensor([0.5, 8.0, 0.0])}
    found = published_levels(anchors, [])
    assert (found.count, found.edge, found.standard, found.origin) == (3, 0.5, 8.0, (3.0, 4.0, 5.0))
    with pytest.raises(InputError, match="info"):
        published_levels({**anchors, "info": torch.zeros(3)}, [])
    for rule, ours in (("floor", "floor"), ("ceil", "ceil"), ("progressive", "blend")):
        found = published_levels(anchors, [], {"fork": 3, "dist2level": rule})
        assert (found.fork, found.rule) == (3, ours)
    for cfg in ({"fork": 1}, {"fork": "2"}, {"dist2level": "nearest"}, {"dist2level": [1]}):
        with pytest.raises(InputError, match="cfg_args"):
            published_levels(anchors, [], cfg)


def test_a_bank_of_other_inputs_is_refused():
    with pytest.raises(InputError, match=naming(4, 3)):
        rescaled({"w1": torch.zeros(1, 32, 3)}, 2.0)
