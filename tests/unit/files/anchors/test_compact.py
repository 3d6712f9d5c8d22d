"""The compact file: positions are exact, the rest within its stated precision, under 150 bytes per anchor."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, RunError
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.compact import Coding, decode_steps, encode_steps, read
from scene_experts.files.anchors.data import AnchorData, by_attribute, by_file_name
from support.messages import naming

K, F = 10, 32
OUT = {"opacity": 10, "cov": 70, "color": 30}
ORIGIN = (-1.5, 20.25, 0.1 + 0.2)


def scene(n=2000, seed=0, spread=300):
    """Anchors on a sphere of cells, values spread as trained ones are; each row's first feature is its number."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    cells = (direction * spread).round().long()
    feature = torch.randn(n, F, generator=g) * 2
    feature[:, 0] = torch.arange(n) % 2048  # exact in every 16-bit float
    return {
        "cells": cells,
        "feature": feature,
        "log_scaling": torch.randn(n, 6, generator=g) - 5,
        "offsets": torch.randn(n, K, 3, generator=g) ** 3,
    }


def networks(E=5):
    g = torch.Generator().manual_seed(1)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return {
        a: {"w1": new(E, 32, F + 3), "b1": new(E, 32), "w2": new(E, n, 32), "b2": new(E, n), "router_w": new(E, F), "router_b": new(E)}
        for a, n in OUT.items()
    }


ABOUT = {"recipe": "moe-gs", "step": 7, "add_dist": {"opacity": False, "cov": True, "color": False}}


def write(path, s, coding=Coding()):  # noqa: B008
    columns = {"xyz": torch.zeros(len(s["cells"]), 3), **{name: s[name] for name in ("feature", "log_scaling", "offsets")}}
    data = AnchorData(columns, by_file_name(networks()), ABOUT, s["cells"], 0.0013, ORIGIN)
    return compact.write(path, data, {}, coding)


def read_all(path):
    """The columns of a file with its cells, by name."""
    found = read(path)
    return {**found.columns, "cells": found.cells}


def matched(found):
    """Which row of the scene each row of the file is."""
    return found["feature"][:, 0].round().long()


def test_exact_with_float32(tmp_path):
    s = scene()
    write(tmp_path / "c", s, Coding("float32", "float32", "float32"))
    found, columns = read(tmp_path / "c"), read_all(tmp_path / "c")
    order = matched(columns)
    assert sorted(order.tolist()) == list(range(2000))
    for name in s:
        assert torch.equal(columns[name], s[name][order]) and columns[name].dtype == s[name].dtype
    assert found.voxel == 0.0013 and found.origin == ORIGIN and found.about == ABOUT
    assert found.step == 7 and found.add_dist == ("cov",)
    wanted, there = networks(), by_attribute(found.networks)
    assert there.keys() == wanted.keys()
    assert all(torch.equal(there[a][k], wanted[a][k]) for a in wanted for k in wanted[a])
    assert torch.equal(columns["xyz"], (found.cells.double() * 0.0013 + torch.tensor(ORIGIN, dtype=torch.float64)).float())


def test_masked_slots_take_no_room(tmp_path):
    s = scene()
    columns = {"xyz": torch.zeros(2000, 3), **{name: s[name] for name in ("feature", "log_scaling", "offsets")}}
    slots = torch.rand(2000, K, generator=torch.Generator().manual_seed(2)) < 0.4
    data = AnchorData(columns, by_file_name(networks()), ABOUT, s["cells"], 0.0013, ORIGIN)
    whole = compact.write(tmp_path / "a", data, {})
    masked = compact.write(tmp_path / "b", replace(data, columns={**columns, "slots": slots}), {})
    intervals = torch.rand(2000, generator=torch.Generator().manual_seed(3))
    compact.write(tmp_path / "c", replace(data, columns={**columns, "interval": intervals}), {})
    smoothed = read(tmp_path / "c").columns
    assert torch.equal(smoothed["interval"], intervals[matched(smoothed)])
    found = read(tmp_path / "b").columns
    order = matched(found)
    assert torch.equal(found["slots"], slots[order]) and "slots" not in read(tmp_path / "a").columns
    assert torch.equal(found["offsets"], (s["offsets"] * slots[..., None])[order].half().float())
    assert masked.per_anchor < whole.per_anchor - 0.6 * 2 * 3 * K + 4  # the masks take 2 bytes


