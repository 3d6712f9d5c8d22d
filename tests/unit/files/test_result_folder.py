"""Result folders: iterations, descriptions, worlds; cfg_args is read as literals, and nothing in it is evaluated."""

import json

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files.export import capture_settings, width_in
from scene_experts.files.result_folder import (
    expect_world,
    is_result,
    iteration_folder,
    iteration_of,
    positive,
    read_description,
    read_settings,
    world_in,
)
from support.messages import naming


def iteration(root, number=1):
    folder = root / "point_cloud" / f"iteration_{number}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def test_literals_come_back_and_the_rest_is_left_out(tmp_path):
    path = tmp_path / "cfg_args"
    path.write_text(
        "Namespace(voxel_size=0.001, appearance_dim=0, eval=True, name='a\\'b', list=[1, -2.5, None], pair=(1, 2), "
        "device=device(type='cuda'), "
        "root=PosixPath('/x'), nan=nan, call=__import__('os').system('touch witness'))\n"
    )
    assert read_settings(iteration(tmp_path)) == {
        "voxel_size": 0.001,
        "appearance_dim": 0,
        "eval": True,
        "name": "a'b",
        "list": [1, -2.5, None],
        "pair": (1, 2),
    }


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "Namespace",
        "Namespace(1)",
        "dict(a=1)",
        "os.system('x')",
        "Namespace(a=1); x",
        "Namespace(a=",
        "\0",
        "(" * 5000,
        "a" * (1 << 21),
    ],
)
def test_other_texts(tmp_path, text):
    (tmp_path / "cfg_args").write_text(text)
    with pytest.raises(InputError, match="cfg_args"):
        read_settings(iteration(tmp_path))


def test_other_bytes(tmp_path):
    (tmp_path / "cfg_args").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="cfg_args"):
        read_settings(iteration(tmp_path))


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


def test_no_settings(tmp_path):
    assert read_settings(iteration(tmp_path)) == {}
    assert [positive(value) for value in (2, 0.5, "2", None, float("nan"), float("inf"), -1)] == [2.0, 0.5, *[None] * 5]


def test_the_newest_or_a_given_iteration(tmp_path):
    assert not is_result(tmp_path)
    with pytest.raises(InputError, match=naming("point_cloud.ply", tmp_path)):
        iteration_folder(tmp_path)
    for step in (7000, 30_000, 999):
        (iteration(tmp_path, step) / "point_cloud.ply").touch()
    iteration(tmp_path, 40_000)  # without a scene
    assert is_result(tmp_path) and iteration_folder(tmp_path).name == "iteration_30000"
    assert iteration_folder(tmp_path, 999).name == "iteration_999" == iteration_folder(iteration(tmp_path, 999)).name
    assert iteration_of(iteration(tmp_path, 999)) == 999 and iteration_of(tmp_path) is None
    with pytest.raises(InputError, match=naming(5, "999, 7000, 30000")):
        iteration_folder(tmp_path, 5)


def test_damaged_descriptions(tmp_path):
    folder = iteration(tmp_path)
    assert read_description(folder) is None
    about = {"format": 1, "recipe": "x", "K": 1, "F": 2, "step": 30, "voxel_size": {"trained": 0.1, "input": 0.04}}
    about |= {"world": {"scale": 2.5, "shift": [1, 2, 3]}}
    (folder / "scene.json").write_text(json.dumps(about))
    assert read_description(folder) == about and world_in(about) == World(2.5, (1.0, 2.0, 3.0))
    changes = (
        ({"format": 9}, "9"),
        ({"world": {"scale": 0, "shift": [1, 2, 3]}}, "world"),
        ({"world": 3}, "world"),
        ({"voxel_size": {"trained": None, "input": 1}}, "voxel_size"),
        ({"step": "x"}, "step"),
        ({"extent": None, "scene": {}}, "extent"),
        ({"scene": 3}, "scene description"),
    )
    for change, fact in changes:
        (folder / "scene.json").write_text(json.dumps(about | change))
        with pytest.raises(InputError, match=naming("scene.json", fact)):
            read_description(folder)
    for text, fact in (("[]", "1"), ('{"wor', "JSON"), ('{"format": 1}', "F, K, recipe, voxel_size, world")):
        (folder / "scene.json").write_text(text)
        with pytest.raises(InputError, match=naming("scene.json", fact)):
            read_description(folder)


def test_another_world_is_refused():
    world = World(2.5, (1.0, -20.0, 3.0))
    expect_world(world, World(2.5 * (1 + 1e-6), (1.0, -20.0001, 3.0)))
    for other in (World(2.6, world.shift), World(2.5, (1.01, -20.0, 3.0))):
        with pytest.raises(InputError, match="--normalise"):
            expect_world(world, other)


@pytest.mark.parametrize(
    ("text", "width"),
    [('[{"width": 300}, {"width": 400}]', 300), ("[]", None), ("{}", None), ("[1]", None), ('[{"width": "x"}]', None), ("[", None)],
)
def test_the_width_of_the_first_view(tmp_path, text, width):
    (tmp_path / "cameras.json").write_text(text)
    assert width_in(tmp_path / "cameras.json") == width
