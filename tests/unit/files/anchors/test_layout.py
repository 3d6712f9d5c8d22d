"""Result folders: as Scaffold-GS writes them (made by torch here), and our own, there and back."""

import json

import pytest
import torch
from plyfile import PlyData
from torch import nn

from scene_experts.core.errors import InputError, RunError
from scene_experts.files.anchors import networks as nets
from scene_experts.files.anchors.layout import describe, iteration_folder, read_scaffold_folder, write_scaffold_folder
from scene_experts.files.ply import write_anchor_ply
from support.messages import naming

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
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


def published(root, iteration, inputs=F + 3, split=True, appearance=0, bank=False):
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
    a, wanted, bank, codes = published(tmp_path, 30_000, split=split, appearance=16, bank=True)
    found, networks, facts = read_scaffold_folder(tmp_path)
    assert all(torch.equal(found[name], value) for name, value in a.items())
    assert networks.keys() == {"opacity", "cov", "color", "feature_bank", "appearance"}
    for attribute, module in [*wanted.items(), ("feature_bank", bank)]:
        n = networks[attribute]
        assert torch.equal(n["w1"][0], module[0].weight) and torch.equal(n["b1"][0], module[0].bias)
        assert torch.equal(n["w2"][0], module[2].weight) and torch.equal(n["b2"][0], module[2].bias)
        assert all(value.dtype == torch.float32 and len(value) == 1 for value in n.values())
    assert torch.equal(networks["appearance"]["table"], codes.embedding.weight)
    assert facts["iteration"] == 30_000 and facts["kind"] == "scaffold" and facts["K"] == 10 and facts["F"] == 32
    assert facts["voxel_size"] == 0.01 and facts["add_dist"] == () and facts["appearance_dim"] == 16 and facts["scene"] is None


def test_a_voxel_size_that_is_no_number_is_none(tmp_path):
    published(tmp_path, 7)
    for text in ("'auto'", "None", "[1]", "1e999"):
        (tmp_path / "cfg_args").write_text(f"Namespace(voxel_size={text})")
        assert read_scaffold_folder(tmp_path)[2]["voxel_size"] is None


def test_the_distance_shows_in_the_width(tmp_path):
    published(tmp_path, 7, inputs=F + 4)
    assert read_scaffold_folder(tmp_path)[2]["add_dist"] == ("opacity", "cov", "color")


def test_the_newest_or_a_given_iteration(tmp_path):
    for iteration in (7000, 30_000, 999):
        published(tmp_path, iteration)
    assert iteration_folder(tmp_path).name == "iteration_30000"
    assert iteration_folder(tmp_path, 999).name == "iteration_999"
    assert read_scaffold_folder(tmp_path / "point_cloud" / "iteration_7000")[2]["iteration"] == 7000
    with pytest.raises(InputError, match=naming(5, "999, 7000, 30000")):
        iteration_folder(tmp_path, 5)
    with pytest.raises(InputError, match=naming("point_cloud.ply")):
        read_scaffold_folder(tmp_path / "point_cloud")


