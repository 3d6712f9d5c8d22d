"""Camera paths: positions, directions and smoothness, against plain geometry."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.geometry.poses import look_at
from scene_experts.view import paths
from scene_experts.view.paths import CameraRig, choose_best_view, make_path, make_round, orbit, spiral
from support.captures import load
from support.places import DEMO
from support.scenes import CAMERA
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=12).folder)
    yield capture
    capture.images.close()


def ring(count=8, radius=3.0, height=1.0) -> CameraRig:
    """Return cameras on a circle around (1, 2, 3) that look at this point; up is +z."""
    centre, up = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    poses = []
    for i in range(count):
        a = 2 * math.pi * i / count
        place = centre + torch.tensor([radius * math.cos(a), radius * math.sin(a), height], dtype=torch.float64)
        poses.append(look_at(place, centre, up))
    rotations = torch.stack([p[:3, :3].T for p in poses])
    positions = torch.stack([-(p[:3, :3].T @ p[:3, 3]) for p in poses])
    return CameraRig(centre, up, positions, rotations, (CAMERA,) * count)


def place_of(pose):
    return -(pose[:3, :3].T @ pose[:3, 3])


def test_an_orbit_keeps_distance_and_height_and_looks_at_the_centre():
    seen = ring()
    for made in orbit(seen, 12):
        offset = place_of(made) - seen.centre
        assert offset[2] == pytest.approx(1.0) and offset[:2].norm() == pytest.approx(3.0)
        ahead = made[:3, :3] @ seen.centre + made[:3, 3]
        assert ahead[:2].abs().max() < 1e-9 and ahead[2] == pytest.approx(math.sqrt(10))


def test_a_spiral_stays_within_the_cameras_spread_and_looks_at_the_centre():
    seen = ring()
    middle = seen.positions.mean(0)
    reach = (seen.positions - middle).norm(dim=1).max()
    for made in spiral(seen, 20):
        assert (place_of(made) - middle).norm() < reach
        assert (made[:3, :3] @ seen.centre + made[:3, 3])[:2].abs().max() < 1e-9


def test_every_named_path_of_a_capture(capture):
    for name in paths.NAMES:
        path = make_path(name, capture, 10, (64, 48), 12.0)
        assert len(path) == 10 and path.fps == 12.0
        assert all((c.width, c.height, c.id) == (64, 48, -1) and torch.isfinite(c.world_to_cam).all() for c in path.cameras)
    first = make_path("views", capture, 3).cameras[0]
    training = capture.views[capture.train[0]].camera
    assert torch.allclose(first.world_to_cam, training.world_to_cam, atol=1e-5)
    with pytest.raises(InputError, match="square"):
        make_path("square", capture, 3)
    with pytest.raises(InputError, match="--seconds"):
        make_path("orbit", capture, 0)


def test_the_centre_is_where_the_axes_meet(capture):
    seen = paths.analyse_cameras(capture)
    ahead = torch.stack([v.camera.world_to_cam.double() for v in capture.views]) @ torch.cat([seen.centre, torch.ones(1)]).double()
    assert (ahead[:, 2] > 0).all()


def standing(capture, places, rolls):
    """Return the capture with views at `places` that look at the origin, rolled by `rolls`; up is +z."""
    up, views = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), []
    for i, (place, roll) in enumerate(zip(places, rolls)):
        made = look_at(torch.tensor(place, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), up)
        c, s = math.cos(roll), math.sin(roll)
        made[:3] = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64) @ made[:3]
        views.append(replace(capture.views[0], name=f"{i}", camera=replace(CAMERA, world_to_cam=made.float(), id=i)))
    return replace(capture, views=tuple(views), train=tuple(range(len(views))), test=())


def test_the_best_view_is_upright_not_near_and_level(capture):
    around = [(3 * math.cos(a), 3 * math.sin(a), 3.0) for a in (0.1, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]  # from above
    rolls = [0.0] * 4 + [math.pi / 2] * 3  # with portraits
    scene = lambda places, turned: standing(capture, [*places, *around], [*turned, *rolls])  # noqa: E731
    far, near, above, level = (5.0, 0, 1.0), (0.0, 1.5, 0.3), (0.5, 0, 6.0), (0, 6.0, 1.0)
    assert choose_best_view(scene((far, near, level), (math.pi / 2, 0.0, 0.0))) == 2  # on its side; a close-up
    assert choose_best_view(scene((above, level, near), (0.0, 0.0, 0.0))) == 1  # from straight above
    assert choose_best_view(scene((near, (0, 2.0, 0.3), near), (0.0, 0.0, 0.0))) in (3, 4, 5, 6)  # these are near
    some = scene((far, level, near), (1.0, 0.0, 0.0))
    assert choose_best_view(replace(some, test=(1,), train=(0, *range(2, 10)))) in (3, 4, 5, 6)  # training views are drawn best
    assert choose_best_view(replace(some, views=some.views[:1], train=(), test=(0,))) == 0
    assert choose_best_view(capture) in capture.train


@pytest.mark.skipif(not DEMO.is_dir(), reason="the demo captures are not shipped with the package")
def test_the_shipped_captures_open_upright_with_the_whole_scene_in_view():
    found = {}
    for name in ("buddha", "brighton"):
        made = load(DEMO / name)
        found[name] = made.views[choose_best_view(made)].name
        made.images.close()
    assert found == {"buddha": "040.jpg", "brighton": "DJI_0031.jpg"}


def test_frames_that_nobody_photographed_are_counted(capture):
    """All cameras but those that look within 60 degrees of the first are left out: an orbit shows the back, a spiral does not."""
    ahead = {i: capture.views[i].camera.world_to_cam[2, :3] for i in capture.train}
    near = tuple(i for i in ahead if ahead[i] @ ahead[capture.train[0]] > 0.5)
    around = paths.CameraPath(tuple(capture.views[i].camera for i in capture.train))
    assert paths.count_unseen(around, capture) == 0
    far = [i for i in ahead if max(float(ahead[i] @ ahead[j]) for j in near) < math.cos(math.pi / 4)]
    assert far and paths.count_unseen(around, replace(capture, train=near)) == len(far)


def test_a_path_is_chosen_by_the_shape_of_the_capture():
    around = ring(12)
    assert paths.choose_path(around) == "orbit"
    chosen = [0, 1, 2, 3, 4, 5, 6]  # half of the circle: an orbit would show the backs that nobody photographed
    half = replace(around, positions=around.positions[chosen], rotations=around.rotations[chosen], cameras=around.cameras[:7])
    assert float(half.forward.mean(0).norm()) < paths.FACING and paths.choose_path(half) in ("spiral", "views")
    front = replace(around, positions=around.positions[:3], rotations=around.rotations[:3], cameras=around.cameras[:3])
    assert paths.choose_path(front) == "spiral"


@pytest.mark.parametrize("turned", [False, True])
def test_a_round_ends_where_it_begins(turned, capture, monkeypatch):
    if turned:
        monkeypatch.setattr("scene_experts.view.paths.choose_path", lambda rig: "views")
    places = torch.stack([camera.position for camera in make_round(capture, 24).cameras])
    steps = (places - places.roll(1, 0)).norm(dim=1)
    assert len(places) == 24 and float(steps[0]) <= 1.5 * float(steps[1:].max())
