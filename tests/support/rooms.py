"""Panoramas of a box room with painted walls, by intersecting rays with its walls."""

import math

import numpy as np

HALF = np.array([3.0, 1.4, 2.2])  # half of the room's sides: x right, y down, z forward


def paint_walls(size=512, seed=0):
    """Return the pictures [size, size, 3] of the six walls: rectangles of all sizes."""
    random = np.random.default_rng(seed)
    walls = []
    for _ in range(6):
        wall = np.full((size, size, 3), random.integers(60, 200, 3), np.float64)
        for scale in (0.4, 0.15, 0.06, 0.03):
            for _ in range(int(12 / scale)):
                low = (random.random(2) * size).astype(int)
                high = low + np.maximum(2, (random.random(2) * scale * size).astype(int))
                wall[low[0] : high[0], low[1] : high[1]] = random.integers(0, 255, 3)
        walls.append(wall)
    return walls


def see_walls(walls, origin, rays):
    """Return what rays [..., 3] from `origin` see, [..., 3]."""
    with np.errstate(divide="ignore"):
        steps = np.where(rays > 0, (HALF - origin) / rays, np.where(rays < 0, (-HALF - origin) / rays, np.inf))
    axis = steps.argmin(-1)
    points = origin + rays * np.take_along_axis(steps, axis[..., None], -1)
    ahead = np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0
    seen = np.zeros(rays.shape)
    for wall, picture in enumerate(walls):
        mine = (axis == wall // 2) & (ahead == bool(wall % 2))
        across, down = (k for k in range(3) if k != wall // 2)
        place = [(points[mine][:, k] / HALF[k] / 2 + 0.5) * (len(picture) - 1) for k in (down, across)]
        y, x = (np.clip(p.astype(int), 0, len(picture) - 2) for p in place)
        v, u = ((p - q)[:, None] for p, q in zip(place, (y, x)))
        above = picture[y, x] * (1 - u) + picture[y, x + 1] * u
        seen[mine] = above * (1 - v) + (picture[y + 1, x] * (1 - u) + picture[y + 1, x + 1] * u) * v
    return seen


def draw_panorama(walls, origin, yaw, width, fine=2):
    """Return a panorama [width / 2, width, 3] uint8, its middle `yaw` radians to the right; `fine`
    rays per pixel and axis."""
    count = width * fine
    u, v = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count // 2) + 0.5) / (count // 2))
    lon, lat = (u - 0.5) * 2 * math.pi + yaw, (0.5 - v) * math.pi
    rays = np.stack([np.sin(lon) * np.cos(lat), -np.sin(lat), np.cos(lon) * np.cos(lat)], -1)
    seen = see_walls(walls, np.asarray(origin), rays)
    return seen.reshape(width // 2, fine, width, fine, 3).mean((1, 3)).round().astype(np.uint8)
