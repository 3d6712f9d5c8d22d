"""A mesh of a trained run: where its surface lies, what may be asked of it, and the files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.cli import main
from scene_experts.core.errors import InputError
from scene_experts.core.types import Points
from scene_experts.data.far import find_box
from scene_experts.files.export import Options, export
from scene_experts.files.mesh import FORMAT
from scene_experts.files.mesh.draw import MeshTask, draw_views, make_mesh
from scene_experts.files.mesh.fuse import sample
from scene_experts.training import run_folder
from support.synthetic import make_capture

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("mesh")
    folder = make_capture(root / "capture", views=12, size=(64, 48), points=800, mixed_sizes=False).folder
    words = ["--data", str(folder), "--out", str(root / "run"), "--iterations", "150", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", *words]) == 0
    return run_folder.open_run(root / "run")


def silent(what: str, done: int, total: int) -> None:
    pass


def test_the_mesh_lies_where_the_views_see_it(run):
    capture = run_folder.capture_of(run)
    task = MeshTask(run, capture, 40, None, None, silent)
    mesh, note = make_mesh(task)
    assert len(mesh) > 50 and len(mesh.vertices) == len(mesh.colors) and note["cells"] == 40 and note["views"] == len(capture.train)
    view = draw_views(task)[0]
    places = capture.world.from_input(torch.from_numpy(mesh.vertices)).numpy()
    at, seen = sample(view, places)
    z = places @ view.camera.world_to_cam.double().numpy()[2, :3] + float(view.camera.world_to_cam[2, 3])
    assert seen.any() and np.median(np.abs(at - z)[seen]) < 3 * note["voxel"] * capture.world.scale
    capture.images.close()


def test_files_open_in_trimesh_and_say_how_they_were_made(run, tmp_path):
    options = Options(cells=24)
    (written,) = export(run, "mesh", tmp_path / "a.mesh.ply", options)
    (other,) = export(run, "mesh", tmp_path / "a.glb", options)
    one, two = (trimesh.load(file.path, process=False, force="mesh") for file in (written, other))
    assert len(one.faces) == len(two.faces) == written.rows and one.visual.vertex_colors.shape[1] == 4
    np.testing.assert_allclose(np.sort(two.vertices[:, 1]), np.sort(-one.vertices[:, 1]), atol=1e-5)
    assert json.loads((tmp_path / "a.mesh.ply.json").read_text())["cells"] == 24
    assert "triangles" in written.lines[1]


def test_a_mesh_far_from_the_origin_keeps_its_vertices(run, tmp_path):
    near = run_folder.capture_of(run)
    place = np.array([412345.0, 5654321.0, 120.0])
    far = replace(near, world=near.world.seen_from(tuple(-place)))
    found, note = FORMAT.draw(run, far, Options(cells=24), None, silent)
    alone, _ = make_mesh(MeshTask(run, near, 24, None, None, silent))
    np.testing.assert_allclose(found.vertices + note["origin"], alone.vertices + place, atol=1e-6)
    assert np.abs(found.vertices).max() < 100
    near.images.close()


def test_what_cannot_be_is_refused(run, tmp_path):
    with pytest.raises(InputError, match="--sh-degree"):
        export(run, "mesh", tmp_path / "b.ply", Options(sh_degree=1))
    with pytest.raises(InputError, match="inside --crop"):
        export(run, "mesh", tmp_path / "b.ply", Options(crop="sphere:900,900,900,1"))
    capture = run_folder.capture_of(run)
    with pytest.raises(InputError, match="training views"):
        make_mesh(MeshTask(run, replace(capture, train=()), 24, None, None, silent))
    capture.images.close()
    with pytest.raises(InputError, match=r"\.mesh\.ply or \.ply or \.glb"):
        export(run, "mesh", tmp_path / "b.obj")


def test_a_background_of_points_far_away_is_no_surface(run, caplog):
    capture = run_folder.capture_of(run)
    assert capture.points is not None
    xyz, rgb = capture.points.xyz, capture.points.rgb
    near = (xyz - xyz.median(0).values).norm(dim=1).argsort()[:10]
    some = replace(capture, points=Points(xyz[near], rgb[near]))
    low, high = np.reshape(find_box(xyz[near]), (2, 3))
    far = replace(run, config=replace(run.config, train=replace(run.config.train, far_points=5.0)))
    plain, bounded = (
        make_mesh(MeshTask(trained, some, 24, None, None, silent))[1]["voxel"] * capture.world.scale for trained in (run, far)
    )
    assert "left out as a background" in caplog.text and caplog.text.count("--crop") == 1
    assert bounded < plain and 24 * bounded <= float((high - low).max()) + 1e-6
    capture.images.close()
