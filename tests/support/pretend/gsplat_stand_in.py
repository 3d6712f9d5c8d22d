"""gsplat's own Python wrappers over plain torch: its compiled module `_C` is replaced by functions of tensors.

Projection is gsplat's `_torch_impl`; culling, sorting and blending are written after the rules of gsplat 1.5.3. Outputs of culled Gaussians
are NaN, because gsplat leaves them uninitialised. The functions work on the CPU and on tensors that pretend to be on CUDA, and each counts
as one kernel.
"""

# pyright: basic
import sys
import types
from functools import wraps
from typing import Any

import torch

backend: Any = types.ModuleType("gsplat.cuda._backend")
sys.modules["gsplat.cuda._backend"] = backend
import gsplat  # noqa: E402, F401
from gsplat.cuda import _torch_impl as plain  # noqa: E402

from support.pretend.tensors import Pretender, counts  # noqa: E402

GARBAGE = float("nan")
MOST_ALPHA = 0.999  # of a Gaussian at a pixel; 0.99 in the reference, and in gsplat since 1.6
CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)


class Cam:
    PINHOLE = 0


class C:
    CameraModelType = Cam
    PINHOLE = 0


backend._C = C


def _proj_parts(means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, comp):
    covars, _ = plain._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    # as the kernel: normalised quaternions (torch impl normalises too)
    _, means2d, depths, conics, compensations = plain._fully_fused_projection(
        means, covars, viewmats, Ks, width, height, eps2d, near, far, comp
    )
    return means2d, depths, conics, compensations


def projection_fwd(means, covars, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, comp, model):
    with torch.no_grad():
        for t in (means, quats, scales, viewmats, Ks):
            assert t.is_contiguous()
        means2d, depths, conics, c = _proj_parts(means, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far, clip, True)
        det = conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2
        xx, yy = conics[..., 2] / det, conics[..., 0] / det
        extend = torch.full_like(depths, 3.33)
        ok = (depths >= near) & (depths <= far)
        if opacities is not None:
            o = opacities * (c[0] if comp else 1)
            ok &= (o >= 1 / 255)[None] if o.dim() == 1 else o >= 1 / 255
            extend = torch.minimum(
                extend,
                (2 * torch.log((o * 255).clamp_min(1))).sqrt()[None] if o.dim() == 1 else (2 * torch.log((o * 255).clamp_min(1))).sqrt(),
            )
        rx, ry = (extend * xx.sqrt()).ceil(), (extend * yy.sqrt()).ceil()
        ok &= ~((rx <= clip) & (ry <= clip))
        u, v = means2d.unbind(-1)
        ok &= ~((u + rx <= 0) | (u - rx >= width) | (v + ry <= 0) | (v - ry >= height))
        radii = torch.stack([rx, ry], -1) * ok[..., None]
        radii = torch.nan_to_num(radii).int()

        def g(t):
            return torch.where(ok.view(ok.shape + (1,) * (t.dim() - ok.dim())), t, torch.full_like(t, GARBAGE))

        return radii, g(means2d), g(depths), g(conics), torch.where(ok, c, torch.zeros_like(c)) if comp else None


def projection_bwd(means, covars, quats, scales, viewmats, Ks, width, height, eps2d, model, radii, conics, comps, v2d, vd, vc, vcomp, need):
    with torch.enable_grad():
        m, q, s = (t.detach().requires_grad_() for t in (means, quats, scales))
        means2d, depths, con, c = _proj_parts(m, q, s, None, viewmats, Ks, width, height, eps2d, 0.0, 1e10, 0.0, True)
        ok = (radii > 0).all(-1)

        def clean(v, t):
            return torch.where(ok.view(ok.shape + (1,) * (t.dim() - ok.dim())), v, torch.zeros_like(v))

        total = (
            torch.where(ok[..., None], means2d * clean(v2d, means2d), 0).sum()
            + torch.where(ok, depths * clean(vd, depths), 0).sum()
            + torch.where(ok[..., None], con * clean(vc, con), 0).sum()
        )
        if vcomp is not None:
            total = total + torch.where(ok, c * clean(vcomp, c), 0).sum()
        gm, gq, gs = torch.autograd.grad(total, (m, q, s))
    return gm, None, gq, gs, None


def intersect_tile(means2d, radii, depths, image_ids, gaussian_ids, I, ts, tw, th, sort, segmented):
    assert radii.dtype == torch.int32 and I == 1
    m, r, d = means2d[0], radii[0], depths[0]
    ok = (r > 0).all(1)
    lo = torch.nan_to_num((m - r) / ts).floor()
    hi = torch.nan_to_num((m + r) / ts).ceil()
    lim = torch.tensor([tw, th]).to(lo)
    lo, hi = lo.clamp_min(0).minimum(lim).long(), hi.clamp_min(0).minimum(lim).long()
    span = (hi - lo) * ok[:, None]
    count = span[:, 0] * span[:, 1]
    flat = torch.repeat_interleave(torch.arange(len(m), device=m.device), count)
    local = torch.arange(len(flat), device=m.device) - (count.cumsum(0) - count)[flat]
    w = span[flat, 0]
    tile = (lo[flat, 1] + torch.div(local, w, rounding_mode="floor")) * tw + lo[flat, 0] + local % w
    depth_bits = d[flat].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    keys = (tile << 32) | depth_bits
    keys, order = torch.sort(keys, stable=True)
    return count.int()[None], keys, flat[order].int()


