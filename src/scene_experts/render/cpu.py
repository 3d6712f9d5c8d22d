"""The fast CPU rasteriser: the image that reference.py defines and all its gradients, computed by
the compiled library (csrc/raster*).

It works in float32 and, like the reference, does not normalise quaternions. Two correct rasterisers
may differ in single pixels by 4e-3 of a colour where an alpha is within rounding of 1/255, and by
1e-2 where a transmittance is within rounding of the stop (two alphas of 0.99 are), so compare means
and quantiles.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.native import library as native
from scene_experts.native.api import SeCamera, SeRasterBackward, SeRasterForward


@dataclass(frozen=True)
class CpuRasterizer:
    """Renders Gaussians on the CPU with the compiled library.

    `deterministic`: gradients are bit-identical from run to run and for any number of threads, on
    one machine and instruction set (images always are). `level`: the instruction set, one of
    `native.LEVELS` (None: the best of this processor). `threads`: None for torch's setting.
    `absolute`: `mean2d_grad` holds the sums of absolute values. Raises InputError if the library
    cannot be loaded.
    """

    antialias: bool = False
    deterministic: bool = False
    level: str | None = None
    threads: int | None = None
    name: str = "cpu"
    absolute: bool = False

    def __post_init__(self) -> None:
        try:
            native.require(self.level)
        except InputError as error:
            raise InputError(f"{error}; or choose the slow rasteriser `reference`") from None

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render:
        """Render M Gaussians over `background` [3]; see `types.Render`. The backward pass
        overwrites `mean2d_grad`."""
        inputs = {"means": g.means, "quats": g.quats, "scales": g.scales, "opacities": g.opacities, "colors": g.colors}
        _check(inputs, len(g))
        _check({"background": background})
        _check_size(camera)
        mean2d_grad = torch.zeros((len(g), 2))
        image, alpha, depth, radii = _Draw.apply(*inputs.values(), background, self, camera, mean2d_grad)
        return Render(image, alpha, depth, radii, mean2d_grad)

    @torch.no_grad()
    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
        """Mask [A] bool of the unrotated Gaussians at `means` [A, 3] with `scales` [A, 3] that have
        a radius > 0 (Scaffold-GS)."""
        _check({"means": means, "scales": scales}, len(means))
        _check_size(camera)
        means, scales = _convert(means), _convert(scales)
        out = torch.empty(len(means), dtype=torch.bool)
        where = [native.pointer(t) for t in (means, scales, out)]
        library = native.require(self.level)
        library.se_raster_find_visible(ctypes.byref(convert_camera(camera)), *where[:2], len(means), where[2], self._count_threads())
        return out

    def _count_threads(self) -> int:
        return max(1, self.threads if self.threads is not None else native.count_threads())


class _State:
    """Memory of the library for the backward pass of one image; released with the graph, whether
    the backward pass ran or not."""

    def __init__(self, library: ctypes.CDLL, address: int) -> None:
        self.library, self.address = library, address

    def __del__(self) -> None:
        self.library.se_raster_release(ctypes.c_void_p(self.address))


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, colors, background, how: CpuRasterizer, camera: Camera, mean2d_grad):
        plain = [_convert(t) for t in (means, quats, scales, opacities, colors, background)]
        size = (camera.height, camera.width)
        image, alpha, depth = torch.empty((*size, 3)), torch.empty(size), torch.empty(size)
        radii = torch.empty(len(means), dtype=torch.int32)
        library = native.require(how.level)
        where = [t.data_ptr() for t in (*plain, image, alpha, depth, radii)]
        args = SeRasterForward(convert_camera(camera), how.antialias, how._count_threads(), len(means), *where)
        state = ctypes.c_void_p()
        keep = any(ctx.needs_input_grad)
        code = library.se_raster_forward(ctypes.byref(args), ctypes.byref(state) if keep else None)
        native.check(code, f"drawing {len(means):,} Gaussians")
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        if keep:
            ctx.state = _State(library, state.value or 0)
            ctx.how, ctx.mean2d_grad = how, mean2d_grad
            ctx.save_for_backward(*plain)
        return image, alpha, depth, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        plain = ctx.saved_tensors
        up = [None if g is None else _convert(g) for g in grad_outputs[:3]]  # of image, alpha, depth; None: zero
        outputs = [torch.empty_like(t) for t in plain[:5]] + [ctx.mean2d_grad, torch.empty(3)]
        how: CpuRasterizer = ctx.how
        where = [None if t is None else t.data_ptr() for t in (*plain, *up, *outputs)]
        args = SeRasterBackward(how.deterministic, how._count_threads(), how.absolute, *where)
        code = ctx.state.library.se_raster_backward(ctypes.c_void_p(ctx.state.address), ctypes.byref(args))
        native.check(code, "the backward pass of the image")
        return *outputs[:5], outputs[6], None, None, None


def convert_camera(camera: Camera) -> SeCamera:
    """Convert `camera` to the structure of the library."""
    rows = [value for row in camera.world_to_cam.tolist()[:3] for value in row]
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    return SeCamera((ctypes.c_float * 12)(*rows), fx, fy, cx, cy, camera.near, camera.width, camera.height)


_WIDTHS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "colors": (3,), "background": (3,)}


def _check(inputs: dict[str, Tensor], *count: int) -> None:
    """Raise InputError unless each of the named tensors lies on the CPU and has its shape, after a
    first axis of `count`, if given."""
    for name, tensor in inputs.items():
        expected = (*count, *_WIDTHS[name])
        if tensor.shape != expected or not tensor.is_cpu:
            found = f"{tuple(tensor.shape)} on {tensor.device}"
            raise InputError(f"expected {name} of shape {expected} on the CPU, found {found}")


def _check_size(camera: Camera) -> None:
    """Raise InputError if an image has more tiles of 16 x 16 pixels than the library can number."""
    tiles = [-(-side // 16) for side in (camera.width, camera.height)]
    areas = [-(-count // 4) + 1 for count in tiles]
    if max(tiles) > 65_535 or areas[0] * areas[1] > 65_536:
        raise InputError(
            f"expected an image of at most 1,048,560 px a side and 260 million px in total, found {camera.width:,} x {camera.height:,} px; "
            "choose a smaller size"
        )


def _convert(tensor: Tensor) -> Tensor:
    if tensor.is_cpu and tensor.dtype is torch.float32 and tensor.is_contiguous():
        return tensor  # the usual case; every torch call costs microseconds in which other threads wait
    return tensor.detach().to(device="cpu", dtype=torch.float32).contiguous()
