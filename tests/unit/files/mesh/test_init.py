"""The format of meshes without its libraries."""

import importlib.util

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files import mesh


def test_a_missing_library_is_named_with_the_way_to_it(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "skimage" else find(name, *rest))
    with pytest.raises(InputError, match="scikit-image and trimesh: pip install"):
        mesh.expect_libraries()
