"""Our files in other people's readers: every attribute within the format's quantum, in the order of the file.

SCENE_EXPERTS_FOREIGN_PYTHON names a Python that has gsply, gaussforge or usd-core (this one by default), SCENE_EXPERTS_SPLAT_TRANSFORM the
cli.mjs of @playcanvas/splat-transform (`splat-transform` on the path by default). What is not there is skipped.
"""

import json
import os
import shutil
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
import torch

from scene_experts.files.formats import ply
from scene_experts.files.formats.pack import turn
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import GAUSSIANS, format_named, formats_of, read
from support.gltf import column, parsed
from support.splat_quanta import check, differences, quanta, scene

pytestmark = pytest.mark.foreign
PYTHON = os.environ.get("SCENE_EXPERTS_FOREIGN_PYTHON", sys.executable)
TRANSFORM = os.environ.get("SCENE_EXPERTS_SPLAT_TRANSFORM") or shutil.which("splat-transform")
NODE = shutil.which("node")

GSPLY = """
import sys, numpy as np, gsply
from gsply.spz import read_spz
path, out = sys.argv[1:]
d = read_spz(path) if path.endswith(".spz") else gsply.plyread(path)
rest = d.shN if d.shN is not None and d.shN.size else np.zeros((len(d.means), 0, 3), np.float32)
np.savez(out, means=d.means, log_scales=d.scales, quats=d.quats, opacity_logit=d.opacities.reshape(-1),
         sh=np.concatenate([np.asarray(d.sh0).reshape(-1, 1, 3), rest.reshape(len(d.means), -1, 3)], 1))
"""
GAUSSFORGE = """
import sys, gaussforge
path, out, kind = sys.argv[1:]
found = gaussforge.GaussForge().convert(open(path, "rb").read(), kind, "ply")
if found.get("error"): sys.exit(str(found["error"]))
open(out, "wb").write(found["data"])
"""


@cache
def has(module: str) -> bool:
    return subprocess.run([PYTHON, "-c", f"import {module}"], capture_output=True).returncode == 0


def run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, (command, done.stdout[-500:], done.stderr[-500:])


def by_gsply(path, tmp_path) -> Splats:
    if not has("gsply"):
        pytest.skip("gsply is not installed")
    run(PYTHON, "-c", GSPLY, str(path), str(tmp_path / "gsply.npz"))
    with np.load(tmp_path / "gsply.npz") as found:
        s = Splats(**{name: torch.from_numpy(np.ascontiguousarray(found[name], np.float32)) for name in found})
    return turn(s, "x") if path.suffix == ".spz" else s  # gsply leaves SPZ's own frame


def by_gaussforge(path, tmp_path) -> Splats:
    if not has("gaussforge"):
        pytest.skip("gaussforge is not installed")
    kind = path.name.split(".", 1)[1]
    run(PYTHON, "-c", GAUSSFORGE, str(path), str(tmp_path / "gaussforge.ply"), kind)
    s = ply.read(tmp_path / "gaussforge.ply")
    return turn(s, "x") if path.suffix == ".spz" else s  # so does gaussforge


def as_ply(path, tmp_path) -> Splats:
    return ply.read(by_splat_transform(path, tmp_path, "splat_transform.ply"))


def by_splat_transform(path, tmp_path, out):
    if not TRANSFORM or (TRANSFORM.endswith(".mjs") and not NODE):
        pytest.skip("splat-transform is not installed")
    start = [NODE, TRANSFORM] if TRANSFORM.endswith(".mjs") else [TRANSFORM]
    run(*start, "-w", "-q", "-g", "cpu", str(path), str(tmp_path / out))
    return tmp_path / out


READERS = {"gsply": by_gsply, "gaussforge": by_gaussforge, "splat-transform": as_ply}
READS = [
    *((reader, format) for reader in READERS for format in ("ply", "compressed-ply", "spz")),
    *((reader, format) for reader in ("gaussforge", "splat-transform") for format in ("sog", "splat")),
]


@pytest.mark.parametrize(("reader", "format"), READS)
@pytest.mark.parametrize("degree", [0, 3])
def test_a_foreign_reader_finds_what_was_written(tmp_path, reader, format, degree):
    s = scene(1000, degree)
    path = tmp_path / f"a{format_named(format).suffix}"
    format_named(format).write(path, s, {"recipe": "moe-gs", "psnr": 21.88})
    found = READERS[reader](path, tmp_path)
    if format == "splat":
        found = Splats(found.means, found.log_scales, found.quats, found.opacity_logit, found.sh[:, :1])
    check(format, found, s)
    ours = read(path)
    for name, difference in differences(found, ours).items():
        assert float(difference.max()) <= (0.02 if name == "sh" and format == "compressed-ply" else 0.01), (name, float(difference.max()))


