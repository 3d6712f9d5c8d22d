"""PLY files against plyfile and the layouts of Scaffold-GS, Octree-GS and 3DGS; notes in their headers come back."""

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.read import read_anchors
from scene_experts.files.formats import ply
from scene_experts.files.formats.splats import Splats
from support import foreign
from support.files import write_anchor_ply
from support.messages import naming
from support.splats import splats

K, F = 10, 32


def anchors(n=7):
    torch.manual_seed(0)
    return torch.randn(n, 3), torch.randn(n, K, 3), torch.randn(n, F), torch.randn(n, 6)


def test_anchor_layout_as_scaffold_gs_has_it(tmp_path):
    xyz, offsets, feature, scaling = anchors()
    write_anchor_ply(tmp_path / "p.ply", xyz, offsets, feature, scaling)
    vertex = PlyData.read(tmp_path / "p.ply")["vertex"]
    names = [p.name for p in vertex.properties]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz"]
        + [f"f_offset_{i}" for i in range(30)]
        + [f"f_anchor_feat_{i}" for i in range(32)]
        + ["opacity"]
        + [f"scale_{i}" for i in range(6)]
        + [f"rot_{i}" for i in range(4)]
    )
    assert vertex.data.dtype.itemsize == 316 and {vertex.data.dtype[i].str for i in range(79)} == {"<f4"}
    header = (tmp_path / "p.ply").read_bytes().index(b"end_header\n") + len("end_header\n")
    assert (tmp_path / "p.ply").stat().st_size == header + 7 * 316
    for k in range(K):
        for c in range(3):
            assert np.array_equal(vertex[f"f_offset_{c * K + k}"], offsets[:, k, c].numpy())
    assert np.array_equal(vertex["y"], xyz[:, 1].numpy()) and np.array_equal(vertex["scale_5"], scaling[:, 5].numpy())
    assert np.array_equal(vertex["f_anchor_feat_31"], feature[:, 31].numpy())
    np.testing.assert_allclose(vertex["opacity"], -2.1972246, rtol=1e-7)
    assert (vertex["rot_0"] == 1).all() and not any(vertex[name].any() for name in ("nx", "ny", "nz", "rot_1", "rot_2", "rot_3"))


def test_anchors_round_trip_bit_for_bit(tmp_path):
    for n in (0, 1, 100):
        xyz, offsets, feature, scaling = anchors(n)
        write_anchor_ply(tmp_path / "p.ply", xyz, offsets, feature, scaling)
        found = read_anchors(tmp_path / "p.ply")
        for name, value in zip(("xyz", "offsets", "feature", "log_scaling"), (xyz, offsets, feature, scaling)):
            assert torch.equal(found[name], value) and found[name].is_contiguous()
        assert "level" not in found


