"""A slow float64 decode of anchors, written from the paper's equations, and the cases that the fast decodes are tested on."""

from dataclasses import replace

import torch

from scene_experts.core.types import Gaussians, Routing
from scene_experts.scene.anchors.mlp import CHANNELS, HeadWeights

ATTRIBUTES = ("opacity", "cov", "color")

ACTIVATIONS = {"opacity": torch.tanh, "cov": lambda y: y, "color": torch.sigmoid}
EXTENT = 3.0


def problem(
    A=70,
    N=100,
    K=4,
    F=8,
    H=16,
    E=3,
    k=2,
    distance=(),
    bias=True,
    seed=0,
    shuffled=False,
    depth=2,
    position=(),
):
    """Float64 inputs of a random scene; `k` is per attribute or one for all, 0 for a plain network."""
    g = torch.Generator().manual_seed(seed)
    randn = lambda *shape: torch.randn(*shape, generator=g, dtype=torch.float64).float().double()  # noqa: E731
    rows = torch.randperm(N, generator=g)[:A]
    columns = {"xyz": randn(N, 3), "feature": randn(N, F), "log_scaling": 0.5 * randn(N, 6) - 1, "offsets": randn(N, K, 3)}
    heads = {}
    for i, a in enumerate(ATTRIBUTES):
        mine = k[i] if isinstance(k, tuple) else k
        experts, D, out = (1 if mine == 0 else E), F + 3 + (a in distance), K * CHANNELS[a]
        heads[a] = HeadWeights(
            None if mine == 0 else randn(experts, F + 3 * (a in position)),
            None if mine == 0 or not bias else randn(experts),
            randn(experts, H, D) / 3,
            randn(experts, H) / 3,
            randn(experts, out, H) / 3,
            randn(experts, out) / 3,
            mine or None,
            randn(experts, depth - 2, H, H) / 3 if depth > 2 else None,
            randn(experts, depth - 2, H) / 3 if depth > 2 else None,
            a in position,
        )
    rows = rows if shuffled else rows.sort().values
    return rows, columns, torch.tensor([0.3, -0.2, 2.5], dtype=torch.float64), heads, {a: a in distance for a in ATTRIBUTES}


def without_routers(heads, A, attributes=ATTRIBUTES, seed=3):
    """Return heads that are routed outside, and invented routing and weights for them, which do not sum to 1."""
    g, outside = torch.Generator().manual_seed(seed), {}
    heads = {a: replace(h, router_w=None, router_b=None, position=False) if a in attributes else h for a, h in heads.items()}
    for a in attributes:
        E, k = len(heads[a].w1), heads[a].k
        chosen = None if k is None else torch.rand(A, E, generator=g).argsort(dim=1)[:, :k]
        outside[a] = Routing(torch.zeros(A, E), chosen), (torch.rand(A, k or E, generator=g) + 0.3).double()
    return heads, outside


def oracle(rows, columns, camera, heads, with_dist, outside=None):
    """Section 3 of Scaffold-GS with eq. 3 - 5 of Scene Experts, one anchor after the other. outside: given mixture weights."""
    K = columns["offsets"].shape[1]
    parts = {name: [] for name in ("means", "quats", "scales", "opacities", "colors", "source")}
    raws, gates, chosen = [], {a: [] for a in ATTRIBUTES}, {a: [] for a in ATTRIBUTES}
    for i, row in enumerate(rows.tolist()):
        v = columns["xyz"][row] - camera
        f, distance = columns["feature"][row], v.norm()
        y = {}
        for a, h in heads.items():
            z = torch.cat([f, v / distance] + ([distance[None]] if with_dist[a] else []))

            def expert(e, a=a, h=h, z=z):
                u = (h.w1[e] @ z + h.b1[e]).relu()
                for w, b in [] if h.middle_w is None else zip(h.middle_w[e], h.middle_b[e]):
                    u = (w @ u + b).relu()
                return ACTIVATIONS[a](h.w2[e] @ u + h.b2[e])

            if outside and a in outside:
                routing, weight = outside[a]
                picked = range(len(h.w1)) if routing.chosen is None else routing.chosen[i].tolist()
                y[a] = sum(weight[i, j] * expert(e) for j, e in enumerate(picked))
                continue
            if h.router_w is None:
                y[a] = expert(0)
                continue
            seen = torch.cat([f, columns["xyz"][row] / EXTENT]) if h.position else f
            logits = h.router_w @ seen + (0 if h.router_b is None else h.router_b)
            g = logits.softmax(0)
            picked = range(len(g))
            if h.k is not None:
                picked = sorted(picked, key=lambda e: (-float(logits[e].detach()), e))[: h.k]
            y[a] = sum(g[e] / sum(g[j] for j in picked) * expert(e) for e in picked)
            gates[a].append(g)
            chosen[a].append(list(picked))
        raws.append(y["opacity"])
        size = columns["log_scaling"][row].exp()
        for slot in range(K):
            sigma, cov = y["opacity"][slot], y["cov"][7 * slot : 7 * slot + 7]
            if sigma <= 0:
                continue
            parts["means"].append(columns["xyz"][row] + columns["offsets"][row, slot] * size[:3])
            parts["scales"].append(size[3:] * cov[:3].sigmoid())
            parts["quats"].append(cov[3:] / cov[3:].norm())
            parts["opacities"].append(sigma)
            parts["colors"].append(y["color"][3 * slot : 3 * slot + 3])
            parts["source"].append(torch.tensor(row * K + slot))
    stacked = Gaussians(**{name: torch.stack(values) for name, values in parts.items()})
    return (
        stacked,
        torch.stack(raws),
        {a: torch.stack(g) for a, g in gates.items() if g},
        {a: torch.tensor(c) for a, c in chosen.items() if c},
    )


