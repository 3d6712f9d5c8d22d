"""How anchors become Gaussians: by the device's fused kernels where they cover the scene, else in
PyTorch, the reference."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Routing
from scene_experts.native import library as native
from scene_experts.native import triton
from scene_experts.scene import LatticeScene
from scene_experts.scene.anchors import native_decode, triton_decode
from scene_experts.scene.anchors.appearance import Codes, fold
from scene_experts.scene.anchors.mlp import ATTRIBUTES, Head, HeadWeights
from scene_experts.scene.anchors.quantise import CLASS, KEEP, ROUNDED, RowRounding, Steps
from scene_experts.scene.anchors.settings import AnchorSettings
from scene_experts.scene.anchors.triton_networks import covers

EPS = 1e-12  # keeps directions and quaternions finite if their length is 0


class DecodingScene(LatticeScene):
    """A scene whose rows are decoded by three heads.

    Columns: xyz [N, 3]; feature [N, F], offsets [N, K, 3], log_scaling [N, 6]. While a training
    rounds the values: keep [N, K], class [N] int64.
    """

    config: AnchorSettings
    heads: Mapping[str, Head]
    bank: Any  # the feature bank; None without one
    codes: Codes | None
    steps: Steps | None
    """Of what a compact file holds; None: no training has learned them."""

    @property
    def K(self) -> int:
        return self.config.K

    def decode(self, rows: Tensor, camera: Camera, step: int, mode: Mode = Mode.DRAW) -> Decoded:
        """Decode the given anchors [A]. Uses the device's fused kernels if they support the scene,
        otherwise PyTorch."""
        weights = self.fused_weights(step)
        if weights is None:
            return self.decode_composed(rows, camera, step, mode)
        if self.codes is not None:
            weights["color"] = fold(weights["color"], self.codes(camera, mode))
        with_dist = {a: a in self.config.add_dist for a in ATTRIBUTES}
        xyz, columns, rounding = self.table.facts["xyz"], self.columns(), self.rounding
        outside = self.route_outside(weights, rows, step, mode)
        if rows.device.type == "cpu":
            made = native_decode.decode(rows, xyz, *columns, camera.position, weights, with_dist, self.extent, outside, rounding)
        else:
            columns = columns if rounding is None else rounding.round(columns)
            made = triton_decode.decode(rows, xyz, *columns, camera.position, weights, with_dist, self.extent, outside)
        decoded = Decoded(made[0], rows, made[1], made[2])
        return decoded if rounding is None else rounding.mark(decoded)

    def columns(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return feature [N, F], log_scaling [N, 6] and offsets [N, K, 3] as they are learned."""
        p = self.table.params
        return p["feature"], p["log_scaling"], p["offsets"]

    @property
    def rounding(self) -> RowRounding | None:
        """How values are rounded before they are drawn; None: they are drawn as they are."""
        if self.steps is None or KEEP not in self.table.params:
            return None
        return RowRounding(self.steps.log_steps, self.table.facts[CLASS], self.table.params[KEEP], self.steps.scale)

    def route_outside(
        self, weights: dict[str, HeadWeights], rows: Tensor, step: int, mode: Mode = Mode.DRAW
    ) -> dict[str, tuple[Routing, Tensor]]:
        """Return the routing and the mixture weights of rows [A] by attribute, where the fused
        decode has no code for the router."""
        heads = {a: self.heads[a] for a, w in weights.items() if w.routed_outside}
        if not heads:
            return {}
        feature, position = self.drawn(rows)[0], self.table.facts["xyz"].index_select(0, rows) / self.extent
        return {a: head.route(feature, step, position, mode) for a, head in heads.items()}  # type: ignore[misc]

    def fused_weights(self, step: int) -> dict[str, HeadWeights] | None:
        """Return the heads' tensors for the fused decode (compiled on the CPU, Triton on CUDA), or
        None if it does not apply.

        Raises InputError with `decode = native` where it does not apply.
        """
        weights = {a: self.heads[a].weights(step) for a in ATTRIBUTES}
        why = self.why_composed(weights)
        if why and self.config.decode == "native":
            raise InputError(f"expected a scene that the native decode covers, found {why}; use --scene.decode auto")
        return None if why or self.config.decode == "composed" else weights

    def why_composed(self, weights: dict[str, HeadWeights]) -> str:
        """Return why plain PyTorch decodes, or "" where the fused decode supports the scene."""
        feature = self.table.params["feature"]
        if missing := no_kernels(feature.device):
            return missing
        if self.bank is not None:
            return "a feature bank"
        if feature.dtype != torch.float32:
            return f"tensors of {feature.dtype}"
        if not feature.is_cuda:
            return ""
        wide = [a for a, w in weights.items() if not covers(a, w, self.config.F, self.K)]
        if len({w.w1.shape[1] for w in weights.values()}) > 1:
            return "networks of several widths"
        return f"networks of {wide[0]} that are too deep or too wide for the kernels" if wide else ""

    def describe_decode(self, step: int) -> str:
        """Say which decode runs at `step`, and why not the fused one, as
        `Scene.describe_decode`."""
        weights = {a: self.heads[a].weights(step) for a in ATTRIBUTES}
        why = self.why_composed(weights) or ("--scene.decode composed" if self.config.decode == "composed" else "")
        if why:
            return f"composed, in plain torch ({why})"
        outside = [a for a, w in weights.items() if w.routed_outside]
        kernels = "compiled" if self.table.device.type == "cpu" else "Triton"
        return f"fused ({kernels})" + (f", routed in torch ({', '.join(outside)}: a router without a kernel)" if outside else "")

    def drawn(self, rows: Tensor) -> tuple[Tensor, ...]:
        """Return `columns` of rows [A] as they are drawn."""
        rounding = self.rounding
        return tuple(c.index_select(0, rows) for c in self.columns()) if rounding is None else rounding.round(self.columns(), rows)

    def inputs(self, rows: Tensor, camera: Camera, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return features [A, F] of `features` [N, F], unit directions from camera to anchor [A, 3] and distances [A,
        1]."""
        v = self.table.facts["xyz"].index_select(0, rows) - camera.position.to(self.table.facts["xyz"])
        distance = v.norm(dim=1, keepdim=True)
        return features.index_select(0, rows), v / distance.clamp_min(EPS), distance

    def decode_composed(self, rows: Tensor, camera: Camera, step: int, mode: Mode = Mode.DRAW) -> Decoded:
        """Reference decode in PyTorch: call one head per attribute, then mask, activate and place
        the Gaussians."""
        p, K, rounding, table = self.table.params, self.K, self.rounding, self.table
        if rounding is not None:
            p = dict(zip(ROUNDED, rounding.round(self.columns())))
            table = cast(Table, SimpleNamespace(params=p, facts=table.facts))
        feature, direction, distance = self.inputs(rows, camera, p["feature"])
        seen = feature if self.bank is None else self.bank(table, rows, direction, distance)
        position = self.table.facts["xyz"].index_select(0, rows) / self.extent
        out: dict[str, Tensor] = {}
        routing: dict[str, Routing] = {}
        for attribute in ATTRIBUTES:
            head = self.heads[attribute]
            x = torch.cat([seen, direction] + ([distance] if attribute in self.config.add_dist else []), dim=1)
            if attribute == "color" and self.codes is not None:
                x = torch.cat([x, self.codes(camera, mode).expand(len(x), -1)], dim=1)
            out[attribute], found = head(x, feature, step, position, mode)
            if found is not None:
                routing[attribute] = found
        raw = out["opacity"]  # [A, K]
        keep = (raw > 0).reshape(-1).nonzero().squeeze(1)  # only slots of strictly positive opacity are drawn
        anchor = torch.div(keep, K, rounding_mode="floor")
        row = rows.index_select(0, anchor)
        scaling = p["log_scaling"].index_select(0, row).exp()
        cov = out["cov"].reshape(-1, 7).index_select(0, keep)
        source = row * K + (keep - anchor * K)
        offset = p["offsets"].reshape(-1, 3).index_select(0, source)
        gaussians = Gaussians(
            means=self.table.facts["xyz"].index_select(0, row) + offset * scaling[:, :3],  # eq. 2
            quats=functional.normalize(cov[:, 3:], dim=1, eps=EPS),
            scales=scaling[:, 3:] * cov[:, :3].sigmoid(),
            opacities=raw.reshape(-1).index_select(0, keep),
            colors=out["color"].reshape(-1, 3).index_select(0, keep),
            source=source,
        )
        decoded = Decoded(gaussians, rows, raw, routing)
        return decoded if rounding is None else rounding.mark(decoded)

    def routing(self, step: int, most: int | None = None, mode: Mode = Mode.DRAW) -> dict[str, Routing]:
        """Return the routing by attribute for all anchors, or for at most `most` evenly spaced
        ones. It is independent of the camera."""
        every = max(1, -(-len(self.table) // most)) if most else 1
        rows = torch.arange(0, len(self.table), every, device=self.table.device)
        feature, position = self.drawn(rows)[0], self.table.facts["xyz"][::every] / self.extent
        found = {a: self.heads[a].route(feature, step, position, mode) for a in ATTRIBUTES}
        return {a: r[0] for a, r in found.items() if r is not None}


def no_kernels(device: torch.device) -> str | None:
    """Return None if `device` has fused kernels, otherwise the reason why it has none."""
    if device.type == "cuda":
        return triton.explain_missing()
    return native.explain_missing() if device.type == "cpu" else f"no kernels for {device.type}"