@pytest.mark.parametrize("form", ["<", ">", "ascii"])
def test_octree_gs_layout_in_any_order_and_encoding(tmp_path, form):
    names = ["x", "y", "z", "level", "extra_level", "info"]
    names += [f"f_offset_{i}" for i in (3, 1, 2, 0, 5, 4)] + ["f_anchor_feat_1", "f_anchor_feat_0", "opacity"]
    names += [f"scale_{i}" for i in range(6)] + [f"rot_{i}" for i in range(4)]
    table = np.zeros(4, [(name, "f4") for name in names])
    for i, name in enumerate(names):
        table[name] = i + np.arange(4) * 100
    table["level"] = [0, 1, 2, 5]
    table["info"] = [0.5, 12.25, 0, 0]
    data = PlyData([PlyElement.describe(table, "vertex")], text=form == "ascii", byte_order=form if form != "ascii" else "=")
    data.write(tmp_path / "o.ply")
    found = read_anchors(tmp_path / "o.ply")
    assert found["level"].tolist() == [0, 1, 2, 5] and found["level"].dtype == torch.int64
    assert found["info"][:2].tolist() == [0.5, 12.25] and found["extra_level"].tolist() == [4.0, 104.0, 204.0, 304.0]
    for k in range(2):
        for c in range(3):
            assert found["offsets"][1, k, c] == table[f"f_offset_{c * 2 + k}"][1]
    assert found["feature"][0].tolist() == [table["f_anchor_feat_0"][0], table["f_anchor_feat_1"][0]]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_3dgs_layout(tmp_path, degree):
    torch.manual_seed(1)
    n, C = 5, (degree + 1) ** 2
    value = {
        "means": torch.randn(n, 3),
        "sh": torch.randn(n, C, 3),
        "opacity_logit": torch.randn(n),
        "log_scales": torch.randn(n, 3),
        "quats": torch.randn(n, 4),
    }
    ply.write(tmp_path / "g.ply", Splats(**value), {})
    vertex = PlyData.read(tmp_path / "g.ply")["vertex"]
    assert [p.name for p in vertex.properties][:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert vertex.data.dtype.itemsize == 4 * (14 + 3 * C) and (degree != 3 or vertex.data.dtype.itemsize == 248)
    for channel in range(3):
        for i in range(1, C):
            assert np.array_equal(vertex[f"f_rest_{channel * (C - 1) + i - 1}"], value["sh"][:, i, channel].numpy())
    for normals in (True, False):
        ply.write(tmp_path / "g.ply", Splats(**value), {}, normals)
        found = vars(ply.read(tmp_path / "g.ply"))
        assert found.keys() == value.keys() and all(torch.equal(found[k], value[k]) for k in value)


def test_every_type_and_later_elements(tmp_path):
    codes = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
    columns = {f"c_{code}": np.array([0, 1, 100], code) for code in codes}
    ply.write_vertices(tmp_path / "t.ply", columns)
    found = ply.read_vertices(tmp_path / "t.ply")
    assert all(np.array_equal(found[k], v) and found[k].dtype == v.dtype for k, v in columns.items())
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    vertices = np.array([(1.0, 2.0)] * 3, dtype=[("x", "f8"), ("y", "f4")])
    PlyData([PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]).write(tmp_path / "f.ply")
    assert ply.read_vertices(tmp_path / "f.ply")["x"].tolist() == [1.0, 1.0, 1.0]


def test_windows_line_ends(tmp_path):
    text = b"ply\r\nformat ascii 1.0\r\nelement vertex 2\r\nproperty float x\r\nend_header\r\n1.5\r\n2.5\r\n"
    (tmp_path / "w.ply").write_bytes(text)
    assert ply.read_vertices(tmp_path / "w.ply")["x"].tolist() == [1.5, 2.5]


HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("data", "fact"),
    [
        (b"", ""),
        (b"plain text", ""),
        (HEADER[:-5], ""),
        (HEADER + bytes(7), 2),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1\n", 2),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1\n1 2\n", 1),
        (HEADER.replace(b"binary_little_endian", b"ascii") + b"1\nx\n", 1),
        (HEADER.replace(b"float", b"quad"), "quad"),
        (HEADER.replace(b"binary_little_endian", b"morse"), "morse"),
        (HEADER.replace(b"property float x", b"property list uchar int x"), "list"),
        (HEADER.replace(b"vertex 2", b"face 2"), "vertex"),
        (HEADER.replace(b"vertex 2", b"vertex -2"), ""),
        (HEADER.replace(b"vertex 2", b"vertex two"), ""),
        (HEADER.replace(b"vertex 2", b"vertex 999999999999999"), "999,999,999,999,999"),
        (HEADER.replace(b"property float x", b"property float x\nproperty float x"), ""),
        (HEADER.replace(b"property float x\n", b""), ""),
        (HEADER.replace(b"vertex 2", b"vertex 0"), "f_anchor_feat_*"),
        (HEADER.replace(b"vertex 2", b"vertex 0").replace(b"float x", b"float f_dc_0"), "3DGS"),
        (HEADER.replace(b"vertex 2", b"vertex 0").replace(b"float x", b"float f_offset_0"), "x, y, z"),
    ],
)
def test_damaged_or_other_files(tmp_path, data, fact):
    (tmp_path / "bad.ply").write_bytes(data)
    with pytest.raises(InputError, match=naming("bad.ply", fact)):
        read_anchors(tmp_path / "bad.ply")


