"""Scenes of anchors as whole numbers and back: what a compact file holds of them.

`round_scene` and `restore` are each other's inverse up to the rounding that a `Precision` states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Damaged
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.precision import ROUNDED, Precision, from_spread, is_exact, rows_of
from scene_experts.files.codec.groups import CLASS, EXTRA, FEATURE, OFFSETS, SCALING, SLOTS
from scene_experts.files.codec.numbers import Rounded
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import restore as restore_values

MOST_SYMBOL = 1 << 30
FURTHER = {"interval": 0.02, "extra_level": 0.008}
"""Columns of one value, with their steps: the logarithm of an interval, and the share of a
level."""
_LEAST_INTERVAL = 1e-30
ROWS = 4096  # anchors that are rounded together


@dataclass(frozen=True)
class WholeScene:
    """A scene of anchors as whole numbers, in the order of its rows."""

    values: dict[str, Ints]
    """By group of the codec: [C, N] int32."""
    steps: dict[str, list[float]]
    """By group, of its channels: a value is number * step * 2^class, in the group of further
    columns without a class."""
    extra: list[str]
    """The names of the further columns."""
    networks: dict[str, Rounded]
    exact: dict[str, NDArray[np.float32]]
    """Tensors that are held as they are."""


def round_scene(data: AnchorData, rows: NDArray[Any] | None = None) -> WholeScene:
    """The whole numbers of a scene, in the order of `rows` [N] if given. Raises InputError for values
    that are not finite or are too large for their steps."""
    p, n = data.precision or from_spread(data.columns, data.networks), len(data.columns["xyz"])
    order = torch.arange(n) if rows is None else torch.from_numpy(np.asarray(rows, np.int64))
    classes = p.classes.detach().cpu().to(torch.int32)[order]
    parts: dict[str, Ints] = {}
    for name in ROUNDED:
        value = data.columns[name].detach().cpu().reshape(n, math.prod(data.columns[name].shape[1:]))
        parts[name] = _round_rows(value, order, p.steps[name].cpu().double(), 2.0 ** classes.double(), name)
    values = {CLASS: classes.numpy()[None], FEATURE: parts["feature"], SCALING: parts["log_scaling"], OFFSETS: parts["offsets"]}
    c = {name: data.columns[name].detach().cpu()[order] for name in (*FURTHER, "slots") if name in data.columns}
    extra = [name for name in FURTHER if name in c]
    if extra:
        further = {name: c[name].double().numpy() for name in extra}
        further |= {"interval": np.log(np.maximum(further["interval"], _LEAST_INTERVAL))} if "interval" in extra else {}
        values[EXTRA] = np.stack([_whole(further[name] / FURTHER[name], name) for name in extra])
    if "slots" in c:
        live = c["slots"].numpy().T
        values[SLOTS] = np.ascontiguousarray(live, np.int32)
        values[OFFSETS] = values[OFFSETS] * np.repeat(live, 3, 0)
    steps = {FEATURE: p.steps["feature"].tolist(), SCALING: p.steps["log_scaling"].tolist(), OFFSETS: p.steps["offsets"].tolist()}
    steps |= {EXTRA: [FURTHER[name] for name in extra]} if extra else {}
    networks, exact = {}, {}
    for name, value in data.networks.items():
        value = value.detach().cpu().float()
        if not value.isfinite().all():
            raise InputError(f"expected finite weights of {name}, found others; train again")
        if is_exact(name):
            exact[name] = value.numpy()
        else:
            networks[name] = _round_network(name, value, p.networks[name], _columns(data).get(name))
    return WholeScene(values, {name: [float(f"{s:.4g}") for s in found] for name, found in steps.items()}, extra, networks, exact)


def _round_rows(value: Tensor, order: Tensor, steps: Tensor, scale: Tensor, what: str) -> Ints:
    """The whole numbers [C, N] of rows `order` [N] of values [N, C], in steps [C] times scale [N], some
    rows at a time, which stay in the cache."""
    out = torch.empty((value.shape[1], len(order)), dtype=torch.int32)
    for begin in range(0, len(order), ROWS):
        few = slice(begin, begin + ROWS)
        found = value.index_select(0, order[few]).t().contiguous().double()
        found.div_(steps[:, None]).div_(scale[few]).round_()
        least, most = (float(v) for v in found.aminmax())
        if not math.isfinite(most - least):
            raise InputError(f"expected finite {what}, found others in {(~value.isfinite()).any(1).sum():,} anchors; train again")
        _check_size(max(-least, most), what)
        out[:, few] = found
    return out.numpy()


def _whole(value: NDArray[np.float64], what: str) -> Ints:
    found = np.rint(value)
    _check_size(np.abs(found).max(initial=0), what)
    return found.astype(np.int32)


def _check_size(largest: float, what: str) -> None:
    if largest > MOST_SYMBOL:
        raise InputError(f"expected {what} below 2^30 of its steps for a compact file, found larger values; use --format anchors")


def distance_exponent(data: AnchorData) -> int:
    """The whole exponent of two by which a column that sees the distance is larger in files than in
    the training."""
    scale = float(((data.about or {}).get("world") or {}).get("scale", 1.0))
    return round(math.log2(scale)) if 1e-15 <= scale <= 1e15 else 0


def _columns(data: AnchorData) -> dict[str, tuple[int, int]]:
    """By tensor of a network: the column that sees the distance, and the whole exponent of two by
    which the unit of files makes it larger than that of the training."""
    exponent = distance_exponent(data)
    codes = data.networks["appearance.table"].shape[1] if "appearance.table" in data.networks else 0
    out = {f"{a}.experts.w1": (-1 - (codes if a == "color" else 0), exponent) for a in data.add_dist}
    return out | ({"feature_bank.experts.w1": (3, exponent)} if "feature_bank.experts.w1" in data.networks else {})


def _round_network(name: str, value: Tensor, exponents: Tensor, column: tuple[int, int] | None) -> Rounded:
    rows = rows_of(name, value.double()).clone()
    if column is not None:
        rows[:, :, column[0]] *= 2.0 ** -column[1]
    whole = exponents.double().round().clamp(-120, 120)
    found = torch.round(rows / 2.0 ** (whole[:, None] / 2))
    coarser = torch.log2(found.abs().amax((0, 2)).clamp_min(1) / (1 << 20)).clamp_min(0).ceil() * 2  # numbers stay below 2^20
    whole = (whole + coarser).clamp(-120, 120)
    found = torch.round(rows / 2.0 ** (whole[:, None] / 2))
    if float(found.abs().max() if found.numel() else 0) > MOST_SYMBOL:
        raise InputError(f"expected weights of {name} below 2^80, found larger ones; train again")
    return Rounded(found.to(torch.int32).numpy(), whole.to(torch.int32).numpy())


def restore(whole: WholeScene, data: AnchorData, shapes: Mapping[str, tuple[int, ...]]) -> AnchorData:
    """The scene of whole numbers. data: everything else of it; its columns have at least xyz.
    shapes: of the networks' tensors. Raises Damaged for numbers that are no scene."""
    v, n = whole.values, len(data.columns["xyz"])
    scale = (np.float32(2.0) ** v[CLASS][0]).astype(np.float32)
    floats = {
        name: torch.from_numpy(restore_values(v[name], np.array(steps, np.float32), None if name == EXTRA else scale))
        for name, steps in whole.steps.items()
    }
    columns = {"feature": floats[FEATURE], "log_scaling": floats[SCALING], "offsets": floats[OFFSETS].reshape(n, len(v[OFFSETS]) // 3, 3)}
    for i, name in enumerate(whole.extra):
        value = floats[EXTRA][:, i].clone()
        columns[name] = value.clamp(-69.0, 34.0).exp() if name == "interval" else value
    if SLOTS in v:
        columns["slots"] = torch.from_numpy((v[SLOTS] != 0).T.copy())
    networks: dict[str, Tensor] = {}
    for name, shape in shapes.items():
        if name in whole.exact:
            networks[name] = torch.from_numpy(whole.exact[name].copy()).reshape(shape)
            continue
        value = torch.from_numpy(whole.networks[name].floats())
        networks[name] = value.reshape(shape)
    out = replace(data, columns={**data.columns, **columns}, networks=networks)
    for name, (column, exponent) in _columns(out).items():
        if name not in networks or networks[name].dim() != 3 or not -networks[name].shape[2] <= column < networks[name].shape[2]:
            raise Damaged(f"networks without the column of the distance in {name}")
        networks[name][:, :, column] *= 2.0**exponent
    return out


def rounded(data: AnchorData, precision: Precision) -> AnchorData:
    """The scene as a file of this precision gives it back, in the order of its rows."""
    whole = round_scene(replace(data, precision=precision))
    plain = {name: value for name, value in data.columns.items() if name not in (*ROUNDED, *FURTHER, "slots")}
    shapes = {name: tuple(value.shape) for name, value in data.networks.items()}
    return replace(restore(whole, replace(data, columns=plain), shapes), precision=precision)
