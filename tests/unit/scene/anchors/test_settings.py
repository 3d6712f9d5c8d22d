"""Settings of scenes of anchors."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.scene.anchors.select import Octree
from support.messages import naming


def test_a_share_of_one_is_refused():
    with pytest.raises(InputError, match=naming("--scene.dropout")):
        check_fields(Anchors(dropout=1.0), "scene")


def test_dropout_and_jitter_depend_on_the_number_of_views():
    made = Anchors(dropout=0.2, view_jitter=0.5, few_views=20)
    assert made.of_views(20) == made and made.of_views(10) == made
    assert made.of_views(30) == Anchors(dropout=0.1, view_jitter=0.25) and made.of_views(40) == Anchors()


def test_columns_have_the_sizes_of_the_settings():
    shapes = Anchors(K=4, F=8).shapes()
    assert shapes["params.feature"] == (8,) and shapes["params.offsets"] == (4, 3) and "facts.level" not in shapes
    assert "facts.level" in Anchors(select=Octree()).shapes()
