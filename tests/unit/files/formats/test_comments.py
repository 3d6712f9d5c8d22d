"""Notes in PLY headers come back and break no reader."""

import numpy as np
from plyfile import PlyData

from scene_experts.files.formats.comments import note_comments, read_note
from scene_experts.files.ply import read_vertices, write_vertices


def test_a_note_comes_back_and_readers_skip_it(tmp_path):
    note = {"recipe": "moe-gs", "psnr": 21.5, "words": "é\nend_header\n", "list": [1, None, True]}
    lines = note_comments(note)
    assert len(lines) == 1 and lines[0].isascii() and "\n" not in lines[0]
    assert note_comments({}) == []
    path = tmp_path / "a.ply"
    write_vertices(path, {"x": np.arange(3, dtype=np.float32)}, note_comments(note | {"words": "é"}))
    assert read_note(path) == note | {"words": "é"}
    assert read_vertices(path)["x"].tolist() == [0, 1, 2] and PlyData.read(path)["vertex"].count == 3
    write_vertices(path, {"x": np.arange(3, dtype=np.float32)}, note_comments(note))
    assert read_vertices(path)["x"].tolist() == [0, 1, 2] and read_note(path) == note


def test_no_note_a_foreign_one_and_a_long_one(tmp_path):
    path = tmp_path / "a.ply"
    write_vertices(path, {"x": np.zeros(1, np.float32)}, ["made by hand"])
    assert read_note(path) == {}
    write_vertices(path, {"x": np.zeros(1, np.float32)}, ["scene-experts {broken"])
    assert read_note(path) == {}
    write_vertices(path, {"x": np.zeros(1, np.float32)}, ["scene-experts [1]"])
    assert read_note(path) == {}
    (line,) = note_comments({"psnr": 1.0, "figures": list(range(100_000))})
    assert line == 'scene-experts {"psnr": 1.0}'
