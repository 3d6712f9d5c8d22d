"""The reader in JavaScript, plain and compiled, decodes the same whole numbers: its checksum is that of the file."""

import importlib.util
import json
import random
import shutil
import subprocess
import zlib

import pytest
import torch

from scene_experts.files.anchors import compact
from scene_experts.files.codec import container
from support.compact import make_scene
from support.places import ROOT

READER = ROOT / "integrations" / "javascript"
PROGRAM = f"""
import {{ readFileSync }} from "node:fs";
const [how, ...paths] = process.argv.slice(2), from = (name) => import({json.dumps(READER.as_uri())} + "/" + name);
if (how === "without") globalThis.atob = () => {{ throw new Error("no module"); }};
const {{ plain }} = await from("coder.mjs"), {{ loadCoder }} = await from("compiled.mjs"), {{ readCompact }} = await from("compact.mjs");
const out = [(await loadCoder()) === plain];
for (const path of paths) {{
  try {{
    const bytes = readFileSync(path), whole = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
    const scene = await readCompact({{ plain: bytes, compiled: whole }}[how] ?? new Uint8Array(whole), how === "plain" ? plain : undefined);
    out.push([scene.checksum, [...scene.cells.slice(0, 3)], scene.groups.feature.map((c) => c[0])]);
  }} catch (error) {{
    out.push(String(error.message));
  }}
}}
console.log(JSON.stringify(out));
"""
pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


def read(folder, how, paths):
    (folder / "read.mjs").write_text(PROGRAM)
    done = subprocess.run(["node", str(folder / "read.mjs"), how, *map(str, paths)], capture_output=True, text=True, check=True)
    is_plain, *found = json.loads(done.stdout)
    assert is_plain == (how == "without")
    return found


def write_scenes(folder):
    n = 120
    g = torch.Generator().manual_seed(5)
    level = torch.arange(n) % 2
    scenes = [
        make_scene(n),
        make_scene(n, slots=torch.rand(n, 4, generator=g) < 0.5, interval=torch.rand(n, generator=g) + 0.1),
        make_scene(n, level=level, extra_level=torch.rand(n, generator=g)),
    ]
    paths = [folder / f"{i}.compact" for i in range(len(scenes))]
    for path, scene in zip(paths, scenes):
        compact.write(path, scene, {})
    return paths


@pytest.mark.parametrize("how", ["compiled", "plain", "without"])
def test_the_reader_in_javascript_finds_the_same_numbers(tmp_path, how):
    paths = write_scenes(tmp_path)
    data = paths[0].read_bytes()
    paths.append(tmp_path / "damaged.compact")
    paths[-1].write_bytes(data[:100] + b"x" + data[101:])
    *found, broken = read(tmp_path, how, paths)
    for path, (checksum, cell, feature) in zip(paths, found):
        header, _ = container.part(path.read_bytes())
        read_here = compact.read(path)
        assert checksum == header["integers"]
        assert read_here.cells is None or read_here.cells[0].tolist() == cell
        steps = torch.tensor(header["steps"]["feature"], dtype=torch.float64)
        ratio = read_here.columns["feature"][0].double() / steps / torch.tensor(feature, dtype=torch.float64)
        known = ratio[~ratio.isnan()]
        assert torch.allclose(known, known[:1].expand_as(known), rtol=1e-5)  # 2^class
    assert "checksum" in broken


@pytest.mark.parametrize("how", ["compiled", "plain"])
def test_streams_that_are_damaged_are_one_sentence(tmp_path, how):
    """Behind a right checksum of the bytes, so that the coder meets them."""
    chance, paths = random.Random(3), []
    for path in write_scenes(tmp_path):
        data = path.read_bytes()
        begin = 12 + int.from_bytes(data[8:12], "little")
        for _ in range(40):
            broken = bytearray(data[:-4])
            for at in chance.choices(range(begin, len(broken)), k=chance.choice((1, 4, 40))):
                broken[at] = chance.randrange(256)
            paths.append(tmp_path / f"broken{len(paths)}.compact")
            paths[-1].write_bytes(bytes(broken) + zlib.crc32(broken).to_bytes(4, "little"))
    said = read(tmp_path, how, paths)
    assert all(isinstance(one, str) for one in said)  # never a scene of other numbers
    assert sum(one.startswith("expected a compact file that this version reads, found") for one in said) > 100


def with_header(data, **changes):
    """The file with another header. lattices: entries of the first one, by number."""
    end = 12 + int.from_bytes(data[8:12], "little")
    header = json.loads(zlib.decompress(data[12:end]))
    for at, value in changes.pop("lattice", {}).items():
        header["lattices"][0][at] = value
    packed = zlib.compress(json.dumps({**header, **changes}).encode())
    body = data[:8] + len(packed).to_bytes(4, "little") + packed + data[end:-4]
    return body + zlib.crc32(body).to_bytes(4, "little")


@pytest.mark.parametrize("how", ["compiled", "plain"])
def test_headers_out_of_range_are_one_sentence(tmp_path, how):
    data = write_scenes(tmp_path)[0].read_bytes()
    changes = [{"lattice": {at: value}} for at, value in ((6, 22), (6, 10**6), (6, 1.5), (5, 1.5), (5, 10**8), (4, 0), (3, [0, 0]), (2, 0))]
    changes += [{"lattice": {4: 10**8, 5: 10**8, 6: 21}, "N": 10**8}]  # read no further than the stream goes
    changes += [{"N": -1}, {"N": 1e10}, {"F": 0}, {"K": 10**9}, {"boxes": [64, 0]}, {"boxes": [3]}]
    paths = []
    for i, change in enumerate(changes):
        paths.append(tmp_path / f"{i}.changed")
        paths[-1].write_bytes(with_header(data, **change))
    said = read(tmp_path, how, paths)
    assert all(isinstance(one, str) and "expected a compact file" in one for one in said), said


def test_the_compiled_reader_is_made_of_its_sources():
    """`python tools/wasm/build.py` makes it."""
    spec = importlib.util.spec_from_file_location("build_wasm", ROOT / "tools" / "wasm" / "build.py")
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    assert build.FILE.read_text().splitlines()[1] == f"// {build.checksum()}", "build it: python tools/wasm/build.py"