@pytest.mark.parametrize("format", ["ply", "compressed-ply", "spz", "sog"])
def test_we_read_what_splat_transform_writes(tmp_path, format):
    s = scene(1500, 3)
    format_named("ply").write(tmp_path / "a.ply", s, {})
    found = read(by_splat_transform(tmp_path / "a.ply", tmp_path, f"b{format_named(format).suffix}"))
    nearest = torch.cdist(found.means.double(), s.means.double()).argmin(1)
    wanted = s.rows(nearest)
    assert len(nearest.unique()) > 1480
    for name, difference in differences(found, wanted).items():
        if name != "sh":
            limit = {"means": 0.15, "log_scales": 0.12, "opacity": 0.005, "quats": 0.02}[name]
            assert float(difference.max()) < limit, (name, float(difference.max()))
    assert float(differences(found, wanted)["sh"].square().mean().sqrt()) < 0.12


def test_our_gltf_has_the_accessors_of_splat_transform_s(tmp_path):
    """It writes glTF and reads none: the same scene, attribute by attribute."""
    s = scene(300, 3)
    format_named("ply").write(tmp_path / "a.ply", s, {})
    theirs = by_splat_transform(tmp_path / "a.ply", tmp_path, "b.glb")
    format_named("glb").write(tmp_path / "a.glb", s, {})
    (ours, our_body), (their, their_body) = parsed(tmp_path / "a.glb"), parsed(theirs)
    names = ours["meshes"][0]["primitives"][0]["attributes"]
    assert set(names) == set(their["meshes"][0]["primitives"][0]["attributes"])
    assert ours["meshes"][0]["primitives"][0]["extensions"] == their["meshes"][0]["primitives"][0]["extensions"]
    # it quotes a node's transform or turns the data: compared after both are read
    check("glb", read(theirs), s)
    for name in names:
        if name.endswith("COLOR_0"):
            assert np.abs(column(ours, our_body, name).astype(int) - column(their, their_body, name)).max() <= 1


GLTF_TRANSFORM = """
const fs = require('fs'), [modules, path, out] = process.argv.slice(1);
const { NodeIO } = require(modules + '/@gltf-transform/core');
new NodeIO().read(path).then((doc) => {
  const primitive = doc.getRoot().listMeshes()[0].listPrimitives()[0];
  const found = {};
  for (const name of primitive.listSemantics()) {
    const accessor = primitive.getAttribute(name), values = [];
    for (let i = 0; i < accessor.getCount(); i++) values.push(accessor.getElement(i, []));
    found[name] = values;
  }
  fs.writeFileSync(out, JSON.stringify(found));
});
"""


@pytest.mark.parametrize("degree", [0, 3])
def test_a_general_gltf_reader_finds_what_was_written(tmp_path, degree):
    """@gltf-transform/core reads every attribute; values are turned back from glTF's frame with the definitions alone."""
    modules = os.environ.get("SCENE_EXPERTS_NODE_MODULES")
    if not NODE or not modules or not os.path.isdir(os.path.join(modules, "@gltf-transform", "core")):
        pytest.skip("@gltf-transform/core is not installed (SCENE_EXPERTS_NODE_MODULES names the folder that has it)")
    s = scene(500, degree)
    format_named("glb").write(tmp_path / "a.glb", s, {"recipe": "moe-gs"})
    run(NODE, "-e", GLTF_TRANSFORM, modules, str(tmp_path / "a.glb"), str(tmp_path / "a.json"))
    columns = {
        name.removeprefix("KHR_gaussian_splatting:"): torch.tensor(v) for name, v in json.loads((tmp_path / "a.json").read_text()).items()
    }
    x, y, z, w = columns["ROTATION"].unbind(1)
    found = Splats(
        columns["POSITION"] * torch.tensor([-1.0, -1.0, 1.0]),
        columns["SCALE"].log(),
        torch.stack([z, y, -x, -w], 1),  # half a turn about z, undone: (0, 0, 0, -1) times it
        columns["OPACITY"][:, 0].logit(),
        torch.stack([columns[f"SH_DEGREE_{d}_COEF_{m}"] * (-1) ** (m - d) for d in range(degree + 1) for m in range(2 * d + 1)], 1),
    )
    check("glb", found, s)


VALIDATOR = """
const fs = require('fs'), validator = require(process.argv[1] + '/gltf-validator');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 99}).then(r => console.log(JSON.stringify(r.issues)));
"""


def test_khronos_validator_finds_no_error(tmp_path):
    modules = os.environ.get("SCENE_EXPERTS_NODE_MODULES")
    if not NODE or not modules or not os.path.isdir(os.path.join(modules, "gltf-validator")):
        pytest.skip("gltf-validator is not installed (SCENE_EXPERTS_NODE_MODULES names the folder that has it)")
    format_named("glb").write(tmp_path / "a.glb", scene(100, 3), {"recipe": "moe-gs"})
    done = subprocess.run([NODE, "-e", VALIDATOR, modules, str(tmp_path / "a.glb")], capture_output=True, text=True, timeout=120)
    # it ignores the extension but reads its attributes
    errors = [
        m for m in json.loads(done.stdout)["messages"] if m["severity"] == 0 and "attributes/KHR_gaussian_splatting:" not in m["pointer"]
    ]
    assert errors == []


def test_quanta_of_every_format_are_small():
    """The limits above say something: far below the spread of the values."""
    s = scene(2000, 3)
    for format in formats_of(GAUSSIANS):
        for name, limit in quanta(format, s).items():
            if not (format == "sog" and name == "sh"):
                assert float(torch.as_tensor(limit).float().mean()) < 0.35, (format, name)
