"""The counts of keys, and whether the kernels compile. test_triton_routing.py has what they compute together."""

import pytest
import torch

from support.interpret import DEVICE, compile_for_gpu, kernels

MODULE = "scene_experts.scene.anchors.triton_routes"
TYPES = {"rows": "*i64", "order": "*i32", "keys": "*i32", "chosen": "*i64", "counts": "*i32", "counted": "*i32"}
TYPES |= {"A": "i32", "blocks": "i32", "stride": "i32", "to_stride": "i32"}


def test_the_keys_of_each_block_are_counted():
    keys = torch.tensor([3, 1, 1, 0, 7, 3, 3, 2, 5, 5], dtype=torch.int32, device=DEVICE)
    rows = torch.tensor([9, 0, 1, 2, 3, 5], device=DEVICE)
    counts = torch.full((3, 8, 2), -1, dtype=torch.int32, device=DEVICE)
    kernels(MODULE).count_keys[(2, 3)](rows, keys, counts, 6, 0, 2, HEADS=1, BY_ROW=True, BINS=8, B=4)
    expected = [torch.bincount(keys[rows[part]], minlength=8) for part in (slice(0, 4), slice(4, 6))]
    assert torch.equal(counts[0].cpu(), torch.stack(expected, 1).cpu().int()) and (counts[1:] == -1).all()


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_they_compile(target):
    of = {"E": 3, "EM": 3, "F": 8, "BIAS": True, "POSITION": True, "EP": 16, "PRECISION": "ieee"}
    sort = {"HEADS": 7, "BINS": 8, "B": 16}
    named = {"route": {**of, **sort, "TOP": 2, "FP": 16}, "count_keys": {**sort, "BY_ROW": True}, "arrange": {**sort, "BY_ROW": False}}
    named["load_gradients"] = {"E": 3, "EM": 3, "HEADS": 7, "SPARSE": True, "B": 16, "EP": 16}
    named["router_weights"] = {**of, "HEADS": 7, "AT0": 0, "AT1": 10, "AT2": 20, "WIDTH": 30, "B": 16, "RP": 16}
    for name, sizes in named.items():
        types = {p: TYPES.get(p, "*fp32") for p in getattr(kernels(MODULE), name).arg_names if p not in ("extent", "factor")}
        compile_for_gpu(MODULE, name, types, sizes, target)
