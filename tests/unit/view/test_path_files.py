"""Path files: round trips in the capture's own frame, nerfstudio's format, damaged files."""

import json
import math

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.transform import Similarity
from scene_experts.data.views import World
from scene_experts.geometry.poses import look_at, with_fov
from scene_experts.geometry.rotation import quat_to_matrix
from scene_experts.view import path_files
from scene_experts.view.paths import CameraPath
from support.messages import naming
from support.scenes import CAMERA

WORLD = World(2.5, (1.0, -2.0, 0.5))


def path(frames=5) -> CameraPath:
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    made = []
    for i in range(frames):
        place = torch.tensor([math.sin(i / 3), 0.2 * i, -3.0], dtype=torch.float64)
        camera = with_fov(CAMERA, math.radians(50 + i), 64, 48)
        made.append(type(camera)(look_at(place, torch.zeros(3, dtype=torch.float64), up).float(), camera.K, 64, 48, camera.near, i))
    return CameraPath(tuple(made), 10.0)


@pytest.mark.parametrize("write", [path_files.write_path, path_files.write_nerfstudio])
def test_a_path_survives_a_round_trip(write, tmp_path):
    made = path()
    write(tmp_path / "p.json", made, WORLD)
    back = path_files.read_path(tmp_path / "p.json", WORLD, CAMERA)
    assert len(back) == 5 and back.fps == 10.0
    for a, b in zip(made.cameras, back.cameras):
        assert torch.allclose(a.world_to_cam, b.world_to_cam, atol=1e-5) and torch.allclose(a.K, b.K, atol=1e-3)
        assert (a.width, a.height, -1) == (b.width, b.height, b.id)


def test_the_file_is_in_the_captures_frame_and_nerfstudios_axes_point_up_and_back(tmp_path):
    made = path(1)
    path_files.write_path(tmp_path / "a.json", made, WORLD)
    path_files.write_nerfstudio(tmp_path / "b.json", made, WORLD)
    ours = torch.tensor(json.loads((tmp_path / "a.json").read_text())["keyframes"][0]["camera_to_world"])
    theirs = torch.tensor(json.loads((tmp_path / "b.json").read_text())["camera_path"][0]["camera_to_world"]).reshape(4, 4)
    place = torch.tensor([0.0, 0.0, -3.0]) / 2.5 - torch.tensor([1.0, -2.0, 0.5])
    assert torch.allclose(ours[:3, 3], place, atol=1e-6) and torch.allclose(theirs[:3, 3], place, atol=1e-6)
    assert torch.allclose(theirs[:3, 2], -ours[:3, 2]) and torch.allclose(theirs[:3, 1], -ours[:3, 1])


def test_a_path_of_nerfstudios_own_frame_comes_back_by_its_transform(tmp_path, caplog):
    made = path(2)
    path_files.write_nerfstudio(tmp_path / "p.json", made, WORLD)
    path_files.read_path(tmp_path / "p.json", WORLD, CAMERA)
    assert not caplog.text  # we wrote it
    turn = quat_to_matrix(torch.tensor([[0.8, 0.0, 0.6, 0.0]], dtype=torch.float64))[0]
    theirs = Similarity(turn, torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64), 0.4)
    value = json.loads((tmp_path / "p.json").read_text())
    del value["frame"]
    for entry in value["camera_path"]:
        pose = torch.tensor(entry["camera_to_world"], dtype=torch.float64).reshape(4, 4)
        pose[:3, 3] = theirs.scale * theirs.rotation @ pose[:3, 3] + theirs.shift
        pose[:3, :3] = theirs.rotation @ pose[:3, :3]
        entry["camera_to_world"] = pose.flatten().tolist()
    (tmp_path / "p.json").write_text(json.dumps(value))
    back = path_files.read_path(tmp_path / "p.json", WORLD, CAMERA, moved=theirs.inverse)
    assert all(torch.allclose(a.world_to_cam, b.world_to_cam, atol=1e-5) for a, b in zip(made.cameras, back.cameras)) and not caplog.text
    path_files.read_path(tmp_path / "p.json", WORLD, CAMERA)
    assert "--transform" in caplog.text
    path_files.write_path(tmp_path / "ours.json", made, WORLD)
    with pytest.raises(InputError, match="--transform"):
        path_files.read_path(tmp_path / "ours.json", WORLD, CAMERA, moved=theirs)


