"""Files of scenes are converted and shown without the photographs that they were made of."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scene_experts import cli
from scene_experts.core.types import Camera
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import registry
from scene_experts.files.formats import html, ply
from scene_experts.files.formats.splats import NAMES
from scene_experts.files.lone import open_scene
from scene_experts.files.measure import Painter
from scene_experts.files.registry import format_named
from scene_experts.training import run_folder
from scene_experts.training.run_folder import OpenRun
from support.synthetic import make_capture

LEAST = {"glb": 90.0, "sog": 45.0, "spz": 45.0, "baked-html": 45.0, "compressed-ply": 35.0}
"""dB to the run's pictures. 1,500 Gaussians are 6 chunks of compressed-ply, each half a scene wide, so its steps are coarse."""
EXACT = 90.0


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs `3dgs` and `moe-gs`, `mail` with files of them, and `gone`, their capture that has moved."""
    room = tmp_path_factory.mktemp("room")
    make_capture(room / "capture", views=9)
    for recipe in ("3dgs", "moe-gs"):
        words = [
            "train",
            recipe,
            "--data",
            str(room / "capture"),
            "--out",
            str(room / recipe),
            "--iterations",
            "60",
            "--preview-every",
            "0",
        ]
        assert cli.main(words) == 0
    (room / "mail").mkdir()
    assert export(room / "3dgs", "--format", *LEAST, "splat", "--no-measure", "--out", str(room / "direct")) == 0
    assert export(room / "3dgs", "--format", "ply", "--no-measure", "--out", str(room / "mail/garden.ply")) == 0
    fine = ("--format", "compact", "--quality", "0.01")
    assert export(room / "moe-gs", *fine, "--no-measure", "--out", str(room / "mail/statue.compact")) == 0
    (room / "capture").rename(room / "gone")
    return room


def export(source: Path, *words: str) -> int:
    return cli.main(["export", str(source), *words])


def pictures(opened: OpenRun, world: World, cameras: list[Camera]) -> list[Tensor]:
    """8-bit pictures for cameras in the capture's own frame. world: of the scene."""
    painter = Painter.of(opened.scene, opened.step, None, opened.config.train.antialias)
    with torch.no_grad():
        return [painter.picture_8bit(world.camera_from_input(camera), torch.zeros(3)) for camera in cameras]


def nearness(room: Path, recipe: str, file: Path, original: Path | None = None) -> float:
    """Least PSNR of a file's pictures against those of a run, or of another file, from every camera of the capture."""
    run = run_folder.open_run(room / recipe)
    capture = run_folder.capture_of(run, room / "gone")
    cameras = [capture.world.camera_to_input(view.camera) for view in capture.views]
    capture.images.close()
    opened = open_scene(file)
    assert opened.cameras is not None
    theirs = pictures(opened, opened.cameras.world, cameras)
    if original is None:
        ours = pictures(run, capture.world, cameras)
    else:
        other = open_scene(original)
        assert other.cameras is not None
        ours = pictures(other, other.cameras.world, cameras)
    return min(psnr(a, b) for a, b in zip(theirs, ours))


def same(one: Path, other: Path) -> bool:
    """Whether two files hold the same Gaussians, bit for bit."""
    a, b = registry.read(one), registry.read(other)
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in NAMES)


