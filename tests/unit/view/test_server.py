"""The viewer without a browser: clients connect, move, disconnect and send nonsense. test_view_browser.py tests it in a browser."""

import socket
import time
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.evaluate.pictures import to_8bit
from scene_experts.training.recipes import RECIPES
from scene_experts.view.paint import paint
from scene_experts.view.paths import choose_best_view
from support.captures import load

pytest.importorskip("viser")
from scene_experts.view.server import Client, Viewer, check_host
from support.synthetic import make_capture
from support.viewers import DRAW, Handle, joined


def test_a_client_starts_at_the_best_view_and_gets_the_render(viewer, capture):
    handle = joined(viewer)
    viewer.draw()
    (picture, how), camera = handle.pictures[-1], viewer.read_camera(viewer.clients[0])
    assert how["format"] == "jpeg" and picture.shape == (60, 90, 3)
    first = capture.views[choose_best_view(capture)].camera
    assert viewer.panel.chosen.value == viewer.panel.names[choose_best_view(capture)]
    assert torch.allclose(camera.world_to_cam, first.world_to_cam, atol=1e-5)
    scene, step = viewer.current()
    assert np.array_equal(picture, to_8bit(paint(scene, camera, step, DRAW, torch.tensor(capture.background))))
    viewer.draw()
    assert len(handle.pictures) == 1  # nothing changed


def test_a_page_that_loads_opens_at_the_best_view(viewer, capture):
    start, first = viewer.server.initial_camera, capture.views[choose_best_view(capture)].camera
    ahead = torch.tensor(start.look_at - start.position).float()
    assert np.allclose(start.position, first.position.numpy(), atol=1e-5) and start.fov == pytest.approx(first.fov)
    assert torch.allclose(ahead / ahead.norm(), first.world_to_cam[2, :3], atol=1e-4)
    assert np.allclose(start.up, -first.world_to_cam[1, :3].numpy(), atol=1e-5)


def test_a_moving_client_gets_small_pictures_and_a_resting_one_the_full_picture(viewer):
    handle = joined(viewer)
    viewer.draw()
    viewer.clients[0].seconds_a_pixel = 1e-3
    handle.move()
    viewer.clients[0].moved = time.monotonic() + 3600  # it moves until further notice
    viewer.draw()
    assert handle.pictures[-1][0].shape[0] < 60
    viewer.clients[0].moved = time.monotonic() - 1
    viewer.draw()
    assert handle.pictures[-1][0].shape[0] == 60 and len(handle.pictures) == 3


def test_a_client_stays_near_the_photographs_until_it_may_leave(viewer, capture):
    handle = joined(viewer)
    viewer.draw()
    handle.camera.position = np.array([1e3, 0.0, 0.0])
    inside = viewer.read_camera(viewer.clients[0]).position.double()
    assert torch.allclose(viewer.region.nearest(inside), inside, rtol=1e-4)
    handle.move()
    viewer.clients[0].moved = 0.0
    viewer.draw()  # it rests: the browser is moved to where the picture was drawn
    assert np.allclose(handle.camera.position, inside.numpy(), atol=1e-4)
    viewer.panel.near.value = False
    handle.camera.position = np.array([1e3, 0.0, 0.0])
    assert float(viewer.read_camera(viewer.clients[0]).position[0]) == pytest.approx(1e3, rel=1e-4)


def test_controls_change_the_picture(viewer):
    handle = joined(viewer)
    viewer.draw()
    for control, value in ((viewer.panel.show, "experts"), (viewer.panel.switches[0], False), (viewer.panel.crop, True)):
        control.value = value
    viewer.panel.bounds[0].value = (viewer.panel.bounds[0].min, (viewer.panel.bounds[0].min + viewer.panel.bounds[0].max) / 2)
    look = viewer.panel.read_look()
    assert look.show == "experts" and look.only == (1, 2, 3, 4) and look.box is not None and look.box[0][0] < look.box[1][0]
    viewer.request_redraw()
    viewer.draw()
    assert len(handle.pictures) == 2 and not np.array_equal(handle.pictures[0][0], handle.pictures[1][0])


