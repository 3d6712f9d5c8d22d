"""Published Scaffold-GS results become runs: drawn with their own anchors and networks, or refused in one sentence."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Mode
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.files.anchors import torchscript
from scene_experts.files.anchors.data import by_attribute
from scene_experts.files.anchors.read import check_networks, distance_inputs, for_trained_unit, level_facts, read_folder
from scene_experts.files.anchors.write import level_info
from scene_experts.files.formats.ply import read_vertices, write_vertices
from scene_experts.files.importing import import_files
from scene_experts.render import choose
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.mlp import Plain
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training import run_folder
from scene_experts.training.state import resume
from support.files import export_run, write_anchor_ply
from support.messages import naming
from support.scenes import start_scene
from support.synthetic import make_capture

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
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
    xyz = (cells.double() * VOXEL).float()
    scene = AnchorScene(Anchors(decoder=Plain(depth)), Table(a, {"cell": cells, "xyz": xyz}), VOXEL, 5.0)
    folder = root / "point_cloud" / "iteration_30000"
    write_anchor_ply(folder / "point_cloud.ply", xyz, a["offsets"], a["feature"], a["log_scaling"])
    networks = {}
    for name, value in scene.network_tensors().items():
        networks.setdefault(name.partition(".")[0], {})[name.partition(".")[2]] = value
    torchscript.write(folder, networks)
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
    out = import_files(tmp_path / "result", Data(folder), tmp_path / "run")
    opened = run_folder.open_run(out)
    assert opened.config.data.normalise == "none" and opened.step == 30_000 and opened.config.train.recipe == "scaffold-gs"
    capture = captures.load(opened.config.data)
    wanted, found = picture(scene, capture, 30_000), picture(opened.scene, capture, 30_000)
    assert wanted.std() > 0.05, "the picture shows something"
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    assert opened.scene.voxel == pytest.approx(VOXEL, rel=1e-6)
    assert torch.equal(opened.scene.table.facts["cell"], scene.table.facts["cell"])
    (written,) = export_run(out, "compact", measure=True, quality=0.01)
    assert written.rows == len(scene.positions) and written.psnr["file"] == pytest.approx(written.psnr["run"], abs=0.1)
    capture.images.close()


def test_positions_on_no_lattice_are_drawn_but_not_packed(tmp_path, folder):
    published(tmp_path / "result", None)
    path = tmp_path / "result" / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    torch.manual_seed(1)
    n = 300
    write_anchor_ply(path, torch.randn(n, 3), torch.randn(n, 10, 3), torch.randn(n, 32), torch.randn(n, 6) - 3)
    out = import_files(tmp_path / "result", Data(folder), tmp_path / "run")
    assert len(run_folder.open_run(out).scene.table) == n
    with pytest.raises(InputError, match="--format anchors"):
        export_run(out, "compact")
    assert export_run(out, "anchors", tmp_path / "again")


def test_an_imported_run_cannot_be_resumed(tmp_path, folder):
    published(tmp_path / "result")
    out = import_files(tmp_path / "result", Data(folder), tmp_path / "run")
    with pytest.raises(InputError, match="--out"):
        resume(run_folder.open_run(out).config.train.scaled(), out / "checkpoints", "cpu")
    with pytest.raises(InputError, match="--out"):
        import_files(tmp_path / "result", Data(folder), out)


def test_another_world_is_refused(tmp_path, folder):
    published(tmp_path / "result")
    out = import_files(tmp_path / "result", Data(folder), tmp_path / "run")
    with pytest.raises(InputError, match="--normalise"):
        import_files(out, Data(folder, normalise="extent"), tmp_path / "other")
    assert checkpoint.latest(tmp_path / "other" / "checkpoints") is None


def test_what_cannot_be_drawn_is_refused(tmp_path, folder):
    root = tmp_path / "result"
    published(root)
    iteration = root / "point_cloud" / "iteration_30000"
    torch.save({"embedding.weight": torch.zeros(99, 0)}, iteration / "embedding_appearance.pt")
    with pytest.raises(InputError, match=naming(99, "--split")):
        import_files(root, Data(folder), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    (iteration / "embedding_appearance.pt").unlink()
    with pytest.raises(InputError, match="absent"):
        import_files(tmp_path / "absent", Data(folder), tmp_path / "run")
    plain = read_vertices(iteration / "point_cloud.ply")
    write_vertices(iteration / "point_cloud.ply", {**plain, "level": plain["x"] * 0, "extra_level": plain["x"] * 0, "info": plain["x"] * 0})
    with pytest.raises(InputError, match="info"):
        import_files(root, Data(folder), tmp_path / "run")
    write_vertices(iteration / "point_cloud.ply", plain)
    with pytest.raises(InputError, match="absent"):
        import_files(root, replace(Data(folder), path=tmp_path / "absent"), tmp_path / "run")


def test_a_published_feature_bank_and_codes_are_drawn(tmp_path, folder):
    torch.manual_seed(1)
    capture = captures.load(Data(folder, normalise="none"))
    wanted = published(tmp_path / "result")
    iteration = tmp_path / "result" / "point_cloud" / "iteration_30000"
    config = replace(wanted.config, mix=FeatureBank(), appearance=4)
    scene = AnchorScene(config, wanted.table, VOXEL, 5.0, views=capture.train)
    networks = {a: dict(scene.heads[a].named_parameters()) for a in ("opacity", "cov", "color")}
    torchscript.write(
        iteration, {**networks, "feature_bank": dict(scene.bank.named_parameters()), "appearance": {"table": scene.codes.table}}
    )
    opened = run_folder.open_run(import_files(tmp_path / "result", Data(folder), tmp_path / "run"))
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
    opened = run_folder.open_run(import_files(tmp_path / "result", Data(folder), tmp_path / "run"))
    table, camera = opened.scene.table, captures.load(opened.config.data).views[0].camera
    for j in range(3):  # the same lattice, counted from an anchor of level 0
        off = table.facts["cell"][level == j] - cell[level == j]
        assert (off == off[0]).all()
    r = (xyz + (edge / 2 / fork**level)[:, None] - camera.position).norm(dim=1)
    asked = getattr(torch, rule)(torch.log(standard / r) / math.log(fork) + extra).clamp(0, 2)
    assert opened.scene.select(table, camera, 30_000, False).tolist() == (level <= asked).nonzero().squeeze(1).tolist()
    assert (opened.config.train.scene.select.fork, opened.config.train.scene.select.rule) == (fork, rule)
    with pytest.raises(InputError, match=naming(tmp_path)):
        (tmp_path / "result" / "cfg_args").write_text("Namespace(add_level=True)")
        import_files(tmp_path / "result", Data(folder), tmp_path / "other")
    assert opened.config.train.recipe == "octree-gs" and opened.scene.heads["color"].w1.shape == scene.heads["color"].w1.shape


# --- folders as torch writes them ---------------------------------------------------------------------------------------------------------

K, F = 10, 32
OUT = {"opacity": 10, "cov": 70, "color": 30}
LAST = {"opacity": [nn.Tanh()], "cov": [], "color": [nn.Sigmoid()]}


def anchors(n=5):
    torch.manual_seed(3)
    return {"xyz": torch.randn(n, 3), "offsets": torch.randn(n, K, 3), "feature": torch.randn(n, F), "log_scaling": torch.randn(n, 6)}


def modules(inputs=F + 3, color_inputs=None):
    torch.manual_seed(4)
    width = {"opacity": inputs, "cov": inputs, "color": color_inputs or inputs}
    return {a: nn.Sequential(nn.Linear(width[a], 32), nn.ReLU(True), nn.Linear(32, OUT[a]), *LAST[a]) for a in OUT}


class Embedding(nn.Module):
    def __init__(self, views, size):
        super().__init__()
        self.embedding = nn.Embedding(views, size)

    def forward(self, x):
        return self.embedding(x)


def traced(root, iteration, inputs=F + 3, split=True, appearance=0, bank=False):
    """A folder as Scaffold-GS leaves it, traced with the example inputs that it traces with."""
    folder = root / "point_cloud" / f"iteration_{iteration}"
    a = anchors()
    write_anchor_ply(folder / "point_cloud.ply", a["xyz"], a["offsets"], a["feature"], a["log_scaling"])
    found = modules(inputs, inputs + appearance)
    extra = nn.Sequential(nn.Linear(4, 32), nn.ReLU(True), nn.Linear(32, 3), nn.Softmax(dim=1))
    codes = Embedding(6, max(appearance, 1))
    if split:
        for attribute, module in found.items():
            torch.jit.trace(module.eval(), (torch.rand(1, module[0].in_features),)).save(str(folder / f"{attribute}_mlp.pt"))
        if bank:
            torch.jit.trace(extra.eval(), (torch.rand(1, 4),)).save(str(folder / "feature_bank_mlp.pt"))
        if appearance:
            torch.jit.trace(codes.eval(), (torch.zeros(1, dtype=torch.long),)).save(str(folder / "embedding_appearance.pt"))
    else:
        states = {f"{attribute}_mlp": module.state_dict() for attribute, module in found.items()}
        states |= {"feature_bank_mlp": extra.state_dict()} if bank else {}
        states |= {"appearance": codes.state_dict()} if appearance else {}
        torch.save(states, folder / "checkpoints.pth")
    (root / "cfg_args").write_text("Namespace(voxel_size=0.01, n_offsets=10, feat_dim=32, data_device='cuda', add_color_dist=False)")
    return a, found, extra, codes


@pytest.mark.parametrize("split", [True, False])
def test_a_published_folder(tmp_path, split):
    a, wanted, bank, codes = traced(tmp_path, 30_000, split=split, appearance=16, bank=True)
    found = read_folder(tmp_path / "point_cloud" / "iteration_30000")
    networks = by_attribute(found.networks)
    assert all(torch.equal(found.columns[name], value) for name, value in a.items())
    assert networks.keys() == {"opacity", "cov", "color", "feature_bank", "appearance"}
    for attribute, module in [*wanted.items(), ("feature_bank", bank)]:
        n = networks[attribute]
        assert torch.equal(n["w1"][0], module[0].weight) and torch.equal(n["b1"][0], module[0].bias)
        assert torch.equal(n["w2"][0], module[2].weight) and torch.equal(n["b2"][0], module[2].bias)
        assert all(value.dtype == torch.float32 and len(value) == 1 for value in n.values())
    assert torch.equal(networks["appearance"]["table"], codes.embedding.weight)
    assert found.step == 30_000 and "level" not in found.columns and found.about is None
    assert found.voxel == 0.01 and found.add_dist == () and found.settings["n_offsets"] == 10


@pytest.mark.parametrize("text", ["'auto'", "None", "[1]", "1e999", "0"])
def test_a_voxel_size_that_is_no_number_is_unknown(tmp_path, text):
    traced(tmp_path, 7)
    (tmp_path / "cfg_args").write_text(f"Namespace(voxel_size={text})")
    assert read_folder(tmp_path / "point_cloud" / "iteration_7").voxel == 0.0


def test_the_distance_shows_in_the_width(tmp_path):
    traced(tmp_path, 7, inputs=F + 4)
    assert read_folder(tmp_path / "point_cloud" / "iteration_7").add_dist == ("opacity", "cov", "color")


def test_absent_and_unfitting_networks(tmp_path):
    traced(tmp_path, 1)
    folder = tmp_path / "point_cloud" / "iteration_1"
    (folder / "cov_mlp.pt").unlink()
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_folder(folder)
    torch.jit.trace(nn.Sequential(nn.Linear(35, 32), nn.ReLU(), nn.Linear(32, 33)), (torch.rand(1, 35),)).save(str(folder / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov", 35, 70, 33)):
        read_folder(folder)
    torch.jit.trace(nn.Linear(35, 70), (torch.rand(1, 35),)).save(str(folder / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_folder(folder)
    torch.save(
        {"0.weight": torch.zeros(3, 2), "0.bias": torch.zeros(3), "2.weight": torch.zeros(3, 2), "2.bias": torch.zeros(3)},
        folder / "cov_mlp.pt",
    )
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_folder(folder)


# --- parts --------------------------------------------------------------------------------------------------------------------------------


def experts(E=5):
    g = torch.Generator().manual_seed(2)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return {
        a: {"w1": new(E, 32, 35), "b1": new(E, 32), "w2": new(E, n, 32), "b2": new(E, n), "router_w": new(E, 32), "router_b": new(E)}
        for a, n in OUT.items()
    }


@pytest.mark.parametrize(
    ("attribute", "name", "value"),
    [
        ("cov", "b1", torch.zeros(5, 31)),
        ("color", "w2", torch.zeros(4, 30, 32)),
        ("opacity", "router_b", torch.zeros(4)),
        ("cov", "w1", None),
        ("cov", "w1", torch.zeros(32, 35)),
        ("cov", "b2", torch.zeros(70)),
    ],
)
def test_networks_that_do_not_fit_together(attribute, name, value):
    networks = experts()
    check_networks(networks, "there")
    if value is None:
        del networks[attribute][name]
    else:
        networks[attribute][name] = value
    with pytest.raises(InputError, match=attribute):
        check_networks(networks, "there")


def test_levels_come_back_from_their_columns():
    scene = start_scene("octree-gs")
    levels, facts = scene.select.lattices, scene.table.facts
    columns = {"level": facts["level"], "extra_level": facts["extra_level"], "info": level_info(scene, 2.0)}
    again = level_facts(levels, facts["xyz"] + 1e-6, columns, exact=True)
    assert all(torch.equal(again[name], facts[name]) for name in ("cell", "xyz", "level", "extra_level"))
    assert not torch.equal(level_facts(levels, facts["xyz"] + 1e-6, columns, exact=False)["xyz"], facts["xyz"])


def test_networks_for_the_trained_unit():
    networks = {"color": {"w1": torch.ones(1, 2, 6)}, "feature_bank": {"w1": torch.ones(1, 2, 4)}, "appearance": {"table": torch.ones(1)}}
    found = for_trained_unit(networks, ("color",), 2, 4.0)
    assert found.keys() == {"color", "mix", "appearance"}
    assert found["color"]["w1"][0, 0].tolist() == [1, 1, 1, 1, 1, 0.25] and found["mix"]["w1"][0, 0].tolist() == [1, 1, 1, 0.25]
    assert networks["color"]["w1"].min() == 1, "the file's tensors stay as they are"
    with pytest.raises(InputError, match=naming(4, 3)):
        for_trained_unit({"feature_bank": {"w1": torch.zeros(1, 32, 3)}}, (), 2, 4.0)


def test_the_networks_of_a_router_of_another_form_are_read():
    networks = experts()
    for attribute in networks.values():
        attribute["router_directions"] = attribute.pop("router_w")
        attribute.pop("router_b")
    check_networks(networks, "there")
    for attribute in networks.values():
        del attribute["router_directions"]
    with pytest.raises(InputError, match="experts that fit together"):
        check_networks(networks, "there")


def test_levels_without_settings_do_not_pass_for_distances():
    K, F = 10, 32
    networks = {
        a: {"w1": torch.zeros(1, 32, F + 4), "w2": torch.zeros(1, n * K, 32)} for a, n in (("opacity", 1), ("cov", 7), ("color", 3))
    }
    columns = {"offsets": torch.zeros(5, K, 3), "feature": torch.zeros(5, F)}
    assert distance_inputs(networks, columns, None, "x") == ("opacity", "cov", "color")  # Scaffold-GS has no levels
    columns["level"] = torch.zeros(5)
    assert distance_inputs(networks, columns, False, "x") == ("opacity", "cov", "color")
    with pytest.raises(InputError, match="cfg_args"):
        distance_inputs(networks, columns, None, "x")
