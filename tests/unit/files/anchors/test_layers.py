"""Layers: with all chunks the whole scene, with fewer a scene, and one sentence for damaged ones."""

import json
import shutil
import subprocess

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.anchors import compact, layers
from support.compact import make_scene
from support.layers import make_coarse, make_layers, open_layers
from support.places import ROOT


def scenes(n=120):
    g = torch.Generator().manual_seed(5)
    return [
        make_scene(n),
        make_scene(n, slots=torch.rand(n, 4, generator=g) < 0.5, interval=torch.rand(n, generator=g) + 0.1),
        make_scene(n, level=torch.arange(n) % 3, extra_level=torch.rand(n, generator=g)),
        make_scene(n, spread=2),  # several anchors in a cell
    ]


def sorted_rows(data):
    order = data.columns["feature"][:, 0].argsort()  # each row's number
    return {name: value[order] for name, value in data.columns.items()}


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(layers, "ANCHORS", 30)


@pytest.mark.parametrize("case", range(4))
@pytest.mark.parametrize("share", [0.4, 1.0, 0.05])
def test_all_chunks_are_the_scene_of_the_compact_file(tmp_path, case, share):
    data = scenes()[case]
    compact.write(tmp_path / "a.compact", data, {})
    wanted, made = compact.read(tmp_path / "a.compact"), make_layers(data, share)
    scene = open_layers(tmp_path, made)
    assert scene.chunks == len(made.chunks) == 4
    seen = [len(scene.restored().columns["feature"])]
    for chunk in made.chunks:
        scene.take(chunk)
        seen.append(len(scene.restored().columns["feature"]))
    found = scene.restored()
    assert seen == sorted(seen) and seen[-1] == 120 and made.size == sum(map(len, (made.coarse, made.plan, *made.chunks)))
    a, b = sorted_rows(found), sorted_rows(wanted)
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    assert all(torch.equal(found.networks[name], value) for name, value in wanted.networks.items())


def test_chunks_of_the_first_view_come_first_and_refine_their_part_of_the_curve(tmp_path):
    data = make_scene(120)
    made = make_layers(data)
    scene = open_layers(tmp_path, made)
    coarse = scene.restored()
    scene.take(made.chunks[0])
    part = scene.restored()
    number = lambda data: set(data.columns["feature"][:, 0].round().int().tolist())  # noqa: E731
    assert number(coarse) <= {round(v) for v in number(part)} or len(number(part)) > len(number(coarse))
    _, changed = make_coarse(data)
    assert len(coarse.columns["feature"]) == len(changed.columns["feature"]) and "slots" in part.columns


def test_damaged_layers_are_refused(tmp_path):
    made, other = make_layers(make_scene(120)), make_layers(make_scene(120, seed=3))
    with pytest.raises(InputError, match=r"coarse\.compact"):
        open_layers(tmp_path, made, other.plan)
    for broken in (made.plan[:-9], made.plan[:60] + b"x" + made.plan[61:], b""):
        with pytest.raises(InputError):
            open_layers(tmp_path, made, broken)
    scene = open_layers(tmp_path, made)
    for broken in (made.chunks[0][:-1], b"", b"abc", made.chunks[0][:9] + b"x" + made.chunks[0][10:]):
        with pytest.raises(ValueError, match="checksum"):
            scene.take(broken)
    with pytest.raises(ValueError):
        scene.take(made.chunks[1])  # a chunk out of its turn
    with pytest.raises(InputError, match="classes"):
        rows, coarse = make_coarse(make_scene(120))
        coarse.precision.classes[:] = 0
        layers.encode(make_scene(120), rows, coarse, torch.zeros(120))


PROGRAM = f"""
import {{ readFileSync, readdirSync }} from "node:fs";
import {{ plain }} from {json.dumps((ROOT / "integrations/javascript/coder.mjs").as_uri())};
import {{ readCompact }} from {json.dumps((ROOT / "integrations/javascript/compact.mjs").as_uri())};
import {{ LayeredScene }} from {json.dumps((ROOT / "integrations/javascript/layers.mjs").as_uri())};
const out = [], bytes = (path) => new Uint8Array(readFileSync(path));
for (const folder of process.argv.slice(3)) {{
  const coder = process.argv[2] === "plain" ? plain : undefined;
  const scene = await LayeredScene.open(await readCompact(bytes(folder + "/coarse"), coder), bytes(folder + "/plan"), coder);
  let counts = [scene.scene().header.N], said = "";
  for (let i = 0; i < scene.total; ++i) {{
    try {{ scene.take(bytes(folder + "/" + i)); }} catch (error) {{ said = error.message; break; }}
    const now = scene.scene();
    counts.push(now.header.N);
    if (now.groups.feature[0].length !== now.header.N || now.cells.length !== 3 * now.header.N) throw new Error("sizes");
  }}
  out.push([scene.checksum(), counts, said]);
}}
console.log(JSON.stringify(out));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
@pytest.mark.parametrize("coder", ["plain", "compiled"])
def test_the_reader_in_javascript_finds_the_same_numbers(tmp_path, coder):
    made = [make_layers(data) for data in scenes()]
    for i, one in enumerate([*made, made[0]]):
        (tmp_path / str(i)).mkdir()
        for name, part in {"coarse": one.coarse, "plan": one.plan, **{str(j): c for j, c in enumerate(one.chunks)}}.items():
            (tmp_path / str(i) / name).write_bytes(part if (i, name) != (len(made), "1") else part[:-5] + b"xx" + part[-3:])
    (tmp_path / "read.mjs").write_text(PROGRAM)
    folders = [str(tmp_path / str(i)) for i in range(len(made) + 1)]
    done = subprocess.run(["node", str(tmp_path / "read.mjs"), coder, *folders], capture_output=True, text=True, check=True)
    *found, broken = json.loads(done.stdout)
    for one, (checksum, counts, said) in zip(made, found):
        scene = open_layers(tmp_path, one)
        wanted = [len(scene.restored().columns["feature"])]
        for chunk in one.chunks:
            scene.take(chunk)
            wanted.append(len(scene.restored().columns["feature"]))
        assert checksum == scene.header["integers"] and counts == wanted and said == ""
    assert "checksum" in broken[2] and len(broken[1]) == 2