def leaves(columns, heads):
    """Return new leaf tensors by name, and the same structures built from them."""
    columns = {name: v.clone().requires_grad_(name != "xyz") for name, v in columns.items()}
    heads = {
        a: replace(h, **{n: v.clone().requires_grad_() for n, v in vars(h).items() if isinstance(v, torch.Tensor)})
        for a, h in heads.items()
    }
    named = {name: v for name, v in columns.items() if name != "xyz"}
    named |= {f"{a}.{n}": v for a, h in heads.items() for n, v in vars(h).items() if isinstance(v, torch.Tensor)}
    return columns, heads, named


def objective(gaussians, raw, gates, seed=5):
    """Return a random linear function of all differentiable outputs, so that every gradient is tested."""
    g = torch.Generator().manual_seed(seed)
    values = [
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        raw,
        *(gates[a] for a in sorted(gates)),
    ]
    return sum((v * torch.randn(v.shape, generator=g, dtype=torch.float64).to(v.dtype)).sum() for v in values)


def single_precision(columns, heads):
    return {n: v.float() for n, v in columns.items()}, {
        a: replace(h, **{n: v.float() for n, v in vars(h).items() if isinstance(v, torch.Tensor)}) for a, h in heads.items()
    }


def compare(found, expected, tolerance=1e-5, name=""):
    expected = expected.detach()
    scale = float(expected.norm()) or 1.0
    assert found.shape == expected.shape
    assert float((found.detach().double() - expected).norm()) <= tolerance * scale, (
        f"{name} is off by {float((found.detach() - expected).norm()) / scale:.1e}"
    )


CASES = {
    "plain": {"k": 0},
    "top-2": {},
    "top-1": {"k": 1},
    "dense": {"k": None},
    "all chosen": {"k": 3},
    "five of sixteen": {"E": 16, "k": 5},
    "attributes differ": {"k": (0, 2, None)},
    "others differ": {"k": (None, 1, 0)},
    "with distance": {"distance": ATTRIBUTES},
    "one with distance": {"distance": ("cov",), "bias": False},
    "paper's sizes, several chunks": {"A": 600, "N": 640, "K": 10, "F": 32, "H": 32, "E": 5},
    "odd sizes": {"A": 37, "K": 3, "F": 7, "H": 19, "E": 4},
    "many slots": {"K": 40, "A": 9},
    "six layers": {"k": 0, "depth": 6},
    "three layers, experts": {"depth": 3, "H": 19},
    "routers that see positions": {"position": ATTRIBUTES},
    "one router that does": {"position": ("cov",), "F": 12, "distance": ("color",)},
    "rows in any order": {"shuffled": True},
    "one anchor": {"A": 1, "N": 1, "seed": 1},
}

OUTSIDE = {
    "top-2": ({}, ATTRIBUTES),
    "top-1": ({"k": 1}, ATTRIBUTES),
    "dense": ({"k": None}, ATTRIBUTES),
    "one attribute": ({"E": 5, "k": (2, 1, 3), "position": ATTRIBUTES}, ("cov",)),
    "two attributes": ({"E": 4, "k": (None, 2, 0), "distance": ("color",)}, ("opacity", "cov")),
}
"""Problems by name, each with the attributes that are routed outside."""