def test_a_ply_becomes_every_format(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = room / "mail/garden.ply"
    capsys.readouterr()
    assert export(file, "--format", *LEAST, "--out", str(tmp_path / "out")) == 0
    assert capsys.readouterr().out.count("no capture was given (--data)") == len(LEAST)
    assert nearness(room, "3dgs", file) > EXACT
    for name, least in LEAST.items():
        made = tmp_path / f"out/garden{format_named(name).suffix}"
        assert same(made, room / f"direct/scene{format_named(name).suffix}"), name  # the run itself gives no better file
        found = nearness(room, "3dgs", made)
        print(name, found)
        assert found >= least, (name, found)
        again = tmp_path / f"again-{name}.ply"
        assert export(made, "--format", "ply", "--out", str(again)) == 0
        assert nearness(room, "3dgs", again, made) > EXACT, name
    assert json.loads((tmp_path / "out/garden.sog.json").read_text())["step"] == 60
    page = html._settings((tmp_path / "out/garden.html").read_bytes())
    assert page["reach"] is None and len(page["flight"]) == html.FLIGHT


def test_a_splat_has_the_pictures_of_degree_0(room: Path, tmp_path: Path) -> None:
    assert export(room / "mail/garden.ply", "--format", "splat", "--out", str(tmp_path / "a.splat")) == 0
    assert same(tmp_path / "a.splat", room / "direct/scene.splat")
    ply.write(tmp_path / "cut.ply", ply.read(room / "mail/garden.ply").up_to_degree(0), {})
    found = nearness(room, "3dgs", tmp_path / "a.splat", tmp_path / "cut.ply")
    print("splat", found)
    assert found >= 45


def test_anchors_keep_their_networks_or_are_baked(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = room / "mail/statue.compact"
    assert export(file, "--format", "anchors", "--out", str(tmp_path / "folder")) == 0
    assert export(tmp_path / "folder", "--format", "compact", "--quality", "0.01", "--out", str(tmp_path / "b.compact")) == 0
    assert nearness(room, "moe-gs", file) >= 45
    assert nearness(room, "moe-gs", tmp_path / "folder", file) >= 70
    assert nearness(room, "moe-gs", tmp_path / "b.compact", file) >= 45
    assert export(file, "--format", "spz", "--refine", "0", "--out", str(tmp_path / "c.spz")) == 0
    assert "from cameras around the scene" in capsys.readouterr().out
    shutil.copytree(room / "moe-gs/point_cloud", tmp_path / "result/point_cloud")
    shutil.copy(room / "moe-gs/cameras.json", tmp_path / "result")
    opened = open_scene(tmp_path / "result")
    assert opened.cameras is not None and len(opened.cameras.views) == 9 and opened.cameras.kind == "cameras.json"


def test_with_its_capture_a_file_is_measured(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(room / "mail/garden.ply", "--format", "sog", "--out", str(tmp_path), "--data", str(room / "gone")) == 0
    assert "PSNR of 2 held-out views" in capsys.readouterr().out


@pytest.mark.parametrize("double", [True, False])
def test_far_positions_stay_exact(room: Path, tmp_path: Path, double: bool) -> None:
    """Of a PLY in UTM with float64 positions, and of one with an origin in its comment."""
    columns, origin = ply.read_vertices(room / "mail/garden.ply"), np.array([448250.0, 5411932.0, 340.0])
    near = np.stack([columns[axis] for axis in "xyz"], 1).astype(np.float64)
    if double:
        columns |= {axis: near[:, i] + origin[i] for i, axis in enumerate("xyz")}
    ply.write_vertices(tmp_path / "far.ply", columns, () if double else ply.note_comments({"origin": origin.tolist(), "antialias": True}))
    assert export(tmp_path / "far.ply", "--format", "ply", "glb", "--out", str(tmp_path / "out")) == 0
    note = json.loads((tmp_path / "out/far.glb.json").read_text())
    assert note["antialias"] is not double and ply.read_note(tmp_path / "out/far.ply").get("antialias", False) is not double
    for name in ("far.ply", "far.glb"):
        means = open_scene(tmp_path / "out" / name).scene.positions.double().numpy()
        assert np.abs(means + note["origin"] - near - origin).max() < 1e-6
    assert double or note["origin"] == origin.tolist()


def test_it_is_shown_from_around(room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser")
    from scene_experts.view.server import Viewer

    seen = []

    def serve(viewer: Viewer) -> None:
        camera = viewer.capture.views[viewer.first].camera
        small = replace(camera, width=80, height=60, K=camera.K * torch.tensor([[0.1], [0.1], [1.0]]))
        scene, step = viewer.current()
        seen.append((viewer.panel.stays_near(), Painter.of(scene, step).picture(small, torch.zeros(3))))

    monkeypatch.setattr(Viewer, "serve", serve)
    for file in ("garden.ply", "statue.compact"):
        assert cli.main(["view", str(room / "mail" / file), "--port", "0", "--device", "cpu"]) == 0
        assert capsys.readouterr().out.startswith(f"{file.partition('.')[0]}: http://")
    for near, picture in seen:
        assert not near and float(picture.detach().max()) > 0.1
