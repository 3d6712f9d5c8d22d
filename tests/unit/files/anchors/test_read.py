"""Published Scaffold-GS results become runs: drawn with their own anchors and networks, or refused in one sentence."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Mode
from scene_experts.files.anchors.frame import cell_positions
from scene_experts.files.anchors.networks import write_torchscript
from scene_experts.files.export import export_run, import_result
from scene_experts.files.ply import read_vertices, write_anchor_ply, write_vertices
from scene_experts.render import choose
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training import run_folder
from scene_experts.training.config import Data
from scene_experts.training.state import resume
from support.messages import naming
from support.synthetic import make_capture

VOXEL = 0.0173


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=8).folder


def published(root: Path, cfg: str | None = f"Namespace(voxel_size={VOXEL})", depth: int = 2) -> AnchorScene:
    """A folder as Scaffold-GS leaves it, and the scene in it: anchors on the floor, of the capture's own unit."""
    torch.manual_seed(0)
    cells = torch.unique(torch.cat([torch.randint(-80, 80, (900, 2)), torch.randint(-2, 3, (900, 1))], 1), dim=0)
    n = len(cells)
    a = {"feature": torch.randn(n, 32), "offsets": torch.randn(n, 10, 3), "log_scaling": torch.randn(n, 6) * 0.3 - 3}
    xyz = cell_positions(cells, VOXEL)
    scene = AnchorScene(Anchors(decoder=Plain(depth)), Table(a, {"cell": cells, "xyz": xyz}), VOXEL, 5.0)
    folder = root / "point_cloud" / "iteration_30000"
    write_anchor_ply(folder / "point_cloud.ply", xyz, a["offsets"], a["feature"], a["log_scaling"])
    networks = {}
    for name, value in scene.network_tensors().items():
        networks.setdefault(name.partition(".")[0], {})[name.partition(".")[2]] = value
    write_torchscript(folder, networks)
    if cfg:
        (root / "cfg_args").write_text(cfg)
    return scene


def picture(scene, capture, step):
    rasterize = choose("auto", "cpu")
    camera = capture.views[0].camera
    with torch.no_grad():
        decoded = scene(camera, step, Mode.DRAW, rasterize.visible)
        return rasterize(decoded.gaussians, camera, torch.tensor(capture.background)).image


@pytest.mark.parametrize(
    ("cfg", "depth"),
    [(f"Namespace(voxel_size={VOXEL})", 2), ("Namespace(voxel_size=0)", 2), (None, 3)],
    ids=["given", "automatic", "no cfg_args"],
)
def test_a_published_result_draws_as_it_is(tmp_path, folder, cfg, depth):
    scene = published(tmp_path / "result", cfg, depth)
    out = import_result(tmp_path / "result", Data(folder), tmp_path / "run")
    opened = run_folder.open_run(out)
    assert opened.config.data.normalise == "none" and opened.step == 30_000 and opened.config.train.recipe == "scaffold-gs"
    capture = run_folder.load_capture(opened.config.data)
    wanted, found = picture(scene, capture, 30_000), picture(opened.scene, capture, 30_000)
    assert wanted.std() > 0.05, "the picture shows something"
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    assert opened.scene.voxel == pytest.approx(VOXEL, rel=1e-6)
    assert torch.equal(opened.scene.table.facts["cell"], scene.table.facts["cell"])
    lines = export_run(out, "compact", rasterize=choose("auto", "cpu"))
    assert "bytes an anchor" in lines[1] and "PSNR" in lines[2]
    capture.images.close()


def test_positions_on_no_lattice_are_drawn_but_not_packed(tmp_path, folder):
    published(tmp_path / "result", None)
    path = tmp_path / "result" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    torch.manual_seed(1)
    n = 300
    write_anchor_ply(path, torch.randn(n, 3), torch.randn(n, 10, 3), torch.randn(n, 32), torch.randn(n, 6) - 3)
    out = import_result(tmp_path / "result", Data(folder), tmp_path / "run")
    assert len(run_folder.open_run(out).scene.table) == n
    with pytest.raises(InputError, match="--format anchors"):
        export_run(out, "compact")
    assert export_run(out, "anchors", tmp_path / "again")


def test_an_imported_run_cannot_be_resumed(tmp_path, folder):
    published(tmp_path / "result")
    out = import_result(tmp_path / "result", Data(folder), tmp_path / "run")
    with pytest.raises(InputError, match="--out"):
        resume(run_folder.open_run(out).cfg, out / "checkpoints", "cpu")
    with pytest.raises(InputError, match="--out"):
        import_result(tmp_path / "result", Data(folder), out)


def test_another_world_is_refused(tmp_path, folder):
    published(tmp_path / "result")
    out = import_result(tmp_path / "result", Data(folder), tmp_path / "run")
    with pytest.raises(InputError, match="--normalise"):
        import_result(out, Data(folder, normalise="extent"), tmp_path / "other")
    assert checkpoint.latest(tmp_path / "other" / "checkpoints") is None


