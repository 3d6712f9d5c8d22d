"""Where points lie in a picture."""

import torch

from scene_experts.data.projection import project
from support.captures import load
from support.synthetic import make_capture


def test_columns_rows_and_depths_are_those_of_the_pinhole_model(tmp_path):
    camera = load(make_capture(tmp_path, views=3, points=50).folder).views[1].camera
    xyz = torch.randn(20, 3)
    u, v, z = project(xyz, camera)
    for i, point in enumerate(xyz.double()):
        local = camera.world_to_cam.double() @ torch.cat((point, torch.ones(1).double()))
        pixel = camera.K.double() @ (local[:3] / local[2])
        torch.testing.assert_close(torch.stack((u[i], v[i], z[i])), torch.stack((pixel[0], pixel[1], local[2])))
    assert u.dtype == v.dtype == z.dtype == torch.float64
