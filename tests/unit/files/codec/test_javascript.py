"""The reader in JavaScript decodes the same whole numbers: its checksum is that of the file and of the reader in Python."""

import json
import shutil
import subprocess

import pytest
import torch

from scene_experts.files.anchors import compact
from scene_experts.files.codec import container
from support.compact import make_scene
from support.places import ROOT

READER = ROOT / "integrations" / "javascript" / "compact.mjs"
PROGRAM = f"""
import {{ readFileSync }} from "node:fs";
import {{ readCompact }} from {json.dumps(READER.as_uri())};
const out = [];
for (const path of process.argv.slice(2)) {{
  try {{
    const scene = await readCompact(new Uint8Array(readFileSync(path)));
    out.push([scene.checksum, [...scene.cells.slice(0, 3)], scene.groups.feature.map((c) => c[0])]);
  }} catch (error) {{
    out.push(String(error.message));
  }}
}}
console.log(JSON.stringify(out));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_reader_in_javascript_finds_the_same_numbers(tmp_path):
    n = 120
    g = torch.Generator().manual_seed(5)
    level = torch.arange(n) % 2
    scenes = [
        make_scene(n),
        make_scene(n, slots=torch.rand(n, 4, generator=g) < 0.5, interval=torch.rand(n, generator=g) + 0.1),
        make_scene(n, level=level, extra_level=torch.rand(n, generator=g)),
    ]
    paths = []
    for i, scene in enumerate(scenes):
        paths.append(tmp_path / f"{i}.compact")
        compact.write(paths[-1], scene, {})
    data = paths[0].read_bytes()
    paths.append(tmp_path / "damaged.compact")
    paths[-1].write_bytes(data[:100] + b"x" + data[101:])
    (tmp_path / "read.mjs").write_text(PROGRAM)
    done = subprocess.run(["node", str(tmp_path / "read.mjs"), *map(str, paths)], capture_output=True, text=True, check=True)
    *found, broken = json.loads(done.stdout)
    for path, (checksum, cell, feature) in zip(paths, found):
        header, _ = container.part(path.read_bytes())
        read = compact.read(path)
        assert checksum == header["integers"]
        assert read.cells is None or read.cells[0].tolist() == cell
        steps = torch.tensor(header["steps"]["feature"], dtype=torch.float64)
        ratio = read.columns["feature"][0].double() / steps / torch.tensor(feature, dtype=torch.float64)
        known = ratio[~ratio.isnan()]
        assert torch.allclose(known, known[:1].expand_as(known), rtol=1e-5)  # 2^class
    assert "checksum" in broken
