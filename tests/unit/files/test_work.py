"""Where files go."""

from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.registry import format_named
from scene_experts.files.work import file_path
from support.messages import naming


def test_the_name_of_a_file_may_not_say_another_format(tmp_path):
    ply, compressed = format_named("ply"), format_named("compressed-ply")
    assert file_path(tmp_path, "ply", ply, None) == tmp_path / "scene.ply" == file_path(Path("run"), "ply", ply, tmp_path)
    assert file_path(tmp_path, "ply", ply, tmp_path / "a.bin") == tmp_path / "a.bin"
    for name in ("a.PLY", "a.compressed.ply"):
        assert file_path(tmp_path, "compressed-ply", compressed, tmp_path / name) == tmp_path / name
    for name in ("a.spz", "a.compressed.ply"):
        with pytest.raises(InputError, match=naming(name, ".ply")):
            file_path(tmp_path, "ply", ply, tmp_path / name)
