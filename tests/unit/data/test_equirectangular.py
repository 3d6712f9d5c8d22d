"""Equirectangular pictures: where views lie in them, what they show, and what is one."""

import math

import numpy as np
import pytest
import torch

from scene_experts.data.equirectangular import VIEWS, PanoramaView, find_places, is_seamless, mask_nadir, sample, view_side
from support.rooms import draw_panorama, paint_walls, see_walls


@pytest.mark.parametrize(("yaw", "pitch", "u", "v"), [(0, 0, 0.5, 0.5), (90, 0, 0.75, 0.5), (270, 0, 0.25, 0.5), (0, 35, 0.5, 55 / 180)])
def test_the_middle_of_a_view_lies_where_it_looks(yaw, pitch, u, v):
    places = find_places(PanoramaView(yaw, pitch), 101, (800, 400))
    assert places[50, 50].tolist() == pytest.approx([u * 800, v * 400], abs=1e-3)


def test_right_in_a_view_is_right_in_the_panorama_and_down_is_down():
    places = find_places(PanoramaView(45, 0), 9, (800, 400))
    assert (places[:, 1:, 0] > places[:, :-1, 0]).all() and (places[1:, :, 1] > places[:-1, :, 1]).all()


def test_rotations_are_rotations_and_every_direction_near_the_horizon_is_in_a_view():
    lon, lat = np.meshgrid(np.radians(np.arange(0, 360, 3)), np.radians(np.arange(-74, 75, 2)))
    rays = np.stack([np.sin(lon) * np.cos(lat), -np.sin(lat), np.cos(lon) * np.cos(lat)], -1)
    seen = np.zeros(lon.shape, int)
    for view in VIEWS:
        turn = view.rig_from_view
        assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1)
        x, y, z = np.moveaxis(rays @ turn, -1, 0)
        seen += (z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= z)
    assert seen.min() >= 1 and (seen >= 2).mean() > 0.6


@pytest.mark.parametrize("view", VIEWS[::5])
def test_a_view_shows_what_a_camera_there_sees(view):
    walls, origin, width = paint_walls(128), (0.3, -0.2, 0.1), 512
    side = view_side(width)
    cut = sample(draw_panorama(walls, origin, 0.0, width), find_places(view, side, (width, width // 2)))
    across = (np.arange(side) + 0.5 - side / 2) / (side / 2)
    x, y = np.meshgrid(across, across)
    wanted = see_walls(walls, np.array(origin), np.stack([x, y, np.ones_like(x)], -1) @ view.rig_from_view.T)
    assert np.median(np.abs(cut - wanted)) < 4


def test_values_are_exact_at_pixels_and_go_on_around_the_seam():
    picture = np.random.default_rng(0).integers(0, 255, (8, 16, 3)).astype(np.uint8)
    places = torch.tensor([[[3.5, 2.5], [0.5, 4.5], [15.5, 4.5]]])
    assert np.array_equal(sample(picture, places)[0], picture[[2, 4, 4], [3, 0, 15]])
    between = sample(np.full((8, 16), 9, np.uint8), torch.tensor([[[0.0, 3.0], [16.0, 3.0]]]))
    assert between.tolist() == [[9, 9]]
    wall = np.zeros((8, 16), np.uint8)
    wall[:, -1] = 200
    assert int(sample(wall, torch.tensor([[[0.0, 4.5]]]))[0, 0]) == pytest.approx(119, abs=1)  # Keys' kernel with a = -3/4, half way
    assert sample(wall, torch.tensor([[[0.2, 4.5]]]), nearest=True)[0, 0] == 0


def test_panoramas_are_told_from_photographs_of_their_shape():
    panorama = draw_panorama(paint_walls(64), (0.2, 0, 0.4), 0.3, 256)
    assert is_seamless(panorama)
    product = np.full((128, 256, 3), 250, np.uint8)
    product[40:90, 80:180] = panorama[40:90, 80:180]
    assert not is_seamless(product)
    assert not is_seamless(panorama[64:96, 32:96]) and not is_seamless(np.roll(panorama, 64, 0))


def test_the_nadir_is_a_cone_around_straight_down():
    below, side = PanoramaView(0, -35), 200
    mask = mask_nadir(below, side, 30)
    rays = np.array([[0, 0, 1.0], [0, 1, 1.0]]) @ below.rig_from_view.T  # the middle and the lower edge
    angles = np.degrees(np.arccos(rays[:, 1] / np.linalg.norm(rays, axis=1)))
    assert angles[0] > 30 > angles[1] and mask[100, 100] == 255 and mask[-1, 100] == 0
    assert (mask_nadir(PanoramaView(0, 35), side, 30) == 255).all() and math.isclose(angles[0], 55)
