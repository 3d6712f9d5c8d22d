"""Captures far from the origin, as surveys in UTM are: no export and no import loses anything."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts import cli
from scene_experts.data.readers.colmap_model import read_model, write_model
from scene_experts.data.views import World
from scene_experts.files.formats import html, ply
from support.synthetic import make_capture

UTM = np.array([448250.0, 5411932.0, 340.0])


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a capture in UTM, `far`, and a run of 3dgs and one of scaffold-gs on it."""
    room = tmp_path_factory.mktemp("room")
    made = make_capture(room / "far", views=9, size=(48, 32), points=800)
    images = []
    for image in made.model.images:
        t = np.array(image.translation) - image.world_to_cam()[:3, :3] @ UTM
        images.append(replace(image, translation=tuple(t.tolist())))
    model = read_model(room / "far/sparse/0")
    write_model(room / "far/sparse/0", replace(model, images=tuple(images), xyz=model.xyz + UTM))
    for recipe in ("3dgs", "scaffold-gs"):
        words = ["train", recipe, "--data", str(room / "far"), "--out", str(room / recipe), "--iterations", "60", "--preview-every", "0"]
        assert cli.main(words) == 0
    return room


def psnr(run: Path) -> float:
    assert cli.main(["eval", str(run), "--no-lpips"]) == 0
    return json.loads((run / "results.json").read_text())["psnr"]


@pytest.mark.parametrize("format", ["ply", "compressed-ply", "sog", "spz", "glb", "baked-html"])
def test_exports_lose_nothing_to_the_distance(room: Path, format: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["export", str(room / "3dgs"), "--format", format, "--out", str(tmp_path)]) == 0
    assert "relative to (4482" in capsys.readouterr().out
    (note,) = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    lost = note["psnr"]["run"]["photographs"] - note["psnr"]["file"]["photographs"]
    assert lost < 0.1 and np.abs(np.array(note["origin"]) - UTM).max() < 10 and all(value.is_integer() for value in note["origin"])


@pytest.mark.parametrize("recipe", ["3dgs", "scaffold-gs"])
def test_our_own_result_folder_comes_back(room: Path, recipe: str, tmp_path: Path) -> None:
    shutil.copytree(room / recipe / "point_cloud", tmp_path / "result/point_cloud")
    assert cli.main(["import", str(tmp_path / "result"), "--data", str(room / "far"), "--out", str(tmp_path / "back")]) == 0
    assert abs(psnr(room / recipe) - psnr(tmp_path / "back")) < 0.05
    cameras = json.loads((tmp_path / "back/cameras.json").read_text())
    assert max(abs(value) for camera in cameras for value in camera["position"]) < 20


@pytest.mark.parametrize("stated", ["beside", "in the file", "nowhere"])
def test_a_file_comes_back_wherever_its_origin_is_stated(room: Path, stated: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    format = "sog" if stated == "nowhere" else "ply"
    assert cli.main(["export", str(room / "3dgs"), "--format", format, "--out", str(tmp_path)]) == 0
    if stated != "beside":
        (tmp_path / f"scene.{format}.json").unlink()
    assert cli.main(["import", str(tmp_path / f"scene.{format}"), "--data", str(room / "far"), "--out", str(tmp_path / "back")]) == 0
    assert abs(psnr(room / "3dgs") - psnr(tmp_path / "back")) < 0.1


def test_double_positions_are_kept(room: Path, tmp_path: Path) -> None:
    """As Metashape writes them: in the frame of the capture, in double."""
    assert cli.main(["export", str(room / "3dgs"), "--format", "ply", "--out", str(tmp_path)]) == 0
    origin = json.loads((tmp_path / "scene.ply.json").read_text())["origin"]
    columns = ply.read_vertices(tmp_path / "scene.ply")
    far = {name: column.astype(np.float64) + origin["xyz".index(name)] if name in "xyz" else column for name, column in columns.items()}
    ply.write_vertices(tmp_path / "double.ply", far)
    assert cli.main(["import", str(tmp_path / "double.ply"), "--data", str(room / "far"), "--out", str(tmp_path / "back")]) == 0
    assert abs(psnr(room / "3dgs") - psnr(tmp_path / "back")) < 0.05


def test_near_captures_have_no_origin() -> None:
    assert World(2.0, (-1.0, 3.0, 0.5)).local_origin(5.0) == (0.0, 0.0, 0.0)
    assert World(2.0, (-448250.2, -5411932.4, 0.4)).local_origin(5.0) == (448250.0, 5411932.0, 0.0)
    seen = World(2.0, (-10.0, 0.0, 0.0)).seen_from((7.0, 0.0, 0.0))
    assert torch.equal(seen.from_input(torch.tensor([4.0, 1.0, 2.0])), torch.tensor([2.0, 2.0, 4.0]))


def test_a_page_lies_around_its_own_centre(room: Path, tmp_path: Path) -> None:
    assert cli.main(["export", str(room / "3dgs"), "--format", "html", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "scene.html").read_bytes()
    assert max(map(abs, html._settings(page)["pose"]["position"])) < 20
