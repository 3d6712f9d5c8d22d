"""A zip with one scene: every kind of scene, and refusals that say what is inside."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.formats import zipped
from scene_experts.files.registry import format_named, read, recognise
from support import foreign
from support.messages import naming
from support.splats import splats


def made(folder, format, **note):
    path = folder / f"scene{format_named(format).suffix}"
    format_named(format).write(path, splats(50, 1), note)
    return path


@pytest.mark.parametrize("format", ["ply", "compressed-ply", "splat", "spz", "sog", "glb"])
@pytest.mark.parametrize("deflate", [False, True])
def test_one_scene(tmp_path, format, deflate):
    inner, path = made(tmp_path, format, antialias=True), tmp_path / "a.zip"
    files = {f"my scene/{inner.name}": inner.read_bytes(), "readme.txt": b"hello", "__MACOSX/x.ply": b"x"}
    path.write_bytes(foreign.zipped(files, deflate))
    assert recognise(path)[0] == "zip"
    assert all(torch.equal(a, b) for a, b in zip(vars(read(path)).values(), vars(read(inner)).values()))
    says = format_named(format).is_antialiased
    assert zipped.is_antialiased(path) is (says is not None and says(inner))


def test_a_result_folder_with_its_points(tmp_path):
    scene, points = made(tmp_path, "ply"), {name: torch.zeros(3).numpy() for name in "xyz"}
    foreign.ply(tmp_path / "input.ply", points)
    files = {"a/point_cloud/iteration_7/point_cloud.ply": scene.read_bytes(), "a/input.ply": (tmp_path / "input.ply").read_bytes()}
    (tmp_path / "a.zip").write_bytes(foreign.zipped(files))
    assert len(read(tmp_path / "a.zip")) == 50
    (tmp_path / "a.zip").write_bytes(foreign.zipped(files | {"a/point_cloud/iteration_9/point_cloud.ply": b""}))
    with pytest.raises(InputError, match=naming("a.zip", "2 among 3")):
        read(tmp_path / "a.zip")


def test_a_ksplat_file(tmp_path):
    (tmp_path / "a.zip").write_bytes(foreign.zipped({"x.ksplat": foreign.ksplat(foreign.gaussians(30), 2)}))
    assert len(read(tmp_path / "a.zip")) == 30


def test_what_is_refused(tmp_path):
    one, other = made(tmp_path, "ply").read_bytes(), made(tmp_path, "splat").read_bytes()
    anchors = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float f_offset_0\nend_header\n0\n"
    for files, facts in (
        ({"a.ply": one, "b/c.splat": other}, ("2", "a.ply", "b/c.splat", "unpack")),
        ({"a.gltf": b"{}", "a.bin": b""}, ("0", "a.gltf", "unpack")),
        ({"b.zip": b"PK"}, ("b.zip", "unpack")),
        ({"a.ply": one[:-5]}, ("a.zip (a.ply)", "cut short", "copy it again")),
        ({"a.ply": b"words"}, ("a.zip (a.ply)",)),
        ({"a.ply": anchors}, ("a.zip (a.ply)", "anchors")),
        ({"a.sog": foreign.zipped({"b.ply": one})}, ("a.zip (a.sog)",)),
    ):
        (tmp_path / "a.zip").write_bytes(foreign.zipped(files))
        with pytest.raises(InputError, match=naming("a.zip", *facts)) as error:
            read(tmp_path / "a.zip")
        assert "/scene-experts-" not in str(error.value)  # the temporary folder


def test_bombs(tmp_path):
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999\nproperty float x\nend_header\n"
    for name, data in (
        ("a.ply", head + bytes(1 << 28)),
        ("a.sog", b"PK\x03\x04" + bytes(1 << 24)),
        ("a.spz", b"\x1f\x8b" + bytes(1 << 24)),
    ):
        (tmp_path / "a.zip").write_bytes(foreign.zipped({name: data}, deflate=True))
        with pytest.raises(InputError, match=naming("a.zip", "unpack to")):
            read(tmp_path / "a.zip")
