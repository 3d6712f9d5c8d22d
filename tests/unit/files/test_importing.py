"""Files to runs: who reads what, and that a run folder is whole or not there. What each family reads is tested with the family."""

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.files.anchors import FAMILY as ANCHORS
from scene_experts.files.formats.ply import write_vertices
from scene_experts.files.gaussians import FAMILY as GAUSSIANS
from scene_experts.files.importing import import_files, owner
from scene_experts.files.registry import format_named
from support import foreign
from support.messages import naming
from support.splats import splats


def test_a_file_belongs_to_the_family_of_its_format(tmp_path):
    format_named("spz").write(tmp_path / "a", splats(), {})
    assert owner(tmp_path / "a", None) == (GAUSSIANS, tmp_path / "a")
    (tmp_path / "a.compact").write_bytes(b"anything")
    assert owner(tmp_path / "a.compact", None)[0] is ANCHORS


def test_a_result_folder_belongs_to_the_family_of_its_columns(tmp_path):
    place = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    for column, family, found in (("f_dc_0", GAUSSIANS, place), ("f_offset_0", ANCHORS, place.parent)):
        write_vertices(place, {name: np.zeros(2, np.float32) for name in ("x", column)})
        assert owner(tmp_path, None) == (family, found) == owner(place.parent, None)
    write_vertices(place, {name: np.zeros(2, np.float32) for name in ("x", "weight")})
    with pytest.raises(InputError, match=naming("point_cloud.ply", "x, weight")):
        owner(tmp_path, None)
    with pytest.raises(InputError, match=naming(8, 7)):
        owner(tmp_path, 8)


def test_nothing_is_written_for_a_source_that_cannot_be_read(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").write_text("x")
    for source in ("absent", "empty", "text"):
        with pytest.raises(InputError, match=source):
            import_files(tmp_path / source, Data(tmp_path), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_folder_of_sog_belongs_to_its_description(tmp_path):
    foreign.folder(tmp_path / "a", foreign.sogs_1(foreign.gaussians(30)))
    assert owner(tmp_path / "a", None) == (GAUSSIANS, tmp_path / "a" / "meta.json")
    with pytest.raises(InputError, match=naming(tmp_path)):
        owner(tmp_path, None)