def test_an_absent_file_and_values_that_are_not_finite(tmp_path):
    with pytest.raises(InputError, match=naming("absent.ply")):
        ply.read_vertices(tmp_path / "absent.ply")
    xyz, offsets, feature, scaling = anchors()
    feature[3, 4] = float("nan")
    write_anchor_ply(tmp_path / "p.ply", xyz, offsets, feature, scaling)
    with pytest.raises(InputError, match=naming("feature", "p.ply")):
        read_anchors(tmp_path / "p.ply")
    xyz, offsets, feature, scaling = anchors()
    for name, value in (("level", float("nan")), ("level", 1e9), ("level", -3.0), ("extra_level", float("inf")), ("info", float("nan"))):
        levels = {column: torch.ones(len(xyz)) for column in ("level", "extra_level", "info")}
        levels[name][2] = value
        write_anchor_ply(tmp_path / "p.ply", xyz, offsets, feature, scaling, levels)
        with pytest.raises(InputError, match=naming(0, 64, "p.ply")):
            read_anchors(tmp_path / "p.ply")
    with pytest.raises(InputError, match=naming("point_cloud/iteration_N", "p.ply")):
        ply.read(tmp_path / "p.ply")
    ply.write_vertices(tmp_path / "q.ply", {"x": np.zeros(1, np.float32)})
    with pytest.raises(InputError, match=naming("3DGS", "q.ply")):
        ply.read(tmp_path / "q.ply")


def test_a_note_comes_back_and_readers_skip_it(tmp_path):
    note = {"recipe": "moe-gs", "psnr": 21.5, "words": "é\nend_header\n", "list": [1, None, True]}
    lines = ply.note_comments(note)
    assert len(lines) == 1 and lines[0].isascii() and "\n" not in lines[0]
    assert ply.note_comments({}) == []
    path = tmp_path / "a.ply"
    ply.write_vertices(path, {"x": np.arange(3, dtype=np.float32)}, ply.note_comments(note | {"words": "é"}))
    assert ply.read_note(path) == note | {"words": "é"}
    assert ply.read_vertices(path)["x"].tolist() == [0, 1, 2] and PlyData.read(path)["vertex"].count == 3
    ply.write_vertices(path, {"x": np.arange(3, dtype=np.float32)}, ply.note_comments(note))
    assert ply.read_vertices(path)["x"].tolist() == [0, 1, 2] and ply.read_note(path) == note


def test_no_note_a_foreign_one_and_a_long_one(tmp_path):
    path = tmp_path / "a.ply"
    ply.write_vertices(path, {"x": np.zeros(1, np.float32)}, ["made by hand"])
    assert ply.read_note(path) == {}
    ply.write_vertices(path, {"x": np.zeros(1, np.float32)}, ["scene-experts {broken"])
    assert ply.read_note(path) == {}
    ply.write_vertices(path, {"x": np.zeros(1, np.float32)}, ["scene-experts [1]"])
    assert ply.read_note(path) == {}
    for value in (1, "true", False):
        ply.write_vertices(path, {"x": np.zeros(1, np.float32)}, ply.note_comments({"antialias": value}))
        assert not ply.is_antialiased(path)
    (line,) = ply.note_comments({"psnr": 1.0, "figures": list(range(100_000))})
    assert line == 'scene-experts {"psnr": 1.0}'


def test_the_names_in_a_header(tmp_path):
    ply.write_vertices(tmp_path / "a.ply", {"x": np.zeros(1, np.float32), "f_dc_0": np.zeros(1, np.float32)}, ["property float no"])
    assert ply.property_names(tmp_path / "a.ply") == {"x", "f_dc_0"}
    (tmp_path / "b").write_bytes(b"other")
    assert ply.property_names(tmp_path / "b") == set() == ply.property_names(tmp_path / "absent")


def test_the_filter_of_mip_splatting_is_told(tmp_path, caplog):
    ply.write(tmp_path / "a.ply", splats(4), {})
    ply.read(tmp_path / "a.ply")
    assert not caplog.records
    columns = ply.read_vertices(tmp_path / "a.ply") | {"filter_3D": np.full(4, 0.1, np.float32)}
    ply.write_vertices(tmp_path / "b.ply", columns)
    assert len(ply.read(tmp_path / "b.ply")) == 4
    assert str(tmp_path / "b.ply") in caplog.text and "filter_3D" in caplog.text and "not applied" in caplog.text


