"""The compact file: cells come back exactly, values within half of their steps, damage in one sentence."""

import json
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, RunError
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.compact import encode, read
from scene_experts.files.codec import container, fit, streams
from support.compact import ABOUT, ORIGIN, K, make_scene
from support.messages import naming


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Models need not be good here."""
    monkeypatch.setattr(fit, "STEPS", 4)


def back(path, data):
    """A scene read again, and which row of the scene each row of the file is."""
    compact.write(path, data, {})
    found = read(path)
    return found, found.columns["feature"][:, 0].round().long()


def test_a_scene_comes_back(tmp_path):
    data = make_scene()
    found, order = back(tmp_path / "c", data)
    assert sorted(order.tolist()) == list(range(300)) and torch.equal(found.cells, data.cells[order])
    assert torch.equal(found.columns["xyz"], (found.cells.double() * 0.0013 + torch.tensor(ORIGIN, dtype=torch.float64)).float())
    for name in ("feature", "log_scaling", "offsets"):
        half = 0.5 * data.precision.steps[name] * 2.0 ** data.precision.classes[order][:, None]
        away = (found.columns[name] - data.columns[name][order]).flatten(1).abs()
        assert (away <= half * 1.001).all() and found.columns[name].dtype == torch.float32
    assert found.voxel == 0.0013 and found.origin == ORIGIN and found.about == ABOUT and found.step == 7 and found.add_dist == ("cov",)
    assert found.networks.keys() == data.networks.keys() and "slots" not in found.columns
    for name, value in data.networks.items():
        size = value.square().mean().sqrt()
        assert torch.equal(found.networks[name], value) if ".router" in name else (found.networks[name] - value).abs().max() < 0.2 * size


def test_the_same_bytes_on_every_run_and_number_of_threads():
    before = torch.get_num_threads()
    first = encode(make_scene())[0]
    torch.set_num_threads(3)
    try:
        assert encode(make_scene())[0] == first
    finally:
        torch.set_num_threads(before)


def test_without_the_compiled_library_the_bytes_and_numbers_are_the_same(tmp_path, monkeypatch):
    data = make_scene(30)
    wanted, order = back(tmp_path / "c", data)
    monkeypatch.setattr(streams.native, "load", lambda level=None: None)
    assert encode(data)[0] == (tmp_path / "c").read_bytes()
    found = read(tmp_path / "c")
    assert all(torch.equal(found.columns[name], wanted.columns[name]) for name in wanted.columns) and len(order) == 30


def test_masked_slots_take_no_room_and_intervals_come_back(tmp_path):
    slots = torch.rand(300, K, generator=torch.Generator().manual_seed(2)) < 0.4
    intervals = torch.rand(300, generator=torch.Generator().manual_seed(3)) + 0.01
    whole, masked = make_scene(), make_scene(slots=slots, interval=intervals)
    assert encode(masked)[1].parts["offsets"] < 0.5 * encode(whole)[1].parts["offsets"]
    found, order = back(tmp_path / "b", masked)
    assert torch.equal(found.columns["slots"], slots[order]) and not found.columns["offsets"][~slots[order]].any()
    torch.testing.assert_close(found.columns["interval"], intervals[order], rtol=0.011, atol=0)


def test_levels_of_detail(tmp_path):
    level, extra = torch.arange(300) % 3, torch.rand(300, generator=torch.Generator().manual_seed(4))
    data = make_scene(level=level, extra_level=extra)
    found, order = back(tmp_path / "c", data)
    assert torch.equal(found.columns["level"], level[order]) and found.voxel == 0.0013
    torch.testing.assert_close(found.columns["extra_level"], extra[order], rtol=0, atol=0.0041)
    wanted = data.cells.double() * torch.tensor(data.edges, dtype=torch.float64)[level][:, None] + torch.tensor(ORIGIN, dtype=torch.float64)
    assert torch.equal(found.columns["xyz"], wanted.float()[order])
    with pytest.raises(InputError, match="--format anchors"):
        encode(replace(data, edges=(0.0052, 0.003, 0.0013)))


@pytest.mark.parametrize("n", [0, 1, 2, 9])
def test_few_anchors(tmp_path, n):
    found, order = back(tmp_path / "c", make_scene(n))
    assert len(found.columns["xyz"]) == n == len(set(order.tolist()))


def test_several_anchors_in_a_cell_far_cells_and_wide_scenes(tmp_path):
    data = make_scene(5)
    for base in (-(2**50), 2**50):
        cells = torch.tensor([[base, -base, 0], [base + 2**21 - 1, -base, 5], [base, -base, 0], [base, -base, 0], [base + 1, -base, 0]])
        found, order = back(tmp_path / "c", replace(data, cells=cells))
        assert torch.equal(found.cells, cells[order]) and sorted(order.tolist()) == [0, 1, 2, 3, 4]
    cells[1, 0] += 1
    with pytest.raises(InputError, match=naming("2,097,152", "2,097,153")):
        compact.write(tmp_path / "d", replace(data, cells=cells), {})
    assert not (tmp_path / "d").exists()


def test_constant_channels_and_huge_values(tmp_path):
    data = make_scene(20)
    data.columns["offsets"].zero_()
    data.columns["feature"][3, 2] = 1e6
    found, _ = back(tmp_path / "c", replace(data, precision=replace(data.precision, classes=torch.zeros(20, dtype=torch.long))))
    assert not found.columns["offsets"].any() and found.columns["feature"][:, 2].max() == pytest.approx(1e6, rel=1e-4)
    data.columns["feature"][3, 2] = 1e12
    with pytest.raises(InputError, match=naming("feature", "--format anchors")):
        encode(data)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_values_that_are_not_finite(bad):
    data = make_scene(10)
    data.columns["feature"][3, 2] = bad
    with pytest.raises(InputError, match=naming("feature", 1)):
        encode(data)
    data = make_scene(10)
    data.networks["cov.experts.w1"][0, 0, 0] = bad
    with pytest.raises(InputError, match=naming("cov.experts.w1")):
        encode(data)


def test_sizes_add_up_and_are_told():
    data, sizes = encode(make_scene())
    header = int.from_bytes(data[8:12], "little")
    assert sizes.total == len(data) == sum(sizes.parts.values()) + header + 16 and sizes.anchors == 300
    assert all(word in str(sizes) for word in ("positions", "features", "networks", "context models", "header", "bytes per anchor"))


def test_truncated_damaged_and_other_files(tmp_path):
    path = tmp_path / "c"
    with pytest.raises(InputError, match=naming(path)):
        read(path)
    data = encode(make_scene(50))[0]
    rng = np.random.default_rng(0)
    broken = [data[:cut] for cut in (0, 5, 8, 11, 500, len(data) - 1)] + [data + b"x"]
    for place in rng.integers(0, len(data), 20):
        broken.append(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    for one in broken:
        path.write_bytes(one)
        with pytest.raises(InputError, match=naming(path)):
            read(path)
    checkpoint.write_tensors(path, {"cells": torch.zeros(3)}, "compact scene", 1, {"N": 1})
    with pytest.raises(InputError, match=naming(path, "version 1", "export its run again")):
        read(path)
    (tmp_path / "later.compact").write_bytes(b"SXCOMP3" + data[7:])
    with pytest.raises(InputError, match=naming(tmp_path / "later.compact", "version 3", "export its run again")):
        read(tmp_path / "later.compact")
    assert compact.looks_like(path, path.read_bytes()[:4096]) and compact.looks_like(tmp_path / "x.compact", b"")


def change(data, changes, parts=None):
    """A file with another header, or other parts, and a right checksum: written on purpose."""
    header, found = container.part(data)
    return container.join(header | changes, found | (parts or {}))


@pytest.mark.parametrize(
    "changes",
    [
        *({"N": n} for n in (51, 49, -1, 10**15)),
        *({"F": 1}, {"F": "x"}, {"K": 5}, {"slots": True}, {"extra": ["x"]}, {"extra": ["interval"]}),
        *({"boxes": [0, 64]}, {"boxes": [3]}, {"origin": 3}, {"steps": {}}, {"lattices": []}, {"version": 3}),
        *({"networks": []}, {"networks": [["a", [1 << 24, 1 << 24]]]}, {"rounded": 99}, {"integers": 5}, {"scene": 4}),
        {"lattices": [[0, 0.0013, 1, [0, 0, 0], 50, 50, 22]]},
    ],
)
def test_a_header_that_does_not_fit_its_contents(tmp_path, changes):
    (tmp_path / "c").write_bytes(change(encode(make_scene(50))[0], changes))
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(tmp_path / "c")


def test_streams_of_something_else(tmp_path):
    data = encode(make_scene(50))[0]
    for name, part in container.part(data)[1].items():
        for other in (b"", part[:-2], part + b"\0\0", bytes(len(part)), b"\xff" * len(part)):
            (tmp_path / "c").write_bytes(change(data, {}, {name: other}))
            if other != part:
                with pytest.raises(InputError, match=naming(tmp_path)):
                    read(tmp_path / "c")


def test_a_small_file_cannot_claim_much_memory(tmp_path):
    data = encode(make_scene(50))[0]
    (tmp_path / "c").write_bytes(change(data, {"N": 1 << 28, "lattices": [[0, 1.0, 1, [0, 0, 0], 1 << 28, 1 << 28, 20]]}))
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(tmp_path / "c")
    text = zlib.compress(json.dumps({"x": "0" * (1 << 25)}).encode())
    bomb = container.MARK + len(text).to_bytes(4, "little") + text
    (tmp_path / "c").write_bytes(bomb + zlib.crc32(bomb).to_bytes(4, "little"))
    with pytest.raises(InputError, match=naming(tmp_path)):
        read(tmp_path / "c")


def test_a_full_disk(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=naming(tmp_path)):
        compact.write(tmp_path / "file" / "c", make_scene(5), {})


def test_scenes_that_the_format_cannot_hold():
    with pytest.raises(InputError, match="--format anchors"):
        encode(replace(make_scene(5), cells=None))
