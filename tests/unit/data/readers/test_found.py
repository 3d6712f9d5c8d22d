"""Every reader hands over the same kind of value, in the terms that `load` decides by."""

import numpy as np

from scene_experts.data.capture import _read_colmap
from scene_experts.data.readers.transforms import read_blender, read_nerfstudio
from support.synthetic import make_blender, make_capture, make_nerfstudio


def test_three_readers_one_value(tmp_path):
    make_capture(tmp_path / "a", views=3, size=(24, 16), points=20)
    make_nerfstudio(tmp_path / "b", views=3, size=(24, 16), points=20)
    make_blender(tmp_path / "c", views=3, size=16)
    a, b, c = _read_colmap(tmp_path / "a", "images", "error"), read_nerfstudio(tmp_path / "b", None), read_blender(tmp_path / "c", None)
    assert [f.kind for f in (a, b, c)] == ["colmap", "nerfstudio", "blender"]
    for found in (a, b, c):
        assert len(found.posed) == 3 and all(v.path.is_file() and v.world_to_cam.shape == (4, 4) for v in found.posed)
        assert all((v.lens is None) == (v.angle > 0) for v in found.posed), "a lens, or an angle of view in its place"
    for v, w in zip(a.posed, b.posed):
        np.testing.assert_allclose(v.world_to_cam, w.world_to_cam, atol=1e-9)
        assert v.lens == w.lens
    assert [v.test for v in sorted(c.posed, key=lambda v: v.name)].count(True) == 1 and not any(v.test for v in a.posed)
    assert a.over is None and b.over is None and c.over == (1.0, 1.0, 1.0), "alpha: a mask, or composited over white"
    assert a.points is not None and b.points is not None and c.points is None and "points3D" in a.points_from and ".ply" in c.points_from