@pytest.mark.parametrize("n", [0, 1])
def test_masks_of_none_and_one(tmp_path, n):
    s = {name: value[:n] for name, value in scene().items()}
    columns = {"xyz": torch.zeros(n, 3), **{name: s[name] for name in ("feature", "log_scaling", "offsets")}}
    slots = torch.zeros(n, K, dtype=torch.bool)
    data = AnchorData(columns | {"slots": slots}, by_file_name(networks()), ABOUT, s["cells"], 0.0013, ORIGIN)
    compact.write(tmp_path / "a", data, {})
    found = read(tmp_path / "a").columns
    assert torch.equal(found["slots"], slots) and torch.equal(found["offsets"], torch.zeros(n, K, 3))


@pytest.mark.parametrize("spread", [3, 300, 2**20 - 2])
def test_cells_come_back_bit_for_bit(tmp_path, spread):
    s = scene(spread=spread)
    write(tmp_path / "c", s)
    found = read_all(tmp_path / "c")["cells"]
    rows = lambda c: sorted(map(tuple, c.tolist()))  # noqa: E731
    assert rows(found) == rows(s["cells"])


def test_far_from_the_origin_and_at_both_ends(tmp_path):
    for base in (-(2**50), 2**50):
        s = scene(3)
        s["cells"] = torch.tensor([[base, -base, 0], [base + 2**21 - 1, -base, 5], [base, -base, 0]])
        write(tmp_path / "c", s)
        assert sorted(read_all(tmp_path / "c")["cells"].tolist()) == sorted(s["cells"].tolist())
    s["cells"] = torch.tensor([[0, 0, 0], [2**21, 0, 0], [1, 1, 1]])
    with pytest.raises(InputError, match=naming("2,097,152", "2,097,153")):
        write(tmp_path / "d", s)
    assert not (tmp_path / "d").exists()


def test_precision_is_what_the_coding_promises(tmp_path):
    s = scene()
    write(tmp_path / "c", s)
    found = read_all(tmp_path / "c")
    order = matched(found)
    assert torch.equal(found["feature"], s["feature"][order].half().float())
    assert torch.equal(found["offsets"], s["offsets"][order].half().float())
    step = (s["log_scaling"].max(0).values - s["log_scaling"].min(0).values) / 65535
    assert ((found["log_scaling"] - s["log_scaling"][order]).abs() <= 0.5 * step * 1.01).all()
    assert (found["log_scaling"] - s["log_scaling"][order]).abs().max() < 1e-4
    write(tmp_path / "b", s, Coding("uint8", "uint8", "uint8"))
    found = read_all(tmp_path / "b")
    for name in ("log_scaling", "offsets"):
        step = ((s[name].max(0).values - s[name].min(0).values) / 255).numpy()
        assert (np.sort(found[name].numpy(), 0) - np.sort(s[name].numpy(), 0) <= 0.51 * step).all()


def test_under_150_bytes_per_anchor_even_where_nothing_compresses(tmp_path):
    s = scene(20_000)
    sizes = write(tmp_path / "c", s)
    assert sizes.per_anchor < 136 + 4, "68 values of 2 bytes and a cell"
    assert sizes.total == (tmp_path / "c").stat().st_size and sizes.total - sizes.anchors - sizes.networks < 4096
    assert sizes.networks == 35_925 * 4
    fresh = scene(20_000)
    fresh["feature"].zero_()
    fresh["offsets"].zero_()
    assert write(tmp_path / "d", fresh).per_anchor < 20


