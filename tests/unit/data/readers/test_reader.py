"""Every built-in reader returns the same kind of value."""

import numpy as np

from scene_experts.data.readers import ReadOptions, find_reader
from support.synthetic import make_blender, make_capture, make_nerfstudio


def test_three_readers_return_one_kind_of_value(tmp_path):
    make_capture(tmp_path / "a", views=3, size=(24, 16), points=20)
    make_nerfstudio(tmp_path / "b", views=3, size=(24, 16), points=20)
    make_blender(tmp_path / "c", views=3, size=16)
    readers = [find_reader(tmp_path / name) for name in "abc"]
    assert [reader and reader.name for reader in readers] == ["colmap", "nerfstudio", "blender"]
    a, b, c = (reader.read(tmp_path / name, ReadOptions()) for name, reader in zip("abc", readers) if reader)
    for raw in (a, b, c):
        assert len(raw.images) == 3 and all(v.path.is_file() and v.world_to_cam.shape == (4, 4) for v in raw.images)
        assert all((v.lens is None) == (v.angle > 0) for v in raw.images), "a lens, or a field of view in its place"
    for v, w in zip(a.images, b.images):
        np.testing.assert_allclose(v.world_to_cam, w.world_to_cam, atol=1e-9)
        assert v.lens == w.lens
    assert sorted(v.test for v in c.images) == [False, False, True] and not any(v.test for v in a.images)
    assert a.alpha_over is None and b.alpha_over is None and c.alpha_over == (1.0, 1.0, 1.0), "alpha: a mask, or composited over white"
    assert a.points is not None and b.points is not None and c.points is None
    assert c.states_split and c.bounds is not None and not a.states_split and a.bounds is None
