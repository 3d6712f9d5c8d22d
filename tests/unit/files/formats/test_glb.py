"""glTF: exact, as a plain glTF parser sees it in glTF's own frame, and damaged files in one sentence."""

import base64
import json
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files.formats import glb, spz
from scene_experts.files.registry import read, recognise
from scene_experts.geometry.rotation import covariance
from scene_experts.geometry.sh import sh_to_rgb
from support import foreign
from support.gltf import column, parsed
from support.messages import naming
from support.splat_quanta import check, scene


@given(st.integers(0, 200), st.integers(0, 3), st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_round_trip_is_exact(tmp_path_factory, n, degree, seed):
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    s = scene(n, degree if n else 0, seed)
    glb.write(path, s, {})
    check("glb", glb.read(path), s)


def test_what_a_gltf_viewer_sees_is_the_scene_half_turned(tmp_path):
    """Covariances and colours in glTF's frame are those of ours, turned by 180 degrees about z."""
    s = scene(50, 3)
    glb.write(tmp_path / "a.glb", s, {"recipe": "moe-gs"})
    doc, body = parsed(tmp_path / "a.glb")
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    get = lambda name: torch.from_numpy(column(doc, body, name).copy())  # noqa: E731
    torch.testing.assert_close(get("POSITION"), s.means @ turn)
    q, lengths = get("KHR_gaussian_splatting:ROTATION"), get("KHR_gaussian_splatting:SCALE")
    torch.testing.assert_close(q.norm(dim=1), torch.ones(50))
    ours = covariance(torch.nn.functional.normalize(s.quats, dim=1), s.log_scales.exp())
    torch.testing.assert_close(covariance(q[:, [3, 0, 1, 2]], lengths), turn @ ours @ turn, rtol=1e-4, atol=1e-7)
    names = [f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)]
    sh, look = torch.stack([get(name) for name in names], 1), torch.randn(50, 3)
    torch.testing.assert_close(sh_to_rgb(sh, look @ turn, 3), sh_to_rgb(s.sh, look, 3), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(get("KHR_gaussian_splatting:OPACITY")[:, 0], s.opacity_logit.sigmoid())
    assert doc["extensionsUsed"] == ["KHR_gaussian_splatting"] and doc["asset"]["extras"] == {"scene-experts": {"recipe": "moe-gs"}}
    primitive = doc["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    low = doc["accessors"][primitive["attributes"]["POSITION"]]["min"]
    np.testing.assert_allclose(low, get("POSITION").numpy().min(0))


def rebuilt(path, doc, body):
    text = json.dumps(doc).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def test_normalised_bytes_and_strides(tmp_path):
    """Opacities as bytes and interleaved positions, as other writers have them."""
    path = tmp_path / "a.glb"
    s = scene(10, 0)
    glb.write(path, s, {})
    doc, body = parsed(path)
    alpha = np.arange(10, dtype=np.uint8) * 20
    place = np.zeros((10, 5), np.float32)
    place[:, :3] = s.means.numpy()
    doc["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(body), "byteLength": 10},
        {"buffer": 0, "byteOffset": len(body) + 12, "byteLength": 200, "byteStride": 20},
    ]
    doc["accessors"] += [
        {"bufferView": len(doc["bufferViews"]) - 2, "componentType": 5121, "normalized": True, "count": 10, "type": "SCALAR"},
        {"bufferView": len(doc["bufferViews"]) - 1, "componentType": 5126, "count": 10, "type": "VEC3"},
    ]
    attributes = doc["meshes"][0]["primitives"][0]["attributes"]
    attributes["KHR_gaussian_splatting:OPACITY"], attributes["POSITION"] = len(doc["accessors"]) - 2, len(doc["accessors"]) - 1
    rebuilt(path, doc, body + alpha.tobytes() + b"\0\0" + place.tobytes())
    found = glb.read(path)
    torch.testing.assert_close(found.opacity_logit.sigmoid()[1:], torch.from_numpy(alpha[1:] / 255).float())
    torch.testing.assert_close(found.means, s.means * torch.tensor([-1.0, -1.0, 1.0]))


def test_transforms_of_nodes_are_told(tmp_path, caplog):
    path = tmp_path / "a.glb"
    glb.write(path, scene(5, 0), {})
    doc, body = parsed(path)
    identity = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    for nodes, told in (
        ([{"mesh": 0, "rotation": [0, 0, 0, 1.0], "scale": [1, 1, 1]}, {"matrix": identity, "children": [0]}], False),
        ([{"mesh": 0}, {"camera": 0, "translation": [1, 2, 3]}], False),
        ([{"mesh": 0}, {"children": [0]}, {"children": [1], "translation": [0, 0, 1]}], True),
        ([{"mesh": 0, "children": [1]}, {"children": [0], "scale": [2, 2, 2]}], True),
        ([{"mesh": 0, "children": [0]}], False),
    ):
        rebuilt(path, doc | {"nodes": nodes}, body)
        caplog.clear()
        assert len(glb.read(path)) == 5 and (str(path) in caplog.text and "not applied" in caplog.text) is told


@pytest.mark.parametrize(("name", "value"), [("colorSpace", "lin_rec709_display"), ("kernel", "box"), ("sortingMethod", "other")])
def test_another_colour_space_or_kernel_is_told(tmp_path, caplog, name, value):
    path = tmp_path / "a.glb"
    glb.write(path, scene(5, 1), {})
    glb.read(path)
    assert not caplog.records
    doc, body = parsed(path)
    doc["meshes"][0]["primitives"][0]["extensions"][glb.NAME][name] = value
    rebuilt(path, doc, body)
    assert len(glb.read(path)) == 5
    assert (value in caplog.text and str(path) in caplog.text) is (name != "sortingMethod")  # how it is drawn is not what it is


def test_damaged_files(tmp_path):
    path = tmp_path / "a.glb"
    glb.write(path, scene(20, 1), {})
    good, (doc, body) = path.read_bytes(), parsed(path)

    def refused(fact=""):
        with pytest.raises(InputError, match=naming(path, fact)):
            glb.read(path)

    for data in (good[:-8], good[:10], b"glTF" + bytes(40)):
        path.write_bytes(data)
        refused()
    for change, fact in (
        (lambda d: d["accessors"][0].update(count=10**9), "accessor 0"),
        (lambda d: d["accessors"][0].update(count=float("inf")), ""),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "accessor 0"),
        (lambda d: d["accessors"][0].update(componentType=1), ""),
        (lambda d: d["accessors"][3].update(count=19), ""),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), ""),
        (lambda d: d.update(meshes=[], extensionsUsed=[]), "KHR_gaussian_splatting"),
        (lambda d: d.update(meshes=5), ""),
        (lambda d: d.update(meshes=[], extensionsUsed=None), ""),
        (lambda d: d["accessors"][2].update(type="VEC3"), ""),
        (lambda d: d["accessors"][0].update(type="VEC2"), ""),
    ):
        changed = json.loads(json.dumps(doc))
        change(changed)
        rebuilt(path, changed, body)
        refused(fact)
    rebuilt(path, [1], body)
    refused()


