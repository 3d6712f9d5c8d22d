"""Camera lenses: the camera models of COLMAP and Brown's, their distortion, and the pinhole camera
that each is undistorted to.

(u, v) are normalised pinhole coordinates x/z, y/z. Pixel coordinates are COLMAP's: the centre of
the first pixel is (0.5, 0.5).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.errors import InputError
from scene_experts.data import lens_forms as forms
from scene_experts.data.equirectangular import PanoramaView, view_side
from scene_experts.data.lens_forms import LARGEST_ANGLE

Array = NDArray[np.floating]

# COLMAP's models in the order of their ids, then ours. "f" stands for fx = fy. The coefficients of RAD_TAN_THIN_PRISM_FISHEYE, which
# COLMAP numbers from 0, are named like those of the other models.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", *(f"k{i}" for i in range(1, 7)), "p2", "p1", "sx1", "sx2", "sy1", "sy2"),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
    "EQUIRECTANGULAR": ("w", "h"),  # a panorama, 360 degrees around: captures have views of it (`view_of_panorama`)
    "BROWN": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "skew"),  # skew: of v in u
}
PANORAMA, PANORAMA_VIEW = "EQUIRECTANGULAR", "PANORAMA_VIEW"
MODELS[PANORAMA_VIEW] = ("fx", "fy", "yaw", "pitch")  # of `data.equirectangular`, degrees
COLMAP_MODELS = tuple(name for name in MODELS if name not in ("BROWN", PANORAMA_VIEW))
FISHEYE = frozenset(name for name in MODELS if name.endswith("FISHEYE"))
DIVISION = ("SIMPLE_DIVISION", "DIVISION")
_LARGEST, _LONGEST = 1e9, 1 << 20  # of a parameter, and of a side in pixels
_SHORTEST = 1e-6  # px, of a focal length: powers of shorter ones overflow


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera model with its image size and parameters in pixels.

    Raises InputError for an unknown model, a wrong number of parameters, values that are not
    finite, and a focal length or size that is not positive.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(unreadable_model(self.model))
        if len(self.params) != len(MODELS[self.model]):
            raise InputError(
                f"expected {len(MODELS[self.model])} parameters for camera model {self.model}, found {len(self.params)}; restore the file"
            )
        fits = all(abs(p) <= _LARGEST for p in self.params) and max(self.width, self.height) <= _LONGEST  # False for NaN
        if not fits or self.fx < _SHORTEST or self.fy < _SHORTEST or self.width < 1 or self.height < 1:
            raise InputError(
                f"expected a camera with a positive size and focal length and finite parameters in range, found {self.model} "
                f"{self.width:.9g}x{self.height:.9g} {self.params}; remove it or reconstruct the capture again"
            )

    def value(self, name: str) -> float:
        """Return the parameter `name`, or 0 if the model does not have it."""
        names = MODELS[self.model]
        return self.params[names.index(name)] if name in names else 0.0

    @property
    def fx(self) -> float:
        return self.params[0]

    @property
    def fy(self) -> float:
        return self.params[1] if MODELS[self.model][1] == "fy" else self.params[0]

    @property
    def cx(self) -> float:
        return self.value("cx")

    @property
    def cy(self) -> float:
        return self.value("cy")

    @property
    def distorted(self) -> bool:
        """Whether straight lines appear bent: always for a fisheye lens, otherwise if a distortion
        coefficient is not 0."""
        geometric = {"f", "fx", "fy", "cx", "cy"}
        if self.model == "EUCM":
            return self.value("alpha") != 0
        return (
            self.model in FISHEYE
            or self.model == PANORAMA_VIEW
            or any(p != 0 for n, p in zip(MODELS[self.model], self.params) if n not in geometric)
        )

    def resize(self, width: int, height: int) -> Lens:
        """Return the same lens for an image of another size. Each axis is scaled by its own ratio,
        exactly.

        With pixel centres at +0.5, the focal length and the principal point are multiplied by the
        ratio, without an offset. A model with one focal length becomes a model with two if the
        ratios differ.
        """
        sx, sy = width / self.width, height / self.height
        if sx == sy == 1.0:
            return self
        names, params = MODELS[self.model], list(self.params)
        model = self.model
        if names[0] == "f" and sx != sy:  # one focal length cannot represent two ratios
            model = _TWO_FOCALS[self.model]
            params = [self.value(n) if n not in ("fx", "fy") else self.params[0] for n in MODELS[model]]
            names = MODELS[model]
        factor = {"f": sx, "fx": sx, "cx": sx, "fy": sy, "cy": sy}
        return Lens(model, width, height, tuple(p * factor.get(n, 1.0) for n, p in zip(names, params)))

    def distort(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Map normalised pinhole coordinates to normalised distorted ones (u', v'); the pixel is
        (fx u' + cx, fy v' + cy)."""
        if self.model == "FOV":
            return forms.distort_fov(self.value("omega"), u, v)
        if self.model in DIVISION:
            return forms.distort_division(self.value("k"), u, v)
        if self.model == "EUCM":
            return forms.distort_unified(self.value("alpha"), self.value("beta"), u, v)
        if self.model in FISHEYE:  # equidistant projection first: |(u, v)| = angle from the axis
            r = np.hypot(u, v)
            s = np.where(r > 1e-8, np.arctan(r) / np.maximum(r, 1e-8), 1.0)
            u, v = u * s, v * s
        return self._distort_polynomial(u, v)

    def undistort(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Invert `distort` by Newton's method. Rays over 88 degrees from the axis of a fisheye lens
        are clamped to 88 degrees.

        The result is NaN where no ray nearer to the axis than `find_fold` gets there, as in the
        corners of a photograph whose polynomial was fitted to its middle.
        """
        if self.model == "FOV":
            return forms.undistort_fov(self.value("omega"), u, v)
        if self.model in DIVISION:
            return forms.undistort_division(self.value("k"), u, v)
        if self.model == "EUCM":
            return forms.undistort_unified(self.value("alpha"), self.value("beta"), u, v)
        with np.errstate(all="ignore"):  # where Newton's method diverges
            a, b = self._undistort_polynomial(u, v)
            x, y = self._distort_polynomial(a, b)
            found = (np.hypot(x - u, y - v) <= 1e-6 * (1 + np.hypot(u, v))) & (np.hypot(a, b) <= self.find_fold())
        a, b = np.where(found, a, np.nan), np.where(found, b, np.nan)
        if self.model in FISHEYE:
            theta = np.hypot(a, b)
            s = np.where(theta > 1e-8, np.tan(np.minimum(theta, LARGEST_ANGLE)) / np.maximum(theta, 1e-8), 1.0)
            a, b = a * s, b * s
        return a, b

    def find_fold(self) -> float:
        """Return the radius at which the radial polynomial turns back, so that rays further out
        fall onto nearer ones; infinity: nowhere.

        The radius is that of (u, v), and the angle from the axis in radians for a fisheye lens.
        """
        if self.model in DIVISION:
            return 0.5 / math.sqrt(self.value("k")) if self.value("k") > 0 else math.inf
        k = [self.value(n) for n in ("k1", "k2", "k3", "k4", "k5", "k6")]
        full, x = self.model == "FULL_OPENCV", np.polynomial.Polynomial([0.0, 1.0])  # x = radius squared
        above = np.polynomial.Polynomial([1.0, *(k[:3] if full else k)])
        below = np.polynomial.Polynomial([1.0, *k[3:]] if full else [1.0])
        slope = (above + 2 * x * above.deriv()) * below - 2 * x * above * below.deriv()  # of radius * above / below, times below squared
        roots = np.concatenate([part.trim().roots() for part in (slope, below)])
        ahead = roots[(roots.imag == 0) & (roots.real > 0)].real
        return math.sqrt(ahead.min()) if len(ahead) else math.inf

    def is_folded(self, u: Array, v: Array) -> NDArray[np.bool_]:
        """Return which rays lie beyond `find_fold`: the photograph does not show them, wherever
        `distort` puts them."""
        r = np.hypot(u, v)
        return (np.arctan(r) if self.model in FISHEYE else r) > self.find_fold()

    def _distort_polynomial(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Apply the radial, tangential and thin-prism terms, the polynomial part of every model
        (formulas of OpenCV and COLMAP)."""
        k = [self.value(n) for n in ("k1", "k2", "k3", "k4", "k5", "k6")]
        p1, p2, sx, sx2, sy, sy2 = (self.value(n) for n in ("p1", "p2", "sx1", "sx2", "sy1", "sy2"))
        r2 = u * u + v * v
        if self.model == "FULL_OPENCV":
            radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))
        else:
            radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))))
        if self.model == "RAD_TAN_THIN_PRISM_FISHEYE":  # its other terms act on what the radial term has moved
            u, v, radial = u * radial, v * radial, 1.0
            r2 = u * u + v * v
        uv = u * v
        x = u * radial + 2 * p1 * uv + p2 * (r2 + 2 * u * u) + r2 * (sx + r2 * sx2)
        y = v * radial + 2 * p2 * uv + p1 * (r2 + 2 * v * v) + r2 * (sy + r2 * sy2)
        return x + self.value("skew") * y, y

    def _undistort_polynomial(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Solve `_distort_polynomial(a, b) = (u, v)` by Newton's method with central differences,
        starting at (u, v)."""
        a, b, h = u.copy(), v.copy(), 1e-6
        for _ in range(60):
            fu, fv = self._distort_polynomial(a, b)
            (r, s), (t, w) = self._distort_polynomial(a + h, b), self._distort_polynomial(a - h, b)
            (x, y), (m, n) = self._distort_polynomial(a, b + h), self._distort_polynomial(a, b - h)
            j00, j10, j01, j11 = (r - t) / (2 * h), (s - w) / (2 * h), (x - m) / (2 * h), (y - n) / (2 * h)
            det = j00 * j11 - j01 * j10
            det = np.where(np.abs(det) < 1e-9, 1e-9, det)
            eu, ev = fu - u, fv - v
            da, db = (j11 * eu - j01 * ev) / det, (j00 * ev - j10 * eu) / det
            a, b = a - da, b - db
            if float(np.max(np.abs(da)) + np.max(np.abs(db))) < 1e-10:
                break
        return a, b


# The model with two focal lengths that represents each model with one focal length exactly.
_TWO_FOCALS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_FISHEYE": "FISHEYE",
    "SIMPLE_DIVISION": "DIVISION",
}


def unreadable_model(found: str | int) -> str:
    """Return what to do about a camera model, by its name or COLMAP's id, that is not read."""
    return (
        f"expected a camera model among {', '.join(COLMAP_MODELS)}, found {found!r}; undistort the photographs with "
        f"`colmap image_undistorter`, which writes PINHOLE"
    )


@functools.lru_cache(maxsize=64)  # views share their cameras
def to_pinhole(lens: Lens) -> Lens:
    """Return the pinhole camera that `lens` is undistorted to: the same focal lengths and the
    largest size without empty pixels.

    As in COLMAP, the image border is undistorted, and each axis is grown or cropped about the
    principal point until every output pixel lies inside the photograph, within 0.2 to 2 times the
    original size. Border pixels that no ray reaches do not count; a side without any other pixel
    lies at the fold of the lens. A lens without distortion keeps its size.
    """
    w, h = lens.width, lens.height
    if lens.model == PANORAMA_VIEW:
        side = view_side(w)
        return Lens("PINHOLE", side, side, (side / 2, side / 2, side / 2, side / 2))
    if not lens.distorted:
        return Lens("PINHOLE", w, h, (lens.fx, lens.fy, lens.cx, lens.cy))

    def border(x: Array, y: Array) -> tuple[Array, Array]:
        u, v = lens.undistort((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
        return u * lens.fx + lens.cx, v * lens.fy + lens.cy

    fold = lens.find_fold()
    reach = math.tan(min(fold, LARGEST_ANGLE)) if lens.model in FISHEYE else fold
    if lens.model in DIVISION or lens.model == "EUCM":
        reach = min(fold, math.tan(LARGEST_ANGLE))

    def innermost(side: Array, choose: Callable[[Array], np.floating], farthest: float) -> float:
        reached = side[np.isfinite(side)]
        return float(choose(reached)) if len(reached) else farthest

    rows, cols = np.arange(h) + 0.5, np.arange(w) + 0.5
    left = innermost(border(np.full(h, 0.5), rows)[0], np.max, lens.cx - reach * lens.fx)
    right = innermost(border(np.full(h, w - 0.5), rows)[0], np.min, lens.cx + reach * lens.fx)
    top = innermost(border(cols, np.full(w, 0.5))[1], np.max, lens.cy - reach * lens.fy)
    bottom = innermost(border(cols, np.full(w, h - 0.5))[1], np.min, lens.cy + reach * lens.fy)
    # The principal point keeps its fraction of the image, hence the larger (stricter) of the two
    # ratios.
    scale_x = 1 / max(lens.cx / max(lens.cx - left, 1e-9), (w - 0.5 - lens.cx) / max(right - lens.cx, 1e-9), 1e-9)
    scale_y = 1 / max(lens.cy / max(lens.cy - top, 1e-9), (h - 0.5 - lens.cy) / max(bottom - lens.cy, 1e-9), 1e-9)
    width, height = (max(1, int(min(max(s, 0.2), 2.0) * n)) for s, n in ((scale_x, w), (scale_y, h)))
    return Lens("PINHOLE", width, height, (lens.fx, lens.fy, lens.cx * width / w, lens.cy * height / h))


def view_of_panorama(lens: Lens, view: PanoramaView) -> Lens:
    """Return the lens of a view that is cut out of a panorama while it is read."""
    focal = view_side(lens.width) / 2
    return Lens(PANORAMA_VIEW, lens.width, lens.height, (focal, focal, view.yaw, view.pitch))


def centre_principal_point(lens: Lens) -> Lens:
    """Move the principal point of `lens` to the image centre, as code that ignores it assumes."""
    centre = {"cx": lens.width / 2, "cy": lens.height / 2}
    return replace(lens, params=tuple(centre.get(n, p) for n, p in zip(MODELS[lens.model], lens.params)))