# --- columns of other programs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_2dgs_gets_a_thin_third_scale(tmp_path, caplog, form):
    s = foreign.gaussians(20, 1)
    columns = foreign.ply_columns(s)
    del columns["scale_2"]
    foreign.ply(tmp_path / "a.ply", columns, form)
    found = ply.read(tmp_path / "a.ply")
    assert np.array_equal(found.log_scales[:, :2].numpy(), s["log_scales"][:, :2]) and "2DGS" in caplog.text
    np.testing.assert_allclose(found.log_scales[:, 2], np.log(1e-6), rtol=1e-6)
    assert np.array_equal(found.sh.numpy(), s["sh"])


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize(
    ("kind", "full", "names"),
    [
        ("u1", 255, ("red", "green", "blue")),
        ("u2", 65535, ("red", "green", "blue")),
        ("u2", 255, ("red", "green", "blue")),
        ("f4", 1, ("red", "green", "blue")),
        ("f4", 255, ("r", "g", "b")),
        ("f8", 1, ("diffuse_red", "diffuse_green", "diffuse_blue")),
    ],
)
def test_colours_become_harmonics_of_degree_0(tmp_path, caplog, kind, full, names, form):
    s = foreign.gaussians(50)
    columns = {name: values for name, values in foreign.ply_columns(s).items() if not name.startswith("f_dc")}
    colour = np.random.default_rng(1).uniform(0, 1.2 if full == 1 else 1, (50, 3))  # harmonics may be brighter than 1
    stored = (np.rint(colour * full) if kind.startswith("u") else colour * full).astype(kind)
    foreign.ply(tmp_path / "a.ply", columns | {name: stored[:, i] for i, name in enumerate(names)}, form)
    found = ply.read(tmp_path / "a.ply")
    assert found.degree == 0 and str(tmp_path / "a.ply") in caplog.text and names[0] in caplog.text
    np.testing.assert_allclose(found.sh[:, 0], (stored.astype(np.float64) / full - 0.5) / foreign.C0, atol=1e-5)
    assert np.array_equal(found.opacity_logit.numpy(), s["logits"])


def test_harmonics_go_before_colours(tmp_path, caplog):
    s = foreign.gaussians(20)
    foreign.ply(tmp_path / "a.ply", foreign.ply_columns(s) | {name: np.zeros(20, np.uint8) for name in ("red", "green", "blue")})
    assert np.array_equal(ply.read(tmp_path / "a.ply").sh.numpy(), s["sh"]) and not caplog.records


def test_zero_rows_are_left_out_and_infinite_opacities_kept(tmp_path, caplog):
    s = foreign.gaussians(40, 1)
    columns = {name: values.copy() for name, values in foreign.ply_columns(s).items()}
    for values in columns.values():
        values[25:] = 0
    columns["opacity"][3], columns["opacity"][4], columns["scale_1"][5] = np.inf, -np.inf, -np.inf
    foreign.ply(tmp_path / "a.ply", columns)
    found = ply.read(tmp_path / "a.ply")
    assert len(found) == 25 and "15 of 40" in caplog.text
    assert found.opacity_logit.sigmoid()[3:5].tolist() == [1, pytest.approx(0, abs=1e-8)] and found.log_scales[5, 1] < -69
    for values in columns.values():
        values[:] = 0
    foreign.ply(tmp_path / "a.ply", columns)
    with pytest.raises(InputError, match=naming("a.ply", 40)):
        ply.read(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["opacity", "red"])
def test_what_stays_refused(tmp_path, name):
    columns = {k: v.copy() for k, v in foreign.ply_columns(foreign.gaussians(20)).items() if not k.startswith("f_dc")}
    columns |= {k: np.full(20, 0.5, np.float32) for k in ("red", "green", "blue")}
    columns[name][7] = np.nan
    foreign.ply(tmp_path / "a.ply", columns)
    with pytest.raises(InputError, match=naming("a.ply", "NaN", 1)):
        ply.read(tmp_path / "a.ply")


def test_a_point_cloud_is_called_one(tmp_path):
    foreign.ply(
        tmp_path / "a.ply", {n: np.zeros(3, np.float32) for n in "xyz"} | {n: np.zeros(3, np.uint8) for n in ("red", "green", "blue")}
    )
    with pytest.raises(InputError, match=naming("a.ply", "point cloud", "red")):
        ply.read(tmp_path / "a.ply")