def intersect_offset(keys, I, tw, th):
    n = torch.zeros(tw * th, dtype=torch.int64, device=keys.device).index_add_(0, keys >> 32, torch.ones_like(keys))
    return (n.cumsum(0) - n).int().view(I, th, tw)


def _raster(means2d, conics, colors, opac, bg, width, height, ts, offsets, flat):
    th, tw = offsets.shape[-2:]
    off = offsets.reshape(-1).tolist() + [len(flat)]
    tiles = []
    for i in range(th * tw):
        ids = flat[off[i] : off[i + 1]].long()
        y0, x0 = i // tw * ts, i % tw * ts
        ys = torch.arange(ts, device=means2d.device, dtype=means2d.dtype) + y0 + 0.5
        xs = torch.arange(ts, device=means2d.device, dtype=means2d.dtype) + x0 + 0.5
        yy, xx = torch.meshgrid(ys, xs, indexing="ij")
        px = torch.stack([xx.reshape(-1), yy.reshape(-1)], 1)
        if not len(ids):
            tiles.append(torch.cat([colors.new_zeros(ts * ts, colors.shape[-1]), colors.new_ones(ts * ts, 1)], 1))
            continue
        m, c, o, col = means2d[0, ids], conics[0, ids], opac[0, ids], colors[0, ids]
        dx, dy = m[:, 0] - px[:, :1], m[:, 1] - px[:, 1:]
        sigma = 0.5 * (c[:, 0] * dx * dx + c[:, 2] * dy * dy) + c[:, 1] * dx * dy
        alpha = (o * torch.exp(-sigma)).clamp_max(MOST_ALPHA)
        alpha = torch.where((sigma < 0) | (alpha < 1 / 255), torch.zeros_like(alpha), alpha)
        after = (1 - alpha.detach()).cumprod(1)
        alpha = torch.where(after <= 1e-4, torch.zeros_like(alpha), alpha)
        T = (1 - alpha).cumprod(1)
        before = torch.cat([torch.ones_like(T[:, :1]), T[:, :-1]], 1)
        tiles.append(torch.cat([(alpha * before) @ col, T[:, -1:]], 1))
    out = torch.stack(tiles).view(th, tw, ts, ts, -1).transpose(1, 2).reshape(th * ts, tw * ts, -1)[:height, :width]
    T = out[..., -1:]
    color = out[..., :-1] + (T * bg[0] if bg is not None else 0)
    return color[None], 1 - T[None]


def raster_fwd(means2d, conics, colors, opac, bg, masks, w, h, ts, offsets, flat):
    for t in (means2d, conics, colors, opac, offsets, flat):
        assert t.is_contiguous()
    assert colors.shape[-1] in CHANNELS
    with torch.no_grad():
        c, a = _raster(means2d, conics, colors, opac, bg, w, h, ts, offsets, flat)
    return c, a, torch.zeros(1, h, w, dtype=torch.int32, device=c.device)


def raster_bwd(means2d, conics, colors, opac, bg, masks, w, h, ts, offsets, flat, alphas, last, vc, va, absgrad):
    with torch.enable_grad():
        leaves = [t.detach().requires_grad_() for t in (means2d, conics, colors, opac)]
        c, a = _raster(*leaves, bg, w, h, ts, offsets, flat)
        g = torch.autograd.grad((c * vc).sum() + (a * va).sum(), leaves, allow_unused=True)
        g = [torch.zeros_like(t) if x is None else x for x, t in zip(g, leaves)]
    return None, *g


def harmonics_fwd(degree, dirs, coeffs, masks):
    with torch.no_grad():
        colors = plain._spherical_harmonics(degree, torch.nn.functional.normalize(dirs, dim=-1), coeffs)
        return colors if masks is None else torch.where(masks[..., None], colors, torch.zeros_like(colors))


def harmonics_bwd(bases, degree, dirs, coeffs, masks, v_colors, compute_v_dirs):
    with torch.enable_grad():
        d, c = (t.detach().requires_grad_() for t in (dirs, coeffs))
        colors = plain._spherical_harmonics(degree, torch.nn.functional.normalize(d, dim=-1), c)
        v_colors = v_colors if masks is None else torch.where(masks[..., None], v_colors, torch.zeros_like(v_colors))
        v_d, v_c = torch.autograd.grad(colors, (d, c), v_colors, allow_unused=True)
    return v_c, torch.zeros_like(dirs) if v_d is None else v_d


def counted(name, function):
    """One kernel with the bytes of its inputs and outputs; sorting waits for the device once, for the number of pairs."""

    @wraps(function)
    def call(*args):
        with counts:
            out = function(*args)
        made = out if isinstance(out, tuple) else (out,)
        counts.kernel(f"gsplat {name}", sum(t.numel() * t.element_size() for t in (*args, *made) if isinstance(t, Pretender)))
        if name == "intersect_tile" and any(isinstance(t, Pretender) for t in args):
            counts.wait("gsplat intersect_tile")
        return out

    return staticmethod(call)


for _name, _function in {
    "projection_ewa_3dgs_fused_fwd": projection_fwd,
    "projection_ewa_3dgs_fused_bwd": projection_bwd,
    "intersect_tile": intersect_tile,
    "intersect_offset": intersect_offset,
    "rasterize_to_pixels_3dgs_fwd": raster_fwd,
    "rasterize_to_pixels_3dgs_bwd": raster_bwd,
    "spherical_harmonics_fwd": harmonics_fwd,
    "spherical_harmonics_bwd": harmonics_bwd,
}.items():
    setattr(C, _name, counted(_name, _function))
