"""The rasteriser in plain torch. It defines the picture, and the other rasterisers are tested
against it.

It is slow, but autograd differentiates it on any device and in any precision.

Per Gaussian (EWA splatting as in 3DGS, with the true principal point as in gsplat):
    view      p = R mean + t. The Gaussian is drawn only if p.z > near.
    centre    u = fx p.x / p.z + cx, and v likewise. The centre of pixel (i, j) is (i + 0.5, j +
    0.5). Jacobian  J = [[fx / z, 0, -fx tx / z^2], [0, fy / z, -fy ty / z^2]], where tx = z
    clamp(p.x / z, -cx / fx - m, (W - cx) / fx + m) with
              m = 0.3 W / (2 fx), i.e. 1.3 tan(fov / 2) on either side of a centred axis; ty
              likewise. Outside these limits p.x has no gradient through J, and z has the gradient
              of tx = z limit.
    2D cov    C = J R Sigma R^T J^T + 0.3 I, with Sigma from the quaternions as passed (they are not
    normalised here). A Gaussian
              with det C <= 0 is not drawn.
    antialias (off by default) opacity *= sqrt(max(0.005^2, det(C - 0.3 I) / det C)). The ratio has
    no gradient at the floor.
              gsplat has this floor since 1.6; in 1.5.3 the floor is 0.
    radius    r = ceil(3 sqrt(lambda)), lambda = mid + sqrt(max(0.1, mid^2 - det C)), mid = trace /
    2. The Gaussian is not drawn,
              and its radius is 0, if the square [u - r, u + r] x [v - r, v + r] overlaps no 16 x 16
              tile of the picture, i.e. if u + r <= 0 or u - r >= 16 ceil(W / 16), or likewise for
              v.
Per pixel, for all drawn Gaussians in order of depth z (then of index):
    power = -1/2 (a dx^2 + c dy^2) - b dx dy with the conic (a, b, c) = C^-1. The Gaussian is
    skipped if power > 0. alpha = min(0.99, opacity exp(power)). The Gaussian is skipped if alpha <
    1/255. If T (1 - alpha) < 1e-4, the pixel stops without this Gaussian. Otherwise colour += T
    alpha c, depth += T alpha z, T *= 1 - alpha. The output is colour + T background, 1 - T, and
    depth.

Two things differ from the original CUDA code of 3DGS. A drawn Gaussian reaches every pixel where
its alpha is at least 1/255; there it reaches only the tiles of its 3 sigma square, which cuts off
alphas up to 0.011. The gradient is exact, i.e. zero where alpha is clamped to 0.99; there it passes
the clamp (see `clamp_gradient`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.geometry.rotation import covariance

BLUR = 0.3  # px^2, added to the diagonal of the 2D covariance
MAX_ALPHA = 0.99
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
MIN_COMPENSATION = 0.005
TILE = 16  # px; the radius rule uses these tiles, whatever tile size the picture is drawn with
_CHECKPOINT = 1 << 24  # (pixel, Gaussian) pairs; above, tiles are recomputed in the backward pass instead of kept in memory


class Projected(NamedTuple):
    """Gaussians projected to ellipses in the picture."""

    mean2d: Tensor  # [M, 2] px
    depth: Tensor  # [M] world units along z
    cov2d: Tensor  # [M, 3] px^2: xx, xy, yy, including the blur
    conic: Tensor  # [M, 3] inverse of cov2d: xx, xy, yy
    compensation: Tensor  # [M] factor of the opacity for antialiasing
    radii: Tensor  # [M] int32 px


@dataclass(frozen=True)
class ReferenceRasterizer:
    """Draws with plain torch.

    Args:
        antialias: Multiply opacities by the compensation of the blur (Mip-Splatting).
        clamp_gradient: Pass the gradient of opacity and shape through the clamp of alpha at 0.99,
            as the original CUDA code does.
        tile: Edge in px of the blocks that the picture is drawn in (None: one block). It affects
            speed and memory only.
        absolute: `mean2d_grad` holds, for each axis, the sum over pixels of the absolute values of
            a pixel's gradient (AbsGS).
    """

    antialias: bool = False
    clamp_gradient: bool = False
    tile: int | None = TILE
    name: str = field(default="reference", init=False)
    absolute: bool = False

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render:
        """Draw M Gaussians over `background` [3], see `types.Render`. A backward pass overwrites
        `mean2d_grad`."""
        projected = project(g.means, g.quats, g.scales, camera)
        ids = torch.where(projected.radii > 0)[0]
        ids = ids[projected.depth.detach()[ids].argsort(stable=True)]  # near to far
        mean2d, opacity = projected.mean2d[ids], g.opacities[ids]
        if self.antialias:
            opacity = opacity * projected.compensation[ids]
        sums = torch.zeros_like(mean2d) if self.absolute and torch.is_grad_enabled() else None
        instead = None if sums is None else lambda: sums
        grad = record_mean2d_grad(mean2d, (g.scales, g.quats, g.opacities, g.colors), camera, len(g), ids, instead)
        columns = [mean2d, projected.conic[ids], opacity[:, None], g.colors[ids], projected.depth[ids, None]]
        reach = _compute_reach(mean2d, projected.cov2d[ids], opacity)
        out = self._draw_blocks(torch.cat(columns, dim=1), reach, camera, sums)
        color, depth, transmittance = out[..., :3], out[..., 3], out[..., 4]
        image = color + transmittance[..., None] * background.to(color)
        return Render(image, 1 - transmittance, depth, projected.radii, grad)

    @torch.no_grad()
    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
        """Return [A] bool: whether unrotated Gaussians at `means` [A, 3] with `scales` [A, 3] are
        drawn (radius > 0)."""
        return visible(means, scales, camera)

    def _draw_blocks(self, splats: Tensor, reach: Tensor, camera: Camera, sums: Tensor | None) -> Tensor:
        """Return colour, depth and final transmittance [H, W, 5] of splats [V, 10] that are sorted
        from near to far.

        The backward pass adds the absolute values of the pixels' gradients to `sums` [V, 2].
        """
        height, width = camera.height, camera.width
        block = (height, width) if self.tile is None or not len(splats) else (self.tile, self.tile)
        down, across = -(-height // block[0]), -(-width // block[1])
        entries, counts = _sort_into_blocks(reach, block, down, across)
        lists = splats[entries].split(counts)  # one gather for all, so that the backward pass is one scatter
        places = entries.split(counts)
        pairs = len(entries) * block[0] * block[1]
        recompute = torch.is_grad_enabled() and splats.requires_grad and pairs > _CHECKPOINT
        blank = _blend(splats[:0], _pixel_centres((0, 0), block, splats), False)  # of the splats, so that the picture can go backward
        tiles = []
        for number, part in enumerate(lists):
            if not len(part) and len(lists) > 1:
                tiles.append(blank)
                continue
            corner = (number // across * block[0], number % across * block[1])
            pixels = _pixel_centres(corner, block, splats)
            add = None if sums is None else partial(add_absolute, sums, places[number])
            if recompute:
                tiles.append(checkpoint(_blend, part, pixels, self.clamp_gradient, add, use_reentrant=False))
            else:
                tiles.append(_blend(part, pixels, self.clamp_gradient, add))
        grid = torch.stack(tiles).view(down, across, block[0], block[1], 5).transpose(1, 2)
        return grid.reshape(down * block[0], across * block[1], 5)[:height, :width]


def project(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> Projected:
    """Compute the steps from view to radius for M Gaussians. Those that are not drawn have finite
    values and radius 0."""
    camera = camera.to(means.device, means.dtype)
    rotation, shift = camera.world_to_cam[:3, :3], camera.world_to_cam[:3, 3]
    view = means @ rotation.T + shift
    front = view[:, 2] > camera.near
    x, y, z = (torch.where(front, view[:, i], instead) for i, instead in enumerate((0.0, 0.0, 1.0)))  # no division by 0
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    mean2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    margin_x, margin_y = 0.3 * camera.width / (2 * fx), 0.3 * camera.height / (2 * fy)
    tx = z * (x / z).clamp(-cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    ty = z * (y / z).clamp(-cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2], dim=1).view(-1, 2, 3)
    to_pixels = jacobian @ rotation
    cov = to_pixels @ covariance(quats, scales) @ to_pixels.transpose(1, 2)

    sharp = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
    xx, xy, yy = cov[:, 0, 0] + BLUR, cov[:, 0, 1], cov[:, 1, 1] + BLUR
    det = xx * yy - xy**2
    drawn = front & (det > 0)
    det = torch.where(drawn, det, torch.ones_like(det))
    conic = torch.stack([yy / det, -xy / det, xx / det], dim=1)
    compensation = (sharp / det).clamp_min(MIN_COMPENSATION**2).sqrt()
    radii = _compute_radii(mean2d.detach(), xx.detach(), yy.detach(), det.detach(), drawn, camera)
    return Projected(mean2d, view[:, 2], torch.stack([xx, xy, yy], dim=1), conic, compensation, radii)


@torch.no_grad()
def visible(means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
    """Return [A] bool: whether unrotated Gaussians at `means` [A, 3] with `scales` [A, 3] have a
    radius above 0 (Scaffold-GS)."""
    quats = torch.zeros((len(means), 4), dtype=means.dtype, device=means.device)
    quats[:, 0] = 1
    return project(means, quats, scales, camera).radii > 0


def record_mean2d_grad(
    mean2d: Tensor,
    others: tuple[Tensor, ...],
    camera: Camera,
    total: int,
    ids: Tensor | slice,
    instead: Callable[[], Tensor] | None = None,
) -> Tensor:
    """Return a buffer [total, 2] of zeros. The backward pass writes d loss / d `mean2d` in NDC to
    its rows `ids`.

    The gradient in NDC is the gradient in px times (W/2, H/2). `instead` returns sums of absolute
    values in px; the backward pass writes these instead and sets them to zero.
    """
    buffer = mean2d.new_zeros((total, 2))
    if not torch.is_grad_enabled():
        return buffer
    if not mean2d.requires_grad and any(t.requires_grad for t in others):
        mean2d.requires_grad_()
    if mean2d.requires_grad:

        def store(gradient: Tensor | None) -> None:
            if gradient is None:  # autograd found it to be zero
                buffer[ids] = 0.0
            else:  # column by column: building a tensor from the two numbers would synchronise with a GPU
                sums = gradient.detach() if instead is None else instead()
                x, y = sums.unbind(1)
                buffer[ids] = torch.stack([x * (camera.width / 2), y * (camera.height / 2)], dim=1)
                if instead is not None:
                    sums.zero_()

        mean2d.register_hook(store)
    return buffer


def _compute_radii(mean2d: Tensor, xx: Tensor, yy: Tensor, det: Tensor, drawn: Tensor, camera: Camera) -> Tensor:
    """Return the 3 sigma radius [M] int32 in px, 0 for Gaussians that are not drawn."""
    mid = (xx + yy) / 2
    radius = (3 * (mid + (mid**2 - det).clamp_min(0.1).sqrt()).sqrt()).ceil()
    for centre, side in zip(mean2d.unbind(1), (camera.width, camera.height)):
        drawn = drawn & (centre + radius > 0) & (centre - radius < -(-side // TILE) * TILE)
    drawn = drawn & radius.isfinite()
    return torch.where(drawn, radius.clamp_max(2.0**30), torch.zeros_like(radius)).to(torch.int32)


@torch.no_grad()
def _compute_reach(mean2d: Tensor, cov2d: Tensor, opacity: Tensor) -> Tensor:
    """Return the box [V, 4] (left, top, right, bottom in px) outside which alpha < 1/255.

    The box is empty (right < left) if alpha is below 1/255 everywhere.
    """
    log = torch.log(opacity / MIN_ALPHA)
    extent = (2 * log.clamp_min(0)).sqrt()[:, None] * cov2d[:, [0, 2]].sqrt() * 1.001 + 0.01  # slightly enlarged against rounding
    extent = torch.where(log[:, None] >= -1e-3, extent, torch.full_like(extent, -math.inf))
    return torch.cat([mean2d - extent, mean2d + extent], dim=1)


@torch.no_grad()
def _sort_into_blocks(reach: Tensor, block: tuple[int, int], down: int, across: int) -> tuple[Tensor, list[int]]:
    """Sort splats into blocks. Returns their indices [B], block after block in row order, and the
    number in each block.

    Within a block the splats keep their order.
    """
    size = reach.new_tensor([block[1], block[0]])
    most = reach.new_tensor([across, down])
    first = (reach[:, :2] / size).floor().maximum(torch.zeros_like(most)).minimum(most).long()
    last = ((reach[:, 2:] / size).floor() + 1).maximum(torch.zeros_like(most)).minimum(most).long()  # exclusive
    span = (last - first).clamp_min(0)
    span = span * (reach[:, 2:] > reach[:, :2]).all(1, keepdim=True)
    count = span[:, 0] * span[:, 1]
    splat = torch.repeat_interleave(torch.arange(len(reach), device=reach.device), count)
    local = torch.arange(len(splat), device=reach.device) - (count.cumsum(0) - count)[splat]
    columns = span[splat, 0]
    row = first[splat, 1] + torch.div(local, columns, rounding_mode="floor")
    column = first[splat, 0] + local % columns
    number = row * across + column
    order = number.argsort(stable=True)  # keeps the order from near to far within a block
    return splat[order], torch.bincount(number, minlength=down * across).tolist()


def add_absolute(sums: Tensor, places: Tensor, axis: int, gradient: Tensor) -> None:
    """Add the sums over pixels of |gradient| [P, S] to column `axis` of `sums` [V, 2] at `places`
    [S]."""
    sums[:, axis].index_add_(0, places, gradient.detach().abs().sum(0))


def _pixel_centres(corner: tuple[int, int], block: tuple[int, int], like: Tensor) -> Tensor:
    """Return the pixel centres [P, 2] (x, y) of a block whose first pixel is `corner` (row,
    column)."""
    rows = torch.arange(block[0], device=like.device, dtype=like.dtype) + (corner[0] + 0.5)
    columns = torch.arange(block[1], device=like.device, dtype=like.dtype) + (corner[1] + 0.5)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def _blend(splats: Tensor, pixels: Tensor, clamp_gradient: bool, see: Callable[[int, Tensor], None] | None = None) -> Tensor:
    """Blend sorted splats [S, 10] front to back at pixels [P, 2]. Returns colour, depth and final
    transmittance [P, 5].

    The backward pass calls `see` with each axis and the gradients [P, S] of the pixels in the
    splats' centres along it.
    """
    u, v, a, b, c, opacity = splats[:, :6].unbind(1)
    dx, dy = u - pixels[:, :1], v - pixels[:, 1:]  # [P, S]
    if see is not None and dx.requires_grad:
        for axis, offset in enumerate((dx, dy)):
            offset.register_hook(partial(see, axis))
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
    raw = opacity * power.clamp_max(0).exp()
    alpha = raw.clamp_max(MAX_ALPHA)
    if clamp_gradient:
        alpha = raw + (alpha - raw).detach()
    alpha = torch.where((power <= 0) & (alpha >= MIN_ALPHA), alpha, torch.zeros_like(alpha))
    after = (1 - alpha.detach()).cumprod(1)  # transmittance behind each splat; it decreases, so the stop cuts off a tail
    kept = torch.where(after >= MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
    through = (1 - kept).cumprod(1)
    before = torch.cat([torch.ones_like(pixels[:, :1]), through], dim=1)
    return torch.cat([(kept * before[:, :-1]) @ splats[:, 6:], before[:, -1:]], dim=1)
