"""The C interface of the native library for ctypes: the twin of csrc/se_api.h, which documents
every function and field.

`tests/unit/native/test_api.py` holds the two equal. After a change of the interface raise
`ABI_VERSION`: the build compiles it into the library, and `library.load` refuses a library with
another number. Data pointers are `c_void_p`; `library.pointer` makes them of tensors.
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_float, c_int32, c_int64, c_void_p
from typing import Any

ABI_VERSION = 14

HEAD_TENSORS = ("router_w", "router_b", "w1", "b1", "middle_w", "middle_b", "w2", "b2")
"""The weights of a decoder head, in the order of `SeDecodeHead`."""

_GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")


def _fields(kind: Any, *names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names]


class SeCamera(Structure):
    _fields_ = [
        ("view", c_float * 12),
        *_fields(c_float, "fx", "fy", "cx", "cy", "near_plane"),
        *_fields(c_int32, "width", "height"),
    ]


class SeRasterForward(Structure):
    _fields_ = [
        ("camera", SeCamera),
        *_fields(c_int32, "antialias", "threads"),
        *_fields(c_int64, "m"),
        *_fields(c_void_p, *_GAUSSIANS, "background", "image", "alpha", "depth", "radii"),
    ]


class SeRasterBackward(Structure):
    _fields_ = [
        *_fields(c_int32, "deterministic", "threads", "absolute"),
        *_fields(c_void_p, *_GAUSSIANS, "background", "g_image", "g_alpha", "g_depth"),
        *_fields(c_void_p, *(f"d_{name}" for name in (*_GAUSSIANS, "mean2d", "background"))),
    ]


class SeDecodeHead(Structure):
    _fields_ = [
        *_fields(c_void_p, *HEAD_TENSORS, "gates", "chosen", "chosen_weight"),
        *_fields(c_void_p, *(f"d_{name}" for name in (*HEAD_TENSORS, "gates", "weight"))),
        *_fields(c_int64, "E", "k", "H", "L", "out", "distance", "position"),
    ]


class SeDecode(Structure):
    _fields_ = [
        *_fields(c_void_p, "rows", "xyz", "feature", "log_scaling", "offsets", "camera", "raw", "starts"),
        *_fields(c_void_p, *_GAUSSIANS, "per_length", "source"),
        *_fields(c_void_p, *(f"d_{name}" for name in (*_GAUSSIANS, "raw", "feature", "log_scaling", "offsets"))),
        *_fields(c_void_p, "steps", "factors", "slots", "d_log_steps"),
        *_fields(c_double, "origin"),
        *_fields(c_int64, "A", "N", "K", "F", "threads", "ascending", "frozen"),
        *_fields(c_double, "extent"),
        ("heads", SeDecodeHead * 3),
    ]


class SeAdamTensor(Structure):
    _fields_ = [
        *_fields(c_void_p, "value", "gradient", "first", "second", "rows"),
        *_fields(c_int64, "count", "width"),
        *_fields(c_double, "step_size", "root"),
    ]


class SeSweep(Structure):
    _fields_ = [
        *_fields(c_void_p, "grey", "start", "size", "camera", "compared", "planes", "inverse", "score"),
        *_fields(c_int64, "views", "k", "count"),
        ("threads", c_int32),
    ]


class SeCodeReader(Structure):
    _fields_ = [("words", c_void_p), *_fields(c_int64, "count", "at", "operations"), ("state", c_int64 * 4)]


STRUCTURES: tuple[type[Structure], ...] = (
    SeCamera,
    SeRasterForward,
    SeRasterBackward,
    SeDecodeHead,
    SeDecode,
    SeAdamTensor,
    SeSweep,
    SeCodeReader,
)

_P, _I, _L, _F, _D = c_void_p, c_int32, c_int64, c_float, c_double
FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "se_abi_version": (_I, ()),
    "se_benchmark_multiply_adds": (_D, (_L, _I)),
    "se_raster_forward": (_I, (POINTER(SeRasterForward), POINTER(c_void_p))),
    "se_raster_backward": (_I, (_P, POINTER(SeRasterBackward))),
    "se_raster_release": (None, (_P,)),
    "se_raster_find_visible": (None, (POINTER(SeCamera), _P, _P, _L, _P, _I)),
    "se_raster_count": (None, (_P, _P, _P)),
    "se_decode_chunks": (_L, (_L,)),
    "se_decode_route": (_I, (POINTER(SeDecode),)),
    "se_decode_begin": (_I, (POINTER(SeDecode),)),
    "se_decode_emit": (_I, (POINTER(SeDecode),)),
    "se_decode_backward": (_I, (POINTER(SeDecode),)),
    "se_photometric_loss": (_I, (_P, _P, _L, _L, _F, _F, _I, _P, _P)),
    "se_sum_chunks": (_L, (_L,)),
    "se_volume_forward": (None, (_P, _L, _P, _I)),
    "se_volume_backward": (None, (_P, _L, _F, _P, _I)),
    "se_hinge_forward": (None, (_P, _L, _F, _P, _I)),
    "se_hinge_backward": (None, (_P, _L, _F, _F, _P, _I)),
    "se_adam_step": (_L, (POINTER(SeAdamTensor), _L, _D, _D, _D, _I)),
    "se_sh_forward": (None, (_P, _P, _P, _P, _L, _L, _I, _P, _P, _I)),
    "se_sh_backward": (None, (*[_P] * 10, _L, _L, _I, _I)),
    "se_graph_reverse": (None, (_P, _L, _L, _P, _P)),
    "se_graph_forward": (None, (*[_P] * 5, _L, _L, _L, _F, _P, _P, _I)),
    "se_graph_backward": (None, (*[_P] * 7, _L, _L, _L, _F, _P, _P, _P, _I)),
    "se_grid_forward": (None, (_P, _P, _P, _P, _L, _L, _L, _P, _I)),
    "se_grid_backward": (None, (_P, _P, _P, _P, _L, _L, _L, _P, _I)),
    "se_observe_rows": (None, (_P, _P, _L, _L, _P, _P, _I)),
    "se_observe_drawn": (None, (_P, _P, _P, _L, _P, _P, _I)),
    "se_mcmc_add_noise": (None, (_P, _P, _P, _P, _P, _L, _F, _F, _F, _I)),
    "se_sweep_match": (_I, (POINTER(SeSweep),)),
    "se_sweep_agree": (_I, (POINTER(SeSweep), _P, _P, _F, _F, _D, _P)),
    "se_sweep_compare": (_I, (POINTER(SeSweep), _P, _L, _D, _D, _P, _P)),
    "se_code_symbols": (_L, (_P, _P, _P, _L, _P)),
    "se_code_bits": (None, (_P, _P, _L, _P)),
    "se_code_pack": (_L, (_P, _L, _P)),
    "se_code_start": (_I, (POINTER(SeCodeReader),)),
    "se_code_read": (_I, (POINTER(SeCodeReader), _P, _P, _L, _P)),
    "se_code_read_bits": (_I, (POINTER(SeCodeReader), _P, _L, _P)),
    "se_code_cells": (_L, (_P, _L, _I, _P, _L)),
    "se_code_read_cells": (_I, (POINTER(SeCodeReader), _I, _L, _P)),
    "se_code_predict": (None, (POINTER(c_void_p), _P, _P, _L, _P, _L, _P, _P)),
    "se_code_inputs": (None, (_P, _P, _L, _I, _I, _P)),
    "se_code_blend": (None, (_P, _L, _L, _P, _P, _L, _P)),
    "se_code_parents": (None, (_P, _P, _L, _P, _L, _P, _P)),
    "se_code_restore": (None, (_P, _L, _L, _P, _P, _P)),
}
"""Result and argument types of every exported function, by name."""


def bind(library: ctypes.CDLL) -> None:
    """Set the types of every function. Raises AttributeError if `library` lacks one of them."""
    for name, (result, arguments) in FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, list(arguments)
