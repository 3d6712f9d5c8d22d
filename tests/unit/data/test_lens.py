"""Lenses against pycolmap, in a process of its own, and against their own inverse."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.images import FrameSource, decode
from scene_experts.data.lens import COLMAP_MODELS, MODELS, PANORAMA, Lens, centre_principal_point, to_pinhole
from support.lenses import IDS, LENSES

# This code runs without the project, which must not be imported in a process with pycolmap.
ORACLE = """
import json, sys
import numpy as np
import pycolmap
folder, lenses = sys.argv[1], json.loads(sys.argv[2])
options = pycolmap.UndistortCameraOptions()
rays = np.load(folder + "/rays.npy")
out = []
for i, (model, width, height, params) in enumerate(lenses):
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    np.save(f"{folder}/pixels_{i}.npy", camera.img_from_cam(rays))
    flat = pycolmap.undistort_camera(options, camera)
    out.append([flat.width, flat.height, list(flat.params)])
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.read(folder + "/photo.png", True), camera)
    np.save(f"{folder}/flat_{i}.npy", bitmap.to_array())
print(json.dumps(out))
"""


def photo() -> np.ndarray:
    """Return a smooth, strongly coloured picture [120, 160, 3]."""
    y, x = np.mgrid[:120, :160] / 20.0
    return np.rint(127 + 120 * np.stack((np.sin(x + 0.3 * y), np.cos(y), np.sin(0.7 * x - y)), -1)).astype(np.uint8)


@pytest.fixture(scope="module")
def oracle(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, list]:
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    folder = tmp_path_factory.mktemp("oracle")
    rng = np.random.default_rng(0)
    rays = np.concatenate((rng.uniform(-0.5, 0.5, (200, 2)), np.ones((200, 1))), 1)
    np.save(folder / "rays.npy", rays)
    Image.fromarray(photo()).save(folder / "photo.png")
    lenses = json.dumps([(lens.model, lens.width, lens.height, lens.params) for lens in LENSES])
    done = subprocess.run([sys.executable, "-c", ORACLE, str(folder), lenses], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder, rays, json.loads(done.stdout.splitlines()[-1])


def test_every_camera_model_of_colmap_is_known() -> None:
    assert [lens.model for lens in LENSES] == [name for name in COLMAP_MODELS if name != PANORAMA]


@pytest.mark.parametrize("index", range(len(LENSES)), ids=IDS)
@pytest.mark.foreign
def test_projection_equals_pycolmap(oracle: tuple[Path, np.ndarray, list], index: int) -> None:
    folder, rays, _ = oracle
    lens = LENSES[index]
    u, v = lens.distort(rays[:, 0], rays[:, 1])
    ours = np.stack((u * lens.fx + lens.cx, v * lens.fy + lens.cy), 1)
    np.testing.assert_allclose(ours, np.load(folder / f"pixels_{index}.npy"), atol=1e-6)


PIXELS = {  # of pycolmap 4.2.1: where the lenses of `LENSES` put the rays of RAYS
    "RAD_TAN_THIN_PRISM_FISHEYE": ((115.770590714, 33.362354587), (34.667167397, 62.246334199), (85.148383972, 103.492147081)),
    "SIMPLE_DIVISION": ((122.462428898, 28.994405298), (23.820755355, 63.295664324), (85.528447077, 112.625835705)),
    "DIVISION": ((123.899798162, 27.304513791), (20.470404415, 63.805594282), (85.652497466, 116.701596801)),
    "SIMPLE_FISHEYE": ((115.586699741, 33.873955022), (34.704121219, 62.137859445), (85.072297468, 102.590544289)),
    "FISHEYE": ((115.586699741, 33.453481477), (34.704121219, 62.231275071), (85.072297468, 103.419463276)),
    "EUCM": ((115.722388415, 33.355435468), (34.403835934, 62.263801137), (85.083630480, 103.673322754)),
}
RAYS = np.array([(0.31, -0.22), (-0.47, 0.05), (0.02, 0.44)])


@pytest.mark.parametrize("model", list(PIXELS))
def test_projection_equals_the_table_of_pycolmap(model: str) -> None:
    lens = LENSES[IDS.index(model)]
    u, v = lens.distort(RAYS[:, 0], RAYS[:, 1])
    np.testing.assert_allclose(np.stack((u * lens.fx + lens.cx, v * lens.fy + lens.cy), 1), PIXELS[model], atol=1e-6)


def test_browns_model_is_that_of_metashapes_manual() -> None:
    """u = cx + x' f + x' b1 + y' b2, v = cy + y' f, with K1..K4, P1 and P2 of the manual, evaluated here term by term."""
    f, b1, b2, (k1, k2, k3, k4), (p1, p2) = 130.0, 2.0, 0.7, (-0.1, 0.03, -0.02, 0.01), (0.002, -0.003)
    lens = Lens("BROWN", 160, 120, (f + b1, f, 83.0, 57.0, k1, k2, p2, p1, k3, k4, b2 / (f + b1)))
    for x, y in RAYS.tolist():
        r = math.hypot(x, y)
        bend = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
        px = x * bend + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
        py = y * bend + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
        u, v = lens.distort(np.array([x]), np.array([y]))
        assert float(u[0] * lens.fx + lens.cx) == pytest.approx(83.0 + px * f + px * b1 + py * b2, abs=1e-9)
        assert float(v[0] * lens.fy + lens.cy) == pytest.approx(57.0 + py * f, abs=1e-9)
        back = lens.undistort(u, v)
        assert (float(back[0][0]), float(back[1][0])) == pytest.approx((x, y), abs=1e-9)


def test_a_wide_unified_lens_gets_a_bounded_picture() -> None:
    flat = to_pinhole(Lens("EUCM", 200, 200, (60, 60, 100, 100, 0.6, 1.2)))
    assert 40 <= flat.width <= 400 and 40 <= flat.height <= 400
    assert not Lens("EUCM", 8, 8, (5, 5, 4, 4, 0, 1)).distorted


def test_a_division_lens_whose_border_no_ray_reaches_gets_a_bounded_picture() -> None:
    flat = to_pinhole(Lens("DIVISION", 200, 200, (60, 60, 100, 100, -0.9)))
    assert 40 <= flat.width <= 400 and 40 <= flat.height <= 400


@pytest.mark.parametrize("index", range(len(LENSES)), ids=IDS)
@pytest.mark.foreign
def test_undistorted_camera_and_picture_equal_pycolmap(oracle: tuple[Path, np.ndarray, list], index: int) -> None:
    folder, _, cameras = oracle
    width, height, params = cameras[index]
    flat = to_pinhole(LENSES[index])
    assert (flat.width, flat.height) == (width, height)
    theirs = params if len(params) == 4 else [params[0], *params]
    np.testing.assert_allclose(flat.params, theirs, rtol=1e-9)
    rgb, mask = decode(FrameSource(folder / "photo.png", LENSES[index], (flat.width, flat.height)))
    difference = np.abs(rgb.numpy().astype(int) - np.load(folder / f"flat_{index}.npy").astype(int))
    inner = difference[2:-2, 2:-2]  # at the edge pycolmap writes black, and this project repeats the border
    assert inner.max() <= 1
    assert mask is None or float((mask[2:-2, 2:-2] > 0).float().mean()) > 0.999


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_undistort_inverts_distort(lens: Lens) -> None:
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-0.6, 0.6, (2, 500))
    a, b = lens.undistort(*lens.distort(u, v))
    np.testing.assert_allclose((a, b), (u, v), atol=1e-8)
    zero = np.zeros(1)
    np.testing.assert_allclose(lens.undistort(*lens.distort(zero, zero)), (zero, zero), atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=IDS)
def test_resizing_scales_pixels_exactly(lens: Lens) -> None:
    small = lens.resize(80, 45)
    u, v = np.array([0.2, -0.3]), np.array([0.1, 0.25])
    (a, b), (c, d) = lens.distort(u, v), small.distort(u, v)
    np.testing.assert_allclose(c * small.fx + small.cx, (a * lens.fx + lens.cx) * 0.5, rtol=1e-12)
    np.testing.assert_allclose(d * small.fy + small.cy, (b * lens.fy + lens.cy) * 0.375, rtol=1e-12)


def test_distorted_only_with_a_coefficient() -> None:
    assert not Lens("OPENCV", 8, 8, (5, 5, 4, 4, 0, 0, 0, 0)).distorted
    assert Lens("OPENCV_FISHEYE", 8, 8, (5, 5, 4, 4, 0, 0, 0, 0)).distorted
    assert to_pinhole(Lens("SIMPLE_RADIAL", 8, 6, (5, 4, 3, 0))) == Lens("PINHOLE", 8, 6, (5, 5, 4, 3))


def test_a_wide_fisheye_gets_a_bounded_picture() -> None:
    flat = to_pinhole(Lens("OPENCV_FISHEYE", 200, 200, (60, 60, 100, 100, 0, 0, 0, 0)))  # a field of view of about 190 degrees
    assert 40 <= flat.width <= 400 and 40 <= flat.height <= 400


@pytest.mark.parametrize(
    ("lens", "size"),
    [
        (Lens("SIMPLE_RADIAL", 192, 108, (120.0, 96.0, 54.0, -0.2)), (237, 111)),  # as pycolmap 4.2: no ray reaches the corners
        (Lens("SIMPLE_RADIAL", 192, 108, (87.0, 96.0, 54.0, -0.15)), (259, 114)),  # nor the left and right sides, which lie at the fold
    ],
)
def test_a_border_that_no_ray_reaches_does_not_crop_the_picture(lens: Lens, size: tuple[int, int]) -> None:
    flat = to_pinhole(lens)
    assert (flat.width, flat.height) == size
    corner = np.array([-lens.cx / lens.fx]), np.array([-lens.cy / lens.fy])
    assert np.isnan(lens.undistort(*corner)).all()


def test_the_fold_is_where_the_distorted_radius_is_largest() -> None:
    zero, none = np.zeros(20001), math.inf
    radii = np.linspace(0, 3, 20001)
    for lens in (*LENSES, Lens("SIMPLE_RADIAL", 8, 8, (9.0, 4.0, 4.0, -0.2)), Lens("RADIAL", 8, 8, (9.0, 4.0, 4.0, -0.2, 0.01))):
        radial = Lens(lens.model, 8, 8, tuple(0.0 if n[0] in "ps" else p for n, p in zip(MODELS[lens.model], lens.params)))
        closed = lens.model == "EUCM" or "DIVISION" in lens.model
        seen = lens.distort(radii, zero)[0] if closed else radial._distort_polynomial(radii, zero)[0] if lens.model != "FOV" else radii
        falls = np.flatnonzero(~(np.diff(seen) >= 0))  # NaN beyond the fold of a division model
        fold = lens.find_fold()
        assert (fold if fold < 3 else none) == pytest.approx(radii[falls[0]] if len(falls) else none, abs=1e-3), lens.model


def test_centred_principal_point() -> None:
    assert centre_principal_point(LENSES[1]).params == (130.0, 133.0, 80.0, 60.0)


@pytest.mark.parametrize(
    ("model", "params", "word"),
    [
        ("EQUIRECTANGULAR", (1.0,), "expected 2 parameters"),
        ("WIBBLE", (1.0,), "WIBBLE.*colmap image_undistorter"),
        ("PINHOLE", (1.0, 1.0, 1.0), "PINHOLE"),
        ("PINHOLE", (1.0, 1.0, float("nan"), 1.0), "nan"),
        ("PINHOLE", (0.0, 1.0, 1.0, 1.0), "0.0"),
    ],
)
def test_bad_lenses(model: str, params: tuple[float, ...], word: str) -> None:
    with pytest.raises(InputError, match=word):
        Lens(model, 8, 8, params)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("model", list(MODELS))
def test_the_shortest_focal_length_overflows_nothing(model):
    params = [1e-6 if name in ("f", "fx", "fy") else 8.0 if name in ("cx", "cy") else 0.01 for name in MODELS[model]]
    to_pinhole(Lens(model, 16, 16, tuple(params)))
    with pytest.raises(InputError):
        Lens(model, 16, 16, (1e-15, *params[1:]))