def test_the_photograph_is_wiped_over_the_render_at_its_view(viewer, capture):
    handle = joined(viewer)
    view = choose_best_view(capture)
    camera = capture.views[view].camera
    handle.camera.aspect, handle.camera.image_height = camera.width / camera.height, camera.height
    viewer.panel.wipe.value = 1.0
    viewer.request_redraw()
    viewer.draw()
    photo = capture.frame(view).rgb.float() / 255
    assert torch.allclose(viewer.reproject_photograph(view, camera), photo, atol=2e-3)  # reprojected to its own camera it is unchanged
    found = handle.pictures[-1][0]
    assert np.array_equal(found, to_8bit(viewer.reproject_photograph(view, viewer.read_camera(viewer.clients[0]))))
    viewer.clients[0].at_view = None
    viewer.request_redraw()
    viewer.draw()
    assert not np.array_equal(handle.pictures[-1][0], found)


def test_nonsense_from_one_client_does_not_affect_the_others(viewer):
    bad, good = joined(viewer, 1), joined(viewer, 2)
    for wrong in (np.full(4, np.nan), np.zeros(4), np.zeros(3), "x"):
        bad.camera.wxyz = wrong
        viewer.request_redraw()
        viewer.draw()
    assert bad.pictures == [] and len(good.pictures) == 4
    bad.camera.wxyz, bad.camera.fov = np.array([1.0, 0, 0, 0]), 99.0
    viewer.request_redraw()
    viewer.draw()
    assert bad.pictures == []


def test_fifty_disconnected_clients_leave_nothing(viewer):
    for number in range(50):
        handle = joined(viewer, number)
        viewer.draw()
        viewer.disconnect(handle)
    assert viewer.clients == {} and viewer.find_due(time.monotonic()) == []


def test_a_budget_leaves_clients_for_the_next_turn(viewer):
    handles = [joined(viewer, n) for n in range(3)]
    viewer.draw(budget=1e-9)
    assert sum(len(h.pictures) for h in handles) == 1
    viewer.draw()
    assert all(h.pictures for h in handles)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0"])
def test_addresses_of_this_machine(host):
    check_host(host)


def test_a_taken_port_is_reported(viewer, capture):
    taken = viewer.server.get_port()
    other = Viewer(capture, viewer.current, DRAW, port=taken)
    try:
        assert other.moved and other.server.get_port() != taken and not viewer.moved
    finally:
        other.close()


def test_clients_are_due_when_something_changed():
    client = Client(Handle())
    assert client.wanted and not client.full and not client.is_moving(time.monotonic())


def test_where_all_photographs_are_from_one_point_a_client_turns_with_the_views(tmp_path):
    capture = load(make_capture(tmp_path, views=4).folder)
    turned = []
    for view in capture.views:
        pose = view.camera.world_to_cam.clone()
        pose[:3, 3] = 0.0  # all at the origin
        turned.append(replace(view, camera=replace(view.camera, world_to_cam=pose)))
    scene = RECIPES["scaffold-gs"][1].scene.start(capture.points, capture.extent)
    made = Viewer(replace(capture, views=tuple(turned)), lambda: (scene, 2000), DRAW, port=0)
    try:
        assert made.region.radius > 0.01
        handle = joined(made)
        for number, view in enumerate(turned):
            made.go_to_view(number)
            ahead = torch.tensor(handle.camera.look_at) - torch.tensor(handle.camera.position)
            assert ahead.norm() > 0.001 and torch.allclose((ahead / ahead.norm()).float(), view.camera.world_to_cam[2, :3], atol=1e-4)
    finally:
        made.close()
        capture.images.close()


def test_a_window_that_changes_its_size_leaves_the_client_at_its_view(viewer):
    handle = joined(viewer)
    viewer.clients[0].arriving = 0.0
    handle.camera.aspect = 2.0
    handle.move()
    assert viewer.clients[0].at_view is not None
    handle.camera.position = np.array(handle.camera.position) + 0.1
    handle.move()
    assert viewer.clients[0].at_view is None


@pytest.mark.parametrize(
    ("host", "name"), [("127.0.0.1", "localhost"), ("127.0.0.2", "127.0.0.2"), ("localhost", "localhost"), ("::1", "[::1]")]
)
def test_the_address_of_a_local_host_answers(viewer, host, name):
    try:
        with socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            pass
    except OSError:
        pytest.skip(f"{host} is no address of this machine")
    made = Viewer(viewer.capture, viewer.current, DRAW, host=host, port=0)
    try:
        assert made.url == f"http://{name}:{made.server.get_port()}"
        with urllib.request.urlopen(made.url, timeout=60) as answer:
            assert answer.status == 200
    finally:
        made.close()
