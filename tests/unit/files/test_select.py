"""Crops, and floaters: Gaussians that no training photograph supports."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.views import World
from scene_experts.files.formats.splats import Splats
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of
from scene_experts.files.measure import Painter
from scene_experts.files.select import Crop, crop, find_floaters, find_subject, parse_crop
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=9).folder)
    yield capture
    capture.images.close()


def splats(means, size=0.05, logit=4.0):
    """Round grey Gaussians at `means` [N, 3]."""
    n = len(means)
    sizes, logits = torch.as_tensor(size).log().expand(n), torch.as_tensor(logit).expand(n)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return Splats(means.float(), sizes[:, None].repeat(1, 3), quats, logits.clone(), torch.zeros(n, 1, 3))


def test_crops_are_spheres_and_boxes():
    assert parse_crop("sphere:2") == Crop((2.0,)) and parse_crop("sphere:1.5x") == Crop((1.5,), True)
    assert parse_crop("sphere:0,-1,2,.5").numbers == (0.0, -1.0, 2.0, 0.5)
    assert parse_crop("box:-1,-1,-1, 1,2e0,3").numbers == (-1.0, -1.0, -1.0, 1.0, 2.0, 3.0)
    wrongs = "; 2; sphere:; sphere:0; sphere:-1x; sphere:1,2; sphere:1,2,3,4x; box:1,1,1,0,2,2; box:1,2,3; cone:1; sphere:nan"
    for wrong in wrongs.split("; "):
        with pytest.raises(InputError, match="--crop"):
            parse_crop(wrong)


def test_a_crop_keeps_what_is_inside_in_the_capture_s_units(capture):
    centre, distance = find_subject(capture)
    offsets = torch.tensor([[0.0, 0, 0], [0.4, 0, 0], [0, 0.9, 0], [0, 0, 3.0]], dtype=torch.float64) * distance
    made = splats(centre + offsets)
    assert len(crop(made, parse_crop("sphere:0.5x"), capture, capture.world)) == 2
    assert len(crop(made, Crop((distance,)), capture, capture.world)) == 3
    trained = splats(capture.world.from_input(centre + offsets))  # a file in the trained world
    assert len(crop(trained, parse_crop("sphere:0.5x"), capture, World())) == 2
    x, y, z = centre.tolist()
    d = 0.5 * distance
    assert len(crop(made, Crop((x - d, y - d, z - d, x + d, y + d, z + d)), capture, capture.world)) == 2
    with pytest.raises(InputError, match=naming("--crop", "found none")):
        crop(made, Crop((1e6, 0.0, 0.0, 1.0)), capture, capture.world)


def test_floaters_are_what_no_photograph_supports(capture):
    centre, distance = find_subject(capture)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    subject = centre + 0.05 * distance * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    unseen = centre + 50 * distance * up
    made = splats(torch.cat([subject, unseen[None]]), size=0.03 * distance)
    columns = {
        "means": capture.world.from_input(made.means), "log_scales": made.log_scales + torch.tensor(capture.world.scale).log(),
        "quats": made.quats, "raw_opacity": made.opacity_logit, "sh_dc": made.sh[:, 0], "sh_rest": made.sh[:, 1:],
    }  # fmt: skip
    painter = Painter.of(scene_of(columns, capture.extent), DRAWN_AT)
    cameras = [capture.views[i].camera for i in capture.train]
    said = []
    found = find_floaters(made, painter, cameras, lambda what, done, total: said.append((done, total)))
    assert bool(found[-1]) and int(found[:-1].sum()) < 20 and said[-1] == (len(cameras), len(cameras))