def test_absent_and_unfitting_networks(tmp_path):
    published(tmp_path, 1)
    folder = tmp_path / "point_cloud" / "iteration_1"
    (folder / "cov_mlp.pt").unlink()
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_scaffold_folder(tmp_path)
    torch.jit.trace(nn.Sequential(nn.Linear(35, 32), nn.ReLU(), nn.Linear(32, 33)), (torch.rand(1, 35),)).save(str(folder / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov", 35, 70, 33)):
        read_scaffold_folder(tmp_path)
    torch.jit.trace(nn.Linear(35, 70), (torch.rand(1, 35),)).save(str(folder / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_scaffold_folder(tmp_path)
    torch.save(
        {"0.weight": torch.zeros(3, 2), "0.bias": torch.zeros(3), "2.weight": torch.zeros(3, 2), "2.bias": torch.zeros(3)},
        folder / "cov_mlp.pt",
    )
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        read_scaffold_folder(tmp_path)


# --- our own ------------------------------------------------------------------------------------------------------------------------------


def mixture(E=5, bias=True, inputs=F + 3):
    torch.manual_seed(5)
    out = {}
    for attribute, n in OUT.items():
        out[attribute] = {"w1": torch.randn(E, 32, inputs), "b1": torch.randn(E, 32), "w2": torch.randn(E, n, 32), "b2": torch.randn(E, n)}
        if E > 1:
            out[attribute] |= {"router_w": torch.randn(E, F)} | ({"router_b": torch.randn(E)} if bias else {})
    return out


def sidecar(networks, add_dist=()):
    k = dict.fromkeys(OUT, 2) if len(networks["cov"]["w1"]) > 1 else {}
    world = {"scale": 2.5, "shift": (1.0, 0.1 + 0.2, -3.0)}
    return describe(recipe="moe-gs", networks=networks, k=k, K=K, F=F, add_dist=add_dist, voxel_size=0.1, step=30_000, **world)


def same(a, b):
    return a.keys() == b.keys() and all(a[x].keys() == b[x].keys() and all(torch.equal(a[x][k], b[x][k]) for k in a[x]) for x in a)


@pytest.mark.parametrize(("E", "bias", "dist"), [(5, True, 0), (5, False, 1), (1, True, 0), (1, True, 1)])
def test_our_folder_there_and_back(tmp_path, E, bias, dist):
    a, networks = anchors(), mixture(E, bias, F + 3 + dist)
    described = sidecar(networks, tuple(OUT) if dist else ())
    folder = write_scaffold_folder(tmp_path, 30_000, a, networks, described)
    assert folder == tmp_path / "point_cloud" / "iteration_30000"
    names = {p.name for p in folder.iterdir()}
    assert names == {"point_cloud.ply", "scene.json"} | ({"moe.safetensors"} if E > 1 else set(nets.FILES.values()))
    found, networks_found, facts = read_scaffold_folder(tmp_path)
    assert all(torch.equal(found[name], value) for name, value in a.items()) and same(networks_found, networks)
    assert facts["scene"] == described == json.loads(json.dumps(described))
    assert facts["scene"]["world"] == {"scale": 2.5, "shift": [1.0, 0.1 + 0.2, -3.0]} and facts["voxel_size"] == 0.1 / 2.5
    assert facts["scene"]["phase"]["cov"] == ("sparse" if E > 1 else "single")
    assert (
        facts["cfg"]["n_offsets"] == 10 and facts["cfg"]["add_cov_dist"] is bool(dist) and facts["add_dist"] == (tuple(OUT) if dist else ())
    )
    assert PlyData.read(folder / "point_cloud.ply")["vertex"].count == 5


def test_experts_for_some_attributes_only(tmp_path):
    networks = mixture(5) | {"color": mixture(1)["color"]}
    write_scaffold_folder(tmp_path, 1, anchors(), networks, sidecar(networks))
    _, found, facts = read_scaffold_folder(tmp_path)
    assert same(found, networks) and facts["scene"]["E"] == {"opacity": 5, "cov": 5, "color": 1}


def test_names_in_the_file_of_experts(tmp_path):
    from safetensors import safe_open

    networks = mixture(5)
    nets.write_moe(tmp_path / "moe.safetensors", networks, {})
    with safe_open(tmp_path / "moe.safetensors", "pt") as file:
        names = ["router.weight", "router.bias", "experts.w1", "experts.b1", "experts.w2", "experts.b2"]
        assert set(file.keys()) == {f"{a}.{n}" for a in OUT for n in names}
        assert torch.equal(file.get_tensor("cov.router.weight"), networks["cov"]["router_w"])
        assert sum(file.get_tensor(name).numel() for name in file.keys()) == 35_925  # noqa: SIM118
    assert sum(t.numel() for n in mixture(1).values() for t in n.values()) == 7086


@pytest.mark.parametrize("depth", [2, 3, 6])
def test_single_networks_are_what_public_readers_load(tmp_path, depth):
    """Loaded back by torch itself, the traces give tanh / nothing / sigmoid of the network, whatever the number of rows."""
    networks = mixture(1)
    for network in networks.values():
        for i in range(depth - 2):
            network |= {f"middle.{i}.weight": torch.randn(32, 32) * 0.1, f"middle.{i}.bias": torch.randn(32)}
    folder = write_scaffold_folder(tmp_path, 1, anchors(), networks, sidecar(networks))
    assert same(read_scaffold_folder(tmp_path)[1], networks)
    x = torch.randn(11, F + 3)
    for attribute, final in (("opacity", torch.tanh), ("cov", lambda y: y), ("color", torch.sigmoid)):
        n = networks[attribute]
        h = torch.relu(x @ n["w1"][0].T + n["b1"][0])
        for i in range(depth - 2):
            h = torch.relu(h @ n[f"middle.{i}.weight"].T + n[f"middle.{i}.bias"])
        wanted = final(h @ n["w2"][0].T + n["b2"][0])
        torch.testing.assert_close(torch.jit.load(str(folder / f"{attribute}_mlp.pt"))(x), wanted)


def test_an_earlier_export_does_not_shine_through(tmp_path):
    write_scaffold_folder(tmp_path, 1, anchors(), mixture(5), sidecar(mixture(5)))
    write_scaffold_folder(tmp_path, 1, anchors(), mixture(1), sidecar(mixture(1)))
    assert same(read_scaffold_folder(tmp_path)[1], mixture(1))


def test_damaged_descriptions_and_experts(tmp_path):
    networks = mixture(5)
    folder = write_scaffold_folder(tmp_path, 1, anchors(), networks, sidecar(networks))
    text = (folder / "scene.json").read_text()
    for wrong, fact in (
        (text.replace('"format": 1', '"format": 9'), "9"),
        ("[]", "1"),
        (text[:40], "JSON"),
        ('{"format": 1}', "F, K, recipe, voxel_size, world"),
        (text.replace('"scale": 2.5', '"scale": 0'), "world"),
        (text.replace('"world": {', '"world": 3, "worlds": {'), "world"),
        (text.replace('"trained": 0.1', '"trained": null'), "world"),
        (text.replace('"step": 30000,', '"step": "x",'), "world"),
        (text.replace('"step": 30000,', '"step": 1, "extent": null, "scene": {},'), "world"),
        (text.replace('"step": 30000,', '"step": 1, "scene": 3,'), "world"),
    ):
        (folder / "scene.json").write_text(wrong)
        with pytest.raises(InputError, match=naming("scene.json", fact)):
            read_scaffold_folder(tmp_path)
    (folder / "scene.json").write_text(text)
    data = (folder / "moe.safetensors").read_bytes()
    (folder / "moe.safetensors").write_bytes(data[:-10])
    with pytest.raises(InputError, match=naming("moe.safetensors")):
        read_scaffold_folder(tmp_path)
    for broken in (
        {"opacity": networks["opacity"]},
        networks | {"cov": {k: v for k, v in networks["cov"].items() if k != "router_w"}},
        networks | {"cov": networks["cov"] | {"b2": torch.zeros(5, 3)}},
    ):
        nets.write_moe(folder / "moe.safetensors", broken, {})
        with pytest.raises(InputError, match=naming("cov")):
            read_scaffold_folder(tmp_path)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "point_cloud").write_text("a file")
    with pytest.raises(RunError, match=naming("point_cloud.ply")):
        write_scaffold_folder(tmp_path, 1, anchors(), None, sidecar(mixture(1)))