def test_between_keyframes_the_camera_moves_and_size_and_speed_can_be_others(tmp_path):
    path_files.write_path(tmp_path / "p.json", path(3), World())
    back = path_files.read_path(tmp_path / "p.json", World(), CAMERA, size=(32, 24), fps=40.0)
    assert len(back) == 9 and back.fps == 40.0 and (back.cameras[0].width, back.cameras[0].height) == (32, 24)
    assert math.degrees(back.cameras[2].fov) == pytest.approx(50.5, abs=1e-3)
    path_files.write_path(tmp_path / "p.json", path(3), World(), loop=True)
    assert len(path_files.read_path(tmp_path / "p.json", World(), CAMERA)) == 3


def test_a_loop_interpolates_the_field_of_view_back_to_the_first(tmp_path):
    path_files.write_path(tmp_path / "p.json", path(3), World(), loop=True, play_fps=20.0)  # 50, 51, 52 degrees at 0, 0.1, 0.2 s
    back = path_files.read_path(tmp_path / "p.json", World(), CAMERA)
    assert [math.degrees(camera.fov) for camera in back.cameras] == pytest.approx([50, 50.5, 51, 51.5, 52, 51], abs=1e-3)


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        (lambda v: v["keyframes"].clear(), "keyframes"),
        (lambda v: v["keyframes"][1].update(time=0.0), "time"),
        (lambda v: v["keyframes"][0].update(fov=0), "fov"),
        (lambda v: v["keyframes"][0].update(camera_to_world=[[1]]), "camera_to_world"),
        (lambda v: v["keyframes"][0]["camera_to_world"][0].__setitem__(0, 7.0), "camera_to_world"),
        (lambda v: v["keyframes"][0].pop("time"), "time"),
        (lambda v: v.update(fps=0), "fps"),
        (lambda v: v.update(fps=float("nan")), "finite"),
        (lambda v: v.update(width=0), "0 x 48"),
        (lambda v: v.update(height=10**9), "1000000000"),
        (lambda v: v.pop("format"), ""),
    ],
)
def test_damage_is_one_sentence(change, fact, tmp_path):
    path_files.write_path(tmp_path / "p.json", path(3), World())
    value = json.loads((tmp_path / "p.json").read_text())
    change(value)
    (tmp_path / "p.json").write_text(json.dumps(value))
    with pytest.raises(InputError, match=naming("p.json", fact)):
        path_files.read_path(tmp_path / "p.json", World(), CAMERA)


def test_nerfstudios_other_cameras_are_refused(tmp_path):
    path_files.write_nerfstudio(tmp_path / "p.json", path(2), World())
    value = json.loads((tmp_path / "p.json").read_text())
    (tmp_path / "p.json").write_text(json.dumps({**value, "camera_type": "fisheye"}))
    with pytest.raises(InputError, match="fisheye"):
        path_files.read_path(tmp_path / "p.json", World(), CAMERA)
    (tmp_path / "p.json").write_text(json.dumps({**value, "camera_path": []}))
    with pytest.raises(InputError, match="camera_path"):
        path_files.read_path(tmp_path / "p.json", World(), CAMERA)
    for wrong, fact in (({"fps": 0}, "fps"), ({"render_width": -5}, "-5")):
        (tmp_path / "p.json").write_text(json.dumps({**value, **wrong}))
        with pytest.raises(InputError, match=naming("p.json", fact)):
            path_files.read_path(tmp_path / "p.json", World(), CAMERA)
    assert path_files.is_path_file("x.json") and not path_files.is_path_file("orbit")
