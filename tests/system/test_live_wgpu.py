"""The shaders of the live page in another compiler of WGSL, that of Firefox (naga, by the package wgpu): they decode what Python does.

It needs `pip install wgpu`, node and a driver of Vulkan, which may be one in software (Mesa's lavapipe, SwiftShader)."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from scene_experts.files.anchors import live
from support.live_scenes import CASES, compare, contents_of, decoded, look, make_run, scene_in_page
from support.places import ROOT

NODE = shutil.which("node")
wgpu = pytest.importorskip("wgpu")
pytestmark = [pytest.mark.slow, pytest.mark.foreign, pytest.mark.skipif(NODE is None, reason="node is not installed")]
SEEN = look((0.3, -0.4, -1.0))
PROGRAM = """
import { readFileSync, writeFileSync } from "node:fs";
import { packScene } from "VIEWER/pack.js";
import { decodeShader, slotWords } from "VIEWER/shaders.js";
import { openScene } from "VIEWER/worker.js";
const [page, out] = process.argv.slice(2), text = readFileSync(page, "utf8"), part = (id) => text.split(`id="${id}">`)[1].split("<")[0];
const scene = packScene(await openScene(part("scene"), JSON.parse(part("settings"))), true);
const put = (name, data) => (writeFileSync(`${out}/${name}`, Buffer.from(data.buffer, data.byteOffset, data.byteLength)), name);
const heads = scene.heads.map((head) => {
  const data = { networks: head.networks, perm: head.perm, experts: head.experts, ...(head.width > 1 ? { share: head.share } : {}) };
  const names = Object.entries(data).map(([name, value]) => put(`${head.name}.${name}`, value));
  return { code: decodeShader(scene, head), count: head.count, names };
});
const slots = scene.N * scene.K;
const words = slots * slotWords(true), anchors = put("anchors", scene.anchors);
writeFileSync(`${out}/about.json`, JSON.stringify({ heads, anchors, words, unit: scene.unit }));
"""


@pytest.fixture(scope="module")
def device():
    try:
        adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except (RuntimeError, ValueError) as error:
        pytest.skip(f"no graphics adapter: {error}")
    if adapter is None or adapter.info.get("backend_type") == "OpenGL":
        pytest.skip("no adapter with Vulkan, Metal or Direct3D")
    return adapter.request_device_sync()


def run_heads(device, folder, position):
    """What the shaders decode, [Gaussians, 16] as `LivePage.decoded` has it."""
    about, use = json.loads((folder / "about.json").read_text()), wgpu.BufferUsage
    buffer = lambda data, usage=use.STORAGE: device.create_buffer_with_data(data=data, usage=usage)  # noqa: E731
    anchors = buffer((folder / about["anchors"]).read_bytes())
    out = device.create_buffer(size=4 * about["words"], usage=use.STORAGE | use.COPY_SRC)
    camera = buffer(np.array([*position, 0], "<f4").tobytes(), use.UNIFORM)
    for head in about["heads"]:
        networks, perm, experts, *share = (buffer((folder / name).read_bytes()) for name in head["names"])
        module = device.create_shader_module(code=head["code"])
        pipeline = device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})
        held = [anchors, networks, perm, experts, out, camera, *share]
        entries = [{"binding": i, "resource": {"buffer": b, "offset": 0, "size": b.size}} for i, b in enumerate(held)]
        group = device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
        encoder = device.create_command_encoder()
        work = encoder.begin_compute_pass()
        work.set_pipeline(pipeline)
        work.set_bind_group(0, group)
        work.dispatch_workgroups(head["count"])
        work.end()
        device.queue.submit([encoder.finish()])
    found = np.frombuffer(device.queue.read_buffer(out), "<f4").reshape(-1, 16).copy()
    found[:, 4:7] *= about["unit"]
    return found


@pytest.mark.parametrize("case", CASES)
def test_another_compiler_decodes_as_python_does(tmp_path, device, case):
    run, page = make_run(case), tmp_path / "a.html"
    live.write(page, contents_of(run), {"cameras": [SEEN.pose], "nearest": 0.004})
    (tmp_path / "pack.mjs").write_text(PROGRAM.replace("VIEWER", (ROOT / "tools" / "viewer" / "live").as_uri()))
    subprocess.run([NODE, str(tmp_path / "pack.mjs"), str(page), str(tmp_path)], check=True, capture_output=True, text=True)
    centre = json.loads(re.search(rb'id="settings">(.*?)</script>', page.read_bytes(), re.DOTALL)[1])["centre"]
    found = run_heads(device, tmp_path, np.array(SEEN.pose["position"]) - centre)
    away, differ = compare(found, decoded(scene_in_page(run, page), SEEN.camera, centre))
    assert (found[:, 3] > 0).mean() > 0.05 and away < 1e-5 and differ == 0, (away, differ)
