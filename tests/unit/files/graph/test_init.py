"""The family's object leads to its writers; there is no format beside the result folder."""

import json

import pytest

from scene_experts.data.views import World
from scene_experts.files.graph import FAMILY
from scene_experts.files.registry import family_named, formats_of
from support.files import run_in_memory


def test_the_description_is_plain_json():
    run = run_in_memory("sags")
    about = FAMILY.describe(run, World(2.0, (1.0, 0.0, 0.0)))
    assert json.loads(json.dumps(about)) == about and about["grid"]["edge"] == run.scene.grid.edge / 2
    assert family_named("graph") is FAMILY and FAMILY.warnings(run) == [] and formats_of("graph") == {}
    with pytest.raises(NotImplementedError):
        FAMILY.scene(run, None, World())
