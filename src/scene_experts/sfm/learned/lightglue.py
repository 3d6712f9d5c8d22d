"""LightGlue (Lindenberger et al., "LightGlue: local feature matching at light speed", ICCV 2023):
from the keypoints of two photographs to the pairs that show the same point.

Nine layers. In each, the keypoints of a photograph exchange what they know, rotated by their
positions (self-attention), then those of both photographs do (cross-attention). After each layer
the network says which keypoints are settled. Where nearly all are, it stops; those that are settled
and have no partner are left out from then on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

INPUT, WIDTH, HEADS, LAYERS = 128, 256, 4, 9
FEWEST_OUT = 0.01  # a keypoint that is less likely to have a partner is left out, once it is settled
SETTLED = 0.95  # share of settled keypoints at which the network stops
LEAST = 0.1  # probability of a match


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the tensors, as the authors of LightGlue name them."""
    out: dict[str, tuple[int, ...]] = {"posenc.Wr.weight": (WIDTH // HEADS // 2, 2)}
    linear = {"input_proj": (WIDTH, INPUT)}
    for i in range(LAYERS):
        for kind, parts in (("self_attn", {"Wqkv": 3, "out_proj": 1}), ("cross_attn", {"to_qk": 1, "to_v": 1, "to_out": 1})):
            layer = f"transformers.{i}.{kind}"
            linear |= {f"{layer}.{part}": (times * WIDTH, WIDTH) for part, times in parts.items()}
            linear |= {f"{layer}.ffn.0": (2 * WIDTH, 2 * WIDTH), f"{layer}.ffn.3": (WIDTH, 2 * WIDTH)}
            out[f"{layer}.ffn.1.weight"] = out[f"{layer}.ffn.1.bias"] = (2 * WIDTH,)
        linear |= {f"log_assignment.{i}.matchability": (1, WIDTH), f"log_assignment.{i}.final_proj": (WIDTH, WIDTH)}
        if i < LAYERS - 1:
            linear[f"token_confidence.{i}.token.0"] = (1, WIDTH)
    for name, shape in linear.items():
        out[f"{name}.weight"], out[f"{name}.bias"] = shape, shape[:1]
    return out


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of a photograph: places (x, y) [N, 2] in its pixels, descriptors [N, INPUT] of
    length 1, and its width and height."""

    places: Tensor
    descriptors: Tensor
    size: tuple[int, int]

    def relative(self) -> Tensor:
        """Return the places relative to the centre: [-1, 1] along the longer side."""
        size = self.places.new_tensor(self.size)
        return (self.places - size / 2) / (size.max() / 2)


@dataclass(frozen=True)
class State:
    """The keypoints of a photograph that are left: indices [N], what is known of them [N, WIDTH],
    and the cosines and sines of their rotation [N, WIDTH / HEADS]."""

    index: Tensor
    x: Tensor
    cos: Tensor
    sin: Tensor

    def keep(self, which: Tensor) -> State:
        """Return those for which `which` [N] holds."""
        return State(self.index[which], self.x[which], self.cos[which], self.sin[which])


class LightGlue:
    """LightGlue with its tensors, named as in `tensor_shapes`.

    adaptive: Whether settled keypoints are left out, and whether the network stops early; without
    it, all layers see all keypoints.
    """

    tensors: dict[str, Tensor]
    adaptive: bool

    def __init__(self, tensors: dict[str, Tensor], adaptive: bool = True) -> None:
        self.tensors, self.adaptive = tensors, adaptive

    @torch.no_grad()
    def match(self, one: Keypoints, other: Keypoints) -> tuple[Tensor, Tensor]:
        """Return matches [M, 2], indices into both photographs' keypoints, and their probabilities
        [M], in the order of the first photograph's keypoints."""
        a, b, layer = self.begin(one), self.begin(other), 0
        for layer in range(LAYERS):
            if not len(a.x) or not len(b.x):
                return torch.zeros((0, 2), dtype=torch.int64), torch.zeros(0)
            a, b = self.exchange(a, b, layer)
            if self.adaptive and layer < LAYERS - 1:
                sure = [self.linear(s.x, f"token_confidence.{layer}.token.0").sigmoid()[:, 0] for s in (a, b)]
                limit = 0.8 + 0.1 * math.exp(-4 * layer / LAYERS)
                count = len(one.places) + len(other.places)  # those that were left out are settled
                if 1 - sum(int((s < limit).sum()) for s in sure) / count > SETTLED:
                    break
                a, b = (self.leave_out(s, c, limit, layer) for s, c in zip((a, b), sure, strict=True))
        return self.assign(a, b, layer)

    def begin(self, points: Keypoints) -> State:
        """Return what is known of keypoints before the first layer."""
        angles = (points.relative() @ self.tensors["posenc.Wr.weight"].T).repeat_interleave(2, dim=1)
        x = self.linear(points.descriptors, "input_proj")
        return State(torch.arange(len(x)), x, angles.cos(), angles.sin())

    def exchange(self, a: State, b: State, layer: int) -> tuple[State, State]:
        """Apply one layer to the keypoints of both photographs."""
        name = f"transformers.{layer}"
        a, b = self.attend_self(a, f"{name}.self_attn"), self.attend_self(b, f"{name}.self_attn")
        name = f"{name}.cross_attn"
        (qa, va), (qb, vb) = ([split(self.linear(s.x, f"{name}.{part}")) for part in ("to_qk", "to_v")] for s in (a, b))
        to_a, to_b = attend(qa, qb, vb), attend(qb, qa, va)
        return tuple(  # type: ignore[return-value]
            State(s.index, self.update(s.x, self.linear(heard, f"{name}.to_out"), name), s.cos, s.sin)
            for s, heard in ((a, to_a), (b, to_b))
        )

    def attend_self(self, s: State, name: str) -> State:
        """Let the keypoints of one photograph exchange what they know. Queries and keys are rotated
        by angles that depend on the position (RoPE), so their product depends on the difference of
        two positions."""
        q, k, v = self.linear(s.x, f"{name}.Wqkv").reshape(-1, HEADS, WIDTH // HEADS, 3).permute(3, 1, 0, 2)
        heard = attend(rotate(q, s.cos, s.sin), rotate(k, s.cos, s.sin), v)
        return State(s.index, self.update(s.x, self.linear(heard, f"{name}.out_proj"), name), s.cos, s.sin)

    def update(self, x: Tensor, message: Tensor, name: str) -> Tensor:
        """Return x [N, WIDTH] after it has heard the message [N, WIDTH]: x + MLP(x, message)."""
        y = self.linear(torch.cat([x, message], dim=1), f"{name}.ffn.0")
        y = functional.layer_norm(y, y.shape[1:], self.tensors[f"{name}.ffn.1.weight"], self.tensors[f"{name}.ffn.1.bias"])
        return x + self.linear(functional.gelu(y), f"{name}.ffn.3")

    def leave_out(self, s: State, sure: Tensor, limit: float, layer: int) -> State:
        """Leave out the keypoints that are settled (`sure` above `limit`) and have no partner."""
        return s.keep((self.matchable(s, layer) > FEWEST_OUT) | (sure <= limit))

    def matchable(self, s: State, layer: int) -> Tensor:
        """Return the probability of each keypoint to have a partner [N]."""
        return self.linear(s.x, f"log_assignment.{layer}.matchability").sigmoid()[:, 0]

    def assign(self, a: State, b: State, layer: int) -> tuple[Tensor, Tensor]:
        """Return matches and their probabilities, as `match` does:

            P_ij = softmax_i(S)_ij softmax_j(S)_ij matchable_i matchable_j

        for those i and j that are each other's most probable partner, if P_ij > LEAST.
        """
        pa, pb = (self.linear(s.x, f"log_assignment.{layer}.final_proj") / WIDTH**0.25 for s in (a, b))
        likeness = pa @ pb.T
        probable = likeness.softmax(0) * likeness.softmax(1) * self.matchable(a, layer)[:, None] * self.matchable(b, layer)
        best, partner = probable.max(dim=1)
        mutual = probable.argmax(dim=0)[partner] == torch.arange(len(partner))
        kept = torch.nonzero(mutual & (best > LEAST))[:, 0]
        pairs = torch.stack([a.index[kept], b.index[partner[kept]]], dim=1)
        order = pairs[:, 0].argsort()
        return pairs[order], best[kept][order]

    def linear(self, x: Tensor, name: str) -> Tensor:
        return functional.linear(x, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"])


def split(x: Tensor) -> Tensor:
    """Divide [N, WIDTH] among the heads: [HEADS, N, WIDTH / HEADS]."""
    return x.reshape(-1, HEADS, WIDTH // HEADS).transpose(0, 1)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Return softmax(q k^T / sqrt(d)) v of each head, joined: [N, WIDTH]."""
    return functional.scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1).flatten(1)


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotate the numbers 2i and 2i + 1 of x [HEADS, N, D] by angle i; `cos` and `sin` [N, D] have
    each angle twice."""
    turned = torch.stack([-x[..., 1::2], x[..., ::2]], dim=-1).flatten(-2)
    return x * cos + turned * sin
