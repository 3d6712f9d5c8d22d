"""Cameras of Metashape, against the formulas of its manual."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.readers.metashape import READER
from scene_experts.data.readers.reader import PosedImage, ReadOptions
from support.captures import load
from support.foreign_poses import make_metashape
from support.messages import naming

F, CX, CY, B1, B2, K, P = 70.5, 1.25, -0.75, 0.5, -0.3, (-0.09, 0.02, -0.01, 0.003), (0.0004, -0.0007)
LENS = f"<f>{F}</f><cx>{CX}</cx><cy>{CY}</cy>" + "".join(f"<k{i + 1}>{k}</k{i + 1}>" for i, k in enumerate(K))
LENS += f"<p1>{P[0]}</p1><p2>{P[1]}</p2>"
TRANSFORM = "0.36 0.48 -0.8 4 -0.8 0.6 0 -5 0.48 0.64 0.6 6 0 0 0 1"
FRAME = "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>100 200 300</translation><scale>2.5</scale></transform>"


def write(folder: Path, lens: str = LENS, kind: str = "frame", frame: str = FRAME, more: str = "", reference: str = "") -> None:
    Image.new("RGB", (80, 60)).save(folder / "IMG.1.png")
    (folder / "cameras.xml").write_text(
        f'''<document version="2.0.0"><chunk>
<sensors><sensor id="3" type="{kind}"><resolution width="80" height="60"/>
<calibration class="adjusted">{lens}</calibration></sensor></sensors>
{frame}<cameras><camera id="0" sensor_id="3" component_id="0" label="IMG.1"><transform>{TRANSFORM}</transform></camera>{more}</cameras>
{reference}</chunk></document>'''
    )


def read(folder: Path) -> PosedImage:
    return READER.read(folder, ReadOptions()).images[0]


def pixel(image: PosedImage, X: np.ndarray) -> tuple[float, float]:
    x, y, z = image.world_to_cam[:3, :3] @ X + image.world_to_cam[:3, 3]
    lens = image.lens
    assert lens is not None
    u, v = lens.distort(np.array([x / z]), np.array([y / z]))
    return float(u[0] * lens.fx + lens.cx), float(v[0] * lens.fy + lens.cy)


def expected(X: np.ndarray, frame: bool, fisheye: bool = False, b2: float = 0.0) -> tuple[float, float]:
    """The pixel of a world point by the manual, term by term, with 4x4 matrices inverted numerically."""
    chunk = np.array([[0, -2.5, 0, 100], [2.5, 0, 0, 200], [0, 0, 2.5, 300], [0, 0, 0, 1]]) if frame else np.eye(4)
    local = np.linalg.inv(chunk @ np.array(list(map(float, TRANSFORM.split()))).reshape(4, 4)) @ np.append(X, 1.0)
    x, y = local[0] / local[2], local[1] / local[2]
    if fisheye:
        r0 = np.hypot(x, y)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.hypot(x, y)
    bend = 1 + K[0] * r**2 + K[1] * r**4 + K[2] * r**6 + K[3] * r**8
    xd = x * bend + P[0] * (r**2 + 2 * x**2) + 2 * P[1] * x * y
    yd = y * bend + P[1] * (r**2 + 2 * y**2) + 2 * P[0] * x * y
    return 80 * 0.5 + CX + xd * F + xd * B1 + yd * b2, 60 * 0.5 + CY + yd * F


def ahead(frame: bool) -> list[np.ndarray]:
    """Points in front of the camera, in the world."""
    matrix = np.array(list(map(float, TRANSFORM.split()))).reshape(4, 4)
    chunk = np.array([[0, -2.5, 0, 100], [2.5, 0, 0, 200], [0, 0, 2.5, 300], [0, 0, 0, 1]]) if frame else np.eye(4)
    return [(chunk @ matrix @ (x, y, 2.0, 1.0))[:3] for x, y in ((0.1, 0.2), (-0.6, 0.3), (0.5, -0.4))]


@pytest.mark.parametrize("place", ["chunk", "component", "none"])
def test_pixels_are_those_of_the_manual(tmp_path: Path, place: str) -> None:
    component = f'<components><component id="0">{FRAME}</component></components>'
    write(tmp_path, LENS + f"<b1>{B1}</b1><b2>{B2}</b2>", frame={"chunk": FRAME, "component": component, "none": ""}[place])
    for X in ahead(place != "none"):
        assert pixel(read(tmp_path), X) == pytest.approx(expected(X, place != "none", b2=B2), abs=1e-6)


@pytest.mark.parametrize("kind", ["fisheye", "equidistant_fisheye"])
def test_equidistant_fisheye_lenses(tmp_path: Path, kind: str) -> None:
    write(tmp_path, LENS + f"<b1>{B1}</b1>", kind)
    for X in ahead(True):
        assert pixel(read(tmp_path), X) == pytest.approx(expected(X, True, fisheye=True), abs=1e-6)
    write(tmp_path, LENS + "<b2>0.1</b2>", kind)
    with pytest.raises(InputError, match="b2"):
        read(tmp_path)


@pytest.mark.parametrize("kind", ["spherical", "equisolid_fisheye", "rpc"])
def test_other_lenses_are_refused(tmp_path: Path, kind: str) -> None:
    write(tmp_path, kind=kind)
    with pytest.raises(InputError, match=naming(kind, "undistorted")):
        read(tmp_path)


# Of a real file that geograypher publishes in its tests (test_derived_cameras): a drone's camera with a position by satellites.
DRONE = "-0.99988146 -0.00872749 0.01268391 7.04224697 -0.00842932 0.99969124 0.02337453 7.05403071 "
DRONE += "-0.01288400 0.02326485 -0.99964631 0.43561421 0 0 0 1"
EARTH = (
    "0.8710699454 0.3070967021 -0.3833128821 -0.4909742007 0.5658364395 -0.6623997719 0.0134716110 0.7651932691 0.6436596744",
    (-2499366.429888, -4256836.520906, 4029217.965003),
    "12.354192447331316",
)
LONGITUDE, LATITUDE, HEIGHT, YAW = np.deg2rad(-120.417985477), np.deg2rad(39.411917469999999), 2420.109, np.deg2rad(179.9)


def geocentric(longitude: float, latitude: float, height: float) -> np.ndarray:
    e2 = 0.00669437999014
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    level = (n + height) * np.cos(latitude)
    return np.array([level * np.cos(longitude), level * np.sin(longitude), (n * (1 - e2) + height) * np.sin(latitude)])


def test_a_published_georeferenced_camera_is_where_its_satellites_put_it(tmp_path: Path) -> None:
    """Within 10 cm, which is what such a position is good for; it looks down, with the top of the picture to the south."""
    turn, shift, scale = EARTH
    component = f'<component id="0"><transform><rotation>{turn}</rotation><translation>{" ".join(map(str, shift))}</translation>'
    write(tmp_path, frame=f"<components>{component}<scale>{scale}</scale></transform></component></components>")
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace(TRANSFORM, DRONE))
    raw = READER.read(tmp_path, ReadOptions())
    assert any("georeferenced" in w and "39.41" in w and "-120.41" in w for w in raw.warnings)
    pose = raw.images[0].world_to_cam
    centre = -pose[:3, :3].T @ pose[:3, 3]
    away = geocentric(LONGITUDE, LATITUDE, HEIGHT) - shift
    east, up = np.array([-np.sin(LONGITUDE), np.cos(LONGITUDE), 0]), geocentric(LONGITUDE, LATITUDE, 1) - geocentric(LONGITUDE, LATITUDE, 0)
    expected = np.array([east @ away, np.cross(up, east) @ away, up @ away])
    assert np.abs(centre - expected).max() < 0.1 and np.linalg.norm(centre) > 100
    assert pose[2, :3] == pytest.approx((0, 0, -1), abs=0.02)
    assert -pose[1, :3] == pytest.approx((np.sin(YAW), np.cos(YAW), 0), abs=0.04)  # a drone's compass


def test_a_local_reference_keeps_the_frame(tmp_path: Path) -> None:
    write(tmp_path, LENS + f"<b1>{B1}</b1>", reference='<reference>LOCAL_CS["Local"]</reference>')
    assert pixel(read(tmp_path), ahead(True)[0]) == pytest.approx(expected(ahead(True)[0], True), abs=1e-6)


def test_cameras_that_are_disabled_or_have_no_pose(tmp_path: Path) -> None:
    idle = f'<camera id="2" sensor_id="3" label="c" enabled="0"><transform>{TRANSFORM}</transform></camera>'
    write(tmp_path, more='<camera id="1" sensor_id="3" label="b"/>' + idle)
    raw = READER.read(tmp_path, ReadOptions())
    assert len(raw.images) == 1 and any("1 cameras" in w and "no pose" in w for w in raw.warnings)
    assert any("disabled" in w for w in raw.warnings)


def test_the_chunk_with_most_cameras(tmp_path: Path) -> None:
    make_metashape(tmp_path)
    text = (tmp_path / "cameras.xml").read_text()
    start = text.index("<chunk")
    (tmp_path / "cameras.xml").write_text(
        text[:start] + f"<chunk><cameras><camera><transform>{TRANSFORM}</transform></camera></cameras></chunk>" + text[start:]
    )
    capture = load(tmp_path)
    assert len(capture.views) == 4 and any("chunks of 1, 4 cameras" in w for w in capture.warnings)


@pytest.mark.parametrize(
    ("old", "new", "fact"),
    [
        ("<document", '<!DOCTYPE d [<!ENTITY a "b">]><document', "document type"),
        ("</cameras>", "", "well-formed"),
        (TRANSFORM, "1 2 3", "16 numbers"),
        (TRANSFORM, TRANSFORM.replace("0.36", "nan"), "16 numbers"),
        (TRANSFORM, TRANSFORM.replace("0.36", "3.6"), "rotation"),
        (f"<transform>{TRANSFORM}</transform>", "", "cameras with a transform"),
        ('sensor_id="3"', 'sensor_id="4"', "sensor 4"),
        (f"<f>{F}</f>", "", "calibration"),
        (f"<f>{F}</f>", "<f>wide</f>", "wide"),
        ("<scale>2.5</scale>", "<scale>0</scale>", "scale"),
        ('width="80"', 'width="wide"', "resolution"),
    ],
)
def test_damaged_files(tmp_path: Path, old: str, new: str, fact: str) -> None:
    write(tmp_path)
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=fact):
        read(tmp_path)