def test_what_cannot_be_drawn_is_refused(tmp_path, folder):
    root = tmp_path / "result"
    published(root)
    iteration = root / "point_cloud" / "iteration_30000"
    torch.save({"embedding.weight": torch.zeros(99, 0)}, iteration / "embedding_appearance.pt")
    with pytest.raises(InputError, match=naming(99, "--split")):
        import_result(root, Data(folder), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    (iteration / "embedding_appearance.pt").unlink()
    with pytest.raises(InputError, match="absent"):
        import_result(tmp_path / "absent", Data(folder), tmp_path / "run")
    plain = read_vertices(iteration / "point_cloud.ply")
    write_vertices(iteration / "point_cloud.ply", {**plain, "level": plain["x"] * 0, "extra_level": plain["x"] * 0, "info": plain["x"] * 0})
    with pytest.raises(InputError, match="info"):
        import_result(root, Data(folder), tmp_path / "run")
    write_vertices(iteration / "point_cloud.ply", plain)
    with pytest.raises(InputError, match="absent"):
        import_result(root, replace(Data(folder), path=tmp_path / "absent"), tmp_path / "run")


def test_a_published_feature_bank_and_codes_are_drawn(tmp_path, folder):
    torch.manual_seed(1)
    capture = run_folder.load_capture(Data(folder, normalise="none"))
    wanted = published(tmp_path / "result")
    iteration = tmp_path / "result" / "point_cloud" / "iteration_30000"
    config = replace(wanted.config, mix=FeatureBank(), appearance=4)
    scene = AnchorScene(config, wanted.table, VOXEL, 5.0, views=capture.train)
    networks = {a: dict(scene.heads[a].named_parameters()) for a in ("opacity", "cov", "color")}
    write_torchscript(
        iteration, {**networks, "feature_bank": dict(scene.mix.named_parameters()), "appearance": {"table": scene.codes.table}}
    )
    opened = run_folder.open_run(import_result(tmp_path / "result", Data(folder), tmp_path / "run"))
    assert opened.scene.config.appearance == 4 and opened.scene.codes.views == tuple(capture.train)
    for index in (capture.train[1], capture.test[0]):
        camera, draw = capture.views[index].camera, choose("auto", "cpu")
        with torch.no_grad():
            a, b = (s(camera, 1, Mode.DRAW, draw.visible).gaussians for s in (scene, opened.scene))
        torch.testing.assert_close(a.colors, b.colors, rtol=0, atol=1e-5)
        torch.testing.assert_close(a.opacities, b.opacities, rtol=0, atol=1e-5)
    capture.images.close()


@pytest.mark.parametrize(("fork", "rule"), [(2, "round"), (3, "floor")])
def test_a_published_octree_draws_the_levels_its_distances_ask_for(tmp_path, folder, fork, rule):
    scene = published(tmp_path / "result", f"Namespace(voxel_size={VOXEL}, fork={fork}, dist2level={rule!r}, add_level=False)")
    path = tmp_path / "result" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    torch.manual_seed(2)
    n, edge, standard, origin = 800, 0.4, 6.0, torch.tensor([-3.0, -3.0, -3.0])
    level = torch.randint(0, 3, (n,))
    cell = torch.stack([torch.randint(0, 15 * fork ** int(j), (3,)) for j in level])
    xyz = origin + cell * (edge / fork**level)[:, None]
    info, extra = torch.zeros(n), torch.rand(n)
    info[0], info[1] = edge, standard
    columns = {"level": level, "extra_level": extra, "info": info}
    write_anchor_ply(path, xyz, torch.randn(n, 10, 3), torch.randn(n, 32), torch.randn(n, 6) * 0.3 - 3, columns)
    opened = run_folder.open_run(import_result(tmp_path / "result", Data(folder), tmp_path / "run"))
    table, camera = opened.scene.table, run_folder.load_capture(opened.config.data).views[0].camera
    for j in range(3):  # the same lattice, counted from an anchor of level 0
        off = table.facts["cell"][level == j] - cell[level == j]
        assert (off == off[0]).all()
    r = (xyz + (edge / 2 / fork**level)[:, None] - camera.position).norm(dim=1)
    asked = getattr(torch, rule)(torch.log(standard / r) / math.log(fork) + extra).clamp(0, 2)
    assert opened.scene.select(table, camera, 30_000, False).tolist() == (level <= asked).nonzero().squeeze(1).tolist()
    assert (opened.config.train.scene.select.fork, opened.config.train.scene.select.rule) == (fork, rule)
    with pytest.raises(InputError, match=naming(tmp_path)):
        (tmp_path / "result" / "cfg_args").write_text("Namespace(add_level=True)")
        import_result(tmp_path / "result", Data(folder), tmp_path / "other")
    assert opened.config.train.recipe == "octree-gs" and opened.scene.heads["color"].w1.shape == scene.heads["color"].w1.shape