# --- packed as SPZ, and text files --------------------------------------------------------------------------------------------------------

EXTENSIONS = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
    "KHR_spz_compression",
)


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(vars(a).values(), vars(b).values()))


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("uri", [None, "data", "x.bin", "sub/my%20x.bin"])
def test_an_spz_file_inside(tmp_path, extension, uri):
    """The Gaussians are those of the SPZ file alone: its frame is glTF's, turned about y."""
    data = spz.spz_bytes(scene(40, 2))
    (tmp_path / "in.spz").write_bytes(data)
    name = "data:application/octet-stream;base64," + base64.b64encode(data).decode() if uri == "data" else uri
    if uri not in (None, "data"):
        place = tmp_path / uri.replace("%20", " ")
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(data)
    path = tmp_path / f"a.{'glb' if uri is None else 'gltf'}"
    path.write_bytes(foreign.gltf_of(foreign.with_spz(40, len(data), extension), data, name))
    assert recognise(path)[0] == "glb" and same(read(path), read(tmp_path / "in.spz"))


def test_plain_and_packed_primitives_together(tmp_path):
    path, data = tmp_path / "a.glb", spz.spz_bytes(scene(30, 3))
    glb.write(path, scene(20, 1), {})
    doc, body = parsed(path)
    body += b"\0" * (-len(body) % 4)
    doc["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
    packed = {"KHR_gaussian_splatting": {"extensions": {EXTENSIONS[0]: {"bufferView": len(doc["bufferViews"]) - 1}}}}
    doc["meshes"][0]["primitives"].append({"attributes": {}, "mode": 0, "extensions": packed})
    doc["buffers"][0]["byteLength"] = len(body) + len(data)
    rebuilt(path, doc, body + data)
    found = glb.read(path)
    assert len(found) == 50 and found.degree == 1


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("start", ["", "\ufeff", "\n  "])
def test_text_files_are_as_exact_as_binary_ones(tmp_path, inside, start):
    s = scene(30, 2)
    glb.write(tmp_path / "a.glb", s, {})
    doc, body = parsed(tmp_path / "a.glb")
    (tmp_path / "a b.bin").write_bytes(body)
    doc["buffers"][0]["uri"] = "data:application/gltf-buffer;base64," + base64.b64encode(body).decode() if inside else "a%20b.bin"
    (tmp_path / "a.gltf").write_text(start + json.dumps(doc, indent=1), "utf-8")
    check("glb", read(tmp_path / "a.gltf"), s)


def test_what_text_files_may_not_name(tmp_path):
    glb.write(tmp_path / "a.glb", scene(10, 0), {})
    doc, body = parsed(tmp_path / "a.glb")
    (tmp_path / "x.bin").write_bytes(body)
    path = tmp_path / "folder" / "a.gltf"
    path.parent.mkdir()
    (path.parent / "link.bin").symlink_to(tmp_path / "x.bin")
    (path.parent / "short.bin").write_bytes(body[:-1])
    for uri, fact in (
        ("../x.bin", "leads out"),
        ("%2e%2e/x.bin", "leads out"),
        (str(tmp_path / "x.bin"), "leads out"),
        ("link.bin", "leads out"),
        ("https://example.org/x.bin", "https://example.org/x.bin"),
        ("absent.bin", "no such file"),
        ("short.bin", "copy it again"),
        ("data:text/plain,abc", "base64"),
        ("data:;base64,???", ""),
        (None, "buffer 0"),
        (7, "buffer 0"),
    ):
        doc["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(doc))
        with pytest.raises(InputError, match=naming("folder", fact)):
            glb.read(path)


def test_what_packed_files_are_refused_for(tmp_path):
    path, data = tmp_path / "a.glb", spz.spz_bytes(scene(40, 0))
    good = foreign.with_spz(40, len(data), EXTENSIONS[0])

    def refused(change, fact, copied=False):
        doc = json.loads(json.dumps(good))
        change(doc)
        path.write_bytes(foreign.gltf_of(doc, data))
        with pytest.raises(InputError, match=naming(path, fact)) as error:
            glb.read(path)
        assert ("copy it" in str(error.value)) is copied

    def unknown(doc):
        inner = doc["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"]
        inner["KHR_other_packing"] = inner.pop(EXTENSIONS[0])
        doc["extensionsUsed"] = ["KHR_gaussian_splatting", "KHR_other_packing"]

    refused(unknown, "KHR_other_packing")
    refused(lambda d: d["bufferViews"][0].update(byteLength=10**6), "buffer view 0", copied=True)
    refused(lambda d: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "EXT_meshopt_compression")
    refused(lambda d: d["bufferViews"][0].pop("byteLength"), "'byteLength'")
    refused(lambda d: d.update(bufferViews=[]), "")
