"""Result folders: iterations, descriptions, worlds; cfg_args is read as literals, and nothing in it is evaluated."""

import json
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.files.result_folder import (
    drawn_as,
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


def test_a_capture_is_read_as_the_training_read_it_unless_others_are_asked_for():
    about = {"data": {"resolution": "longest:800", "background": [0.5, 0.4, 0.3], "near": 1.5, "split": "none"}}
    found = drawn_as(Data(Path("x"), near=0.1), about)
    assert found == Data(Path("x"), resolution="longest:800", background=(0.5, 0.4, 0.3), near=0.1)
    assert drawn_as(Data(Path("x")), {}) == Data(Path("x"))
