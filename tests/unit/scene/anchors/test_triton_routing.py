"""The order of anchors and the gradients of the load-balancing loss. test_triton_decode.py has gates, choices and routers."""

import pytest
import torch

from scene_experts.core.types import Routing
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.scene.anchors.triton_networks import NETWORK, PLAIN, AnchorView, KernelNetworks
from scene_experts.scene.anchors.triton_routing import RoutingArrays, arrange, find_load_gradients, route
from scene_experts.training.losses import load
from support.decoding import EXTENT, problem
from support.interpret import DEVICE, kernels


def view_of(A=70, constant=False, **how):
    kernels("scene_experts.scene.anchors.triton_routes")
    rows, columns, camera, heads, with_dist = problem(A=A, N=100, **how)
    nets = KernelNetworks(heads, with_dist, 8, 4, constant)
    on = lambda t: t.float().to(DEVICE)  # noqa: E731
    given = [on(columns[name]) for name in ("feature", "log_scaling", "offsets")]
    weights = [on(getattr(heads[a], name)) for a in ATTRIBUTES for name in NETWORK]
    routers = [None if t is None else on(t) for a in ATTRIBUTES for t in (heads[a].router_w, heads[a].router_b)]
    return AnchorView(nets, rows.to(DEVICE), on(columns["xyz"]), on(camera), given, weights, routers, EXTENT)


@pytest.mark.parametrize("how", [{"E": 5, "k": 2}, {"E": 7, "k": 3}, {"E": 3, "k": (2, 0, 1)}, {"E": 5, "k": 1, "constant": True}])
@pytest.mark.parametrize("by_row", [False, True])
def test_anchors_are_sorted_by_their_keys_and_else_stay_in_their_order(how, by_row):
    view = view_of(**how)
    nets, A, N = view.nets, len(view.rows), len(view.xyz)
    routed = route(view)
    own = [routed.keys[i * routed.stride :][:A] for i in range(3)]
    if by_row:
        whole = torch.zeros(3, 112, dtype=torch.int32, device=DEVICE)
        for i in nets.ordered:
            whole[i, view.rows] = own[i]
        routed = RoutingArrays(112, True, keys=whole.view(-1))
    order = arrange(view, routed)
    for place, i in enumerate(nets.sorted):
        at = 0 if nets.one_order else i * routed.stride
        assert order[at : at + A].tolist() == own[i].argsort(stable=True).tolist(), (place, N)


@pytest.mark.parametrize("how", [{"E": 5, "k": 2}, {"E": 4, "k": None}, {"E": 3, "k": (2, 0, None)}])
def test_gradients_of_the_load_are_those_of_its_equations(how):
    view = view_of(**how)
    routed = route(view)
    found = find_load_gradients(view, routed, 0.3)
    for i, h in enumerate(view.nets.heads):
        if h.kind == PLAIN:
            continue
        gates, chosen = routed.part(view.nets, i, len(view.rows))
        leaf = gates.double().requires_grad_()
        (0.3 * load({"it": Routing(leaf, chosen)})).backward()
        torch.testing.assert_close(found[i, : h.E].double().expand_as(leaf), leaf.grad, rtol=1e-5, atol=1e-9)