def test_one_cell_none_and_constant_channels(tmp_path):
    for n in (0, 1, 4):
        s = {"cells": torch.full((n, 3), -7), "feature": torch.ones(n, F), "log_scaling": torch.full((n, 6), -3.7)}
        s["offsets"] = torch.zeros(n, K, 3)
        for code in ("float16", "uint16", "uint8", "float32"):
            write(tmp_path / "c", s, Coding(code, code, code))
            found = read_all(tmp_path / "c")
            assert torch.equal(found["cells"], s["cells"]) and torch.equal(found["feature"], s["feature"])
            torch.testing.assert_close(found["log_scaling"], s["log_scaling"], rtol=1e-3, atol=0)
            assert found["offsets"].shape == (n, K, 3)


def test_values_beyond_the_reach_of_halves_stay_exact(tmp_path):
    s = scene(10)
    s["offsets"][3, 2, 1] = 1e6
    write(tmp_path / "c", s)
    assert read_all(tmp_path / "c")["offsets"].max() == 1e6


def test_values_that_are_not_finite(tmp_path):
    for bad in (float("nan"), float("inf")):
        s = scene(10)
        s["feature"][3, 2] = bad
        with pytest.raises(InputError, match=naming("feature", 1)):
            write(tmp_path / "c", s)


def test_damaged_and_other_files(tmp_path):
    path = tmp_path / "c"
    with pytest.raises(InputError, match=naming(path)):
        read(path)
    write(path, scene(50))
    data = path.read_bytes()
    for cut in (0, 5, 500, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=naming(path)):
            read(path)
    path.write_bytes(data[:-5] + bytes(5))
    with pytest.raises(InputError, match=naming(path)):
        read(path)
    checkpoint.save(tmp_path, 1, {}, {})
    with pytest.raises(InputError, match=naming("ckpt_000001.safetensors")):
        read(tmp_path / "ckpt_000001.safetensors")


@pytest.mark.parametrize(
    "change",
    [
        {"N": 51},
        {"N": 49},
        {"N": -1},
        {"N": 10**15},
        {"K": 11},
        {"F": 1},
        {"F": "x"},
        {"codes": {}},
        {"low": [0, 0]},
        {"voxel": 0.0},
        {"origin": 3},
    ],
)
def test_a_header_that_does_not_fit_its_contents(tmp_path, change):
    """With a right checksum: written on purpose."""
    write(tmp_path / "c", scene(50))
    tensors, meta = checkpoint.read_tensors(tmp_path / "c", compact.KIND)
    checkpoint.write_tensors(tmp_path / "c", tensors, compact.KIND, compact.VERSION, meta | change)
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(tmp_path / "c")


def test_a_small_file_cannot_claim_much_memory(tmp_path):
    blob = compact.deflate(np.zeros(10_000_000, np.uint8))
    with pytest.raises(ValueError, match=naming(1001, 1000)):
        compact.inflate(blob, 1000)


def test_a_full_disk(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=naming(tmp_path)):
        write(tmp_path / "file" / "c", scene(5))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 2**63 - 1), max_size=50))
def test_steps_come_back(keys):
    array = np.sort(np.array(keys, np.uint64))
    assert np.array_equal(decode_steps(encode_steps(array)), array)


def test_short_steps_take_one_byte_and_the_longest_nine():
    assert len(encode_steps(np.array([0, 0, 127, 254], np.uint64))) == 4
    assert len(encode_steps(np.array([128], np.uint64))) == 2
    assert len(encode_steps(np.array([2**63 - 1], np.uint64))) == 9


@pytest.mark.parametrize("data", [[0x80], [0, 0x80], [0x80] * 9 + [0], [0xFF] * 20])
def test_bytes_that_are_no_steps(data):
    with pytest.raises(ValueError):
        decode_steps(np.array(data, np.uint8))


def test_scenes_that_the_format_cannot_hold(tmp_path):
    s = scene(5)
    columns = {"xyz": torch.zeros(5, 3), **{name: s[name] for name in ("feature", "log_scaling", "offsets")}}
    for data in (AnchorData(columns, {}, ABOUT), AnchorData(columns | {"level": torch.zeros(5)}, {}, ABOUT, s["cells"], 1.0)):
        with pytest.raises(InputError, match="--format anchors"):
            compact.write(tmp_path / "c", data, {})
