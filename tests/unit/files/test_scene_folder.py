"""What a written result folder says of the capture. The folders themselves: test_export.py and the tests of each family."""

import pytest

from scene_experts.data.settings import Data
from scene_experts.files.scene_folder import capture_settings, width_in


def test_the_reading_of_a_capture_in_the_published_settings(tmp_path):
    plain = {"images": "images", "resolution": -1, "white_background": False, "data_device": "cuda", "eval": True, "lod": 0}
    assert capture_settings(Data(tmp_path)) == {"source_path": str(tmp_path), **plain}
    for change, expected in (
        ({"resolution": "as-is"}, {"resolution": 1}),
        ({"resolution": "factor:4"}, {"resolution": 4}),
        ({"resolution": "factor:2.5"}, {}),  # only the photographs tell the width
        ({"resolution": "longest:400"}, {}),
        ({"resolution": "inria:4"}, {"images": "images_4"}),
        ({"images": "images_2"}, {"images": "images_2"}),
        ({"split": "none"}, {"eval": False}),
        ({"split": "first:31"}, {"lod": 30}),
        ({"split": "first:1"}, {}),
        ({"background": (1.0, 1.0, 1.0)}, {"white_background": True}),
    ):
        assert capture_settings(Data(tmp_path, **change)) == {"source_path": str(tmp_path), **plain, **expected}, change
    for policy, expected in (
        ("longest:400", 300),  # 300 x 400 px: the published tools take a width
        ("factor:2.5", 300),
        ("share:0.5", 300),
        ("factor:4", 4),
        ("cap1600", -1),
        ("inria:4", -1),
        ("as-is", 1),
    ):
        assert capture_settings(Data(tmp_path, resolution=policy), 300)["resolution"] == expected, policy
    (tmp_path / "transforms_train.json").touch()
    assert capture_settings(Data(tmp_path))["white_background"]
    assert not capture_settings(Data(tmp_path, background=(0.0, 0.0, 0.0)))["white_background"]


@pytest.mark.parametrize(
    ("text", "width"),
    [('[{"width": 300}, {"width": 400}]', 300), ("[]", None), ("{}", None), ("[1]", None), ('[{"width": "x"}]', None), ("[", None)],
)
def test_the_width_of_the_first_view(tmp_path, text, width):
    (tmp_path / "cameras.json").write_text(text)
    assert width_in(tmp_path / "cameras.json") == width
