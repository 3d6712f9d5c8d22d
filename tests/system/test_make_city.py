"""The made city: a capture whose cameras are exact, so that the colours of its points lie where the pictures show them."""

import numpy as np

import make_city
from scene_experts.data.blocks import make_blocks
from support.captures import load


def test_a_small_city_is_a_capture_with_exact_cameras(tmp_path):
    count = make_city.make_city(tmp_path / "city", buildings=3, views=9, width=96, points=4_000)
    capture = load(tmp_path / "city", split="none", normalise="none")
    assert len(capture.views) == 9 and capture.points is not None and len(capture.points.xyz) == count > 3_000
    roofs = np.asarray(capture.points.xyz)[:, 2] > 0.01
    xyz, rgb = np.asarray(capture.points.xyz, np.float64)[roofs], np.asarray(capture.points.rgb, np.float64)[roofs]
    errors = []
    for index, view in enumerate(capture.views):
        camera = view.camera
        local = xyz @ camera.world_to_cam[:3, :3].double().numpy().T + camera.world_to_cam[:3, 3].double().numpy()
        u, v = (local @ camera.K.double().numpy().T)[:, :2].T / local[:, 2]
        inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        picture = capture.frame(index).rgb.numpy()
        errors.append(np.abs(picture[v[inside].astype(int), u[inside].astype(int)] - rgb[inside] * (255 if rgb.max() <= 1 else 1)).mean(1))
    capture.images.close()
    assert np.median(np.concatenate(errors)) < 25, "most points are not hidden, and the pictures have their colours there"
    assert len(make_blocks(capture, 4)) == 4
