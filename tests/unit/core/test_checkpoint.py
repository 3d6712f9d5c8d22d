"""Checkpoints: what comes back is what was saved, and no crash, cut or full disk loses the last good one."""

import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError, RunError
from support.messages import naming

DTYPES = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.uint8, torch.bool]


def tensors(seed: int = 0, n: int = 50) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        "params.feature": torch.randn(n, 32, generator=g),
        "facts.cell": torch.randint(-1000, 1000, (n, 3), generator=g),
        "rng.torch": g.get_state(),
        "adam.feature.0.step": torch.tensor(7.0),
        "empty": torch.zeros(0, 3),
    }


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(a[k].dtype == b[k].dtype and torch.equal(a[k], b[k]) for k in a)


def test_what_is_loaded_is_what_was_saved(tmp_path):
    meta = {"recipe": "moe-gs", "step": 12, "seconds": 0.1 + 0.2, "nested": {"list": [1, None, "é"]}}
    value = tensors()
    path = checkpoint.save(tmp_path / "new", 12, value, meta)
    assert path == tmp_path / "new" / "ckpt_000012.safetensors" and checkpoint.latest(tmp_path / "new") == path
    found, found_meta = checkpoint.load(path)
    assert same(found, value) and found_meta == meta
    path.unlink()  # the tensors do not live in the file
    assert same(found, value)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_every_dtype_bit_for_bit(tmp_path, dtype):
    bits = torch.arange(256, dtype=torch.uint8)  # every byte: NaN payloads, negative zeros, denormals
    value = (bits % 2).bool() if dtype == torch.bool else bits.view(dtype)
    found, _ = checkpoint.load(checkpoint.save(tmp_path, 1, {"x": value, "scalar": value[0]}, {}))
    assert found["x"].dtype == dtype and torch.equal(found["x"].view(torch.uint8), value.view(torch.uint8))
    assert found["scalar"].shape == ()


def test_views_and_shared_memory(tmp_path):
    base = torch.arange(12.0).reshape(3, 4).requires_grad_()
    value = {"base": base, "again": base, "transposed": base.t(), "part": base[1:], "column": base[:, 2]}
    found, _ = checkpoint.load(checkpoint.save(tmp_path, 1, value, {}))
    assert all(torch.equal(found[k], v.detach()) for k, v in value.items())


@settings(max_examples=20, deadline=None)
@given(st.dictionaries(st.text(min_size=1).filter(lambda s: s != "__metadata__"), st.lists(st.integers(0, 3), max_size=3), max_size=4))
def test_any_names_and_shapes(tmp_path_factory, shapes):
    value = {name: torch.full(shape, 0.5) for name, shape in shapes.items()}
    found, _ = checkpoint.load(checkpoint.save(tmp_path_factory.mktemp("c"), 3, value, {}))
    assert same(found, value)


def test_the_newest_are_kept(tmp_path):
    for step in (5, 10, 15, 1_000_000):
        checkpoint.save(tmp_path, step, tensors(), {"step": step}, keep=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ckpt_000015.safetensors", "ckpt_1000000.safetensors"]
    assert checkpoint.load(checkpoint.latest(tmp_path))[1] == {"step": 1_000_000}
    checkpoint.save(tmp_path, 20, tensors(), {}, keep=1)
    assert [s for s, _ in checkpoint._numbered(tmp_path)] == [1_000_000, 20], "a file ahead of this step is not ours to remove"
    for step in (30, 40, 50):
        checkpoint.save(tmp_path, step, tensors(), {}, keep=0)
    assert [s for s, _ in checkpoint._numbered(tmp_path)] == [1_000_000, 50, 40, 30, 20]


def test_leftovers_of_a_killed_save_go(tmp_path):
    (tmp_path / ".ckpt_000001.safetensors.abc.part").write_bytes(b"half")
    checkpoint.save(tmp_path, 2, tensors(), {})
    assert [p.name for p in tmp_path.iterdir()] == ["ckpt_000002.safetensors"]


def test_no_folder_or_no_checkpoint(tmp_path):
    assert checkpoint.latest(tmp_path / "absent") is None
    (tmp_path / "ckpt_x.safetensors").write_bytes(b"")
    assert checkpoint.latest(tmp_path) is None


@pytest.mark.parametrize("size", [0, 1, 7, 8, 100, 900, -1, -400])
def test_a_truncated_checkpoint_is_refused_and_skipped(tmp_path, caplog, size):
    good = checkpoint.save(tmp_path, 1, tensors(), {"step": 1})
    bad = checkpoint.save(tmp_path, 2, tensors(1), {"step": 2})
    bad.write_bytes(bad.read_bytes()[:size])
    with pytest.raises(InputError, match="ckpt_000002"):
        checkpoint.load(bad)
    assert checkpoint.latest(tmp_path) == good
    assert "ckpt_000002" in caplog.text


def test_every_flipped_bit_is_noticed(tmp_path):
    path = checkpoint.save(tmp_path, 1, {"x": torch.arange(8.0)}, {"step": 1})
    data = path.read_bytes()
    start = 8 + struct.unpack("<Q", data[:8])[0]
    for at in range(start, len(data)):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        with pytest.raises(InputError, match=naming("ckpt_000001")):
            checkpoint.load(path)


def test_another_format_version(tmp_path):
    path = tmp_path / "ckpt_000001.safetensors"
    checkpoint.write_tensors(path, tensors(), checkpoint.KIND, checkpoint.FORMAT + 1, {})
    assert checkpoint.latest(tmp_path) == path, "whole, so not passed over in silence for an older one"
    with pytest.raises(InputError, match=naming(1, 2, "ckpt_000001")):
        checkpoint.load(path)


def test_other_files_are_not_checkpoints(tmp_path):
    from safetensors.torch import save_file

    foreign = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(1)}, foreign)
    with pytest.raises(InputError, match="foreign"):
        checkpoint.load(foreign)
    checkpoint.write_tensors(foreign, {}, "compact scene", 1, {})
    with pytest.raises(InputError, match="foreign"):
        checkpoint.load(foreign)
    text = tmp_path / "text.safetensors"
    text.write_text(json.dumps({"a": 1}))
    with pytest.raises(InputError, match="text"):
        checkpoint.load(text)
    with pytest.raises(InputError, match=naming(tmp_path)):
        checkpoint.load(tmp_path / "absent.safetensors")
    with pytest.raises(InputError, match=naming(tmp_path)):
        checkpoint.load(tmp_path)


def test_another_recipe():
    checkpoint.expect({"recipe": "moe-gs"}, recipe="moe-gs")
    with pytest.raises(InputError, match=naming("moe-gs", "scaffold-gs")):
        checkpoint.expect({"recipe": "scaffold-gs"}, recipe="moe-gs")


def test_nan_in_meta_is_a_programming_error(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        checkpoint.save(tmp_path, 1, {}, {"loss": float("nan")})


@pytest.mark.parametrize("limit", [0, 4096, 100_000])
def test_a_full_disk_leaves_the_last_good_checkpoint(tmp_path, limit):
    good = checkpoint.save(tmp_path, 1, tensors(), {"step": 1})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))  # a write beyond it fails as on a full disk (Python ignores the signal)
    try:
        with pytest.raises(RunError, match="ckpt_000002"):
            checkpoint.save(tmp_path, 2, tensors(1, n=1000), {"step": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [p.name for p in tmp_path.iterdir()] == [good.name]
    assert checkpoint.latest(tmp_path) == good and same(checkpoint.load(good)[0], tensors())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_not_writable(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(RunError, match=naming(tmp_path)):
        checkpoint.save(tmp_path, 1, {}, {})


SAVER = """
import os, sys, torch
from pathlib import Path
from scene_experts.core import checkpoint
torch.set_num_threads(1)  # forked children have no thread pool
folder = Path(sys.argv[1])
for line in sys.stdin:  # one child per line: saves without pause from that step on, until it is killed
    child = os.fork()
    if child == 0:
        for step in range(int(line), int(line) + 100000):
            checkpoint.save(folder, step, {"x": torch.full((200_000,), float(step)), "n": torch.tensor(step)}, {"step": step})
            os.write(1, b"saved %d\\n" % step)
        os._exit(1)
    os.write(1, b"child %d\\n" % child)
    os.waitpid(child, 0)
    os.write(1, b"dead 0\\n")
"""


@pytest.mark.slow
def test_killed_at_random_points_of_saving_nothing_is_lost(tmp_path):
    """After SIGKILL of a process that saves continuously, every checkpoint that it reported is complete."""
    rng, step, midway = random.Random(0), 1, 0
    server = subprocess.Popen([sys.executable, "-c", SAVER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert server.stdin is not None and server.stdout is not None
    with server:
        for kill in range(200):
            if kill >= 15 and step > 1 and midway:
                break
            server.stdin.write(b"%d\n" % step)
            server.stdin.flush()
            said = [server.stdout.readline().split()]
            while said[-1][0] != b"child":
                said.append(server.stdout.readline().split())
            time.sleep(rng.uniform(0.0, 0.05 * max(1, kill / 15)))  # longer where a save takes longer
            os.kill(int(said[-1][1]), signal.SIGKILL)
            while said[-1][0] != b"dead":
                said.append(server.stdout.readline().split())
            reported = [int(number) for word, number in said if word == b"saved"]
            midway += any(tmp_path.glob(".ckpt_*.part"))
            path = checkpoint.latest(tmp_path)
            if path is None:
                assert not reported and step == 1
                continue
            found, meta = checkpoint.load(path)
            assert meta["step"] >= max(reported, default=step - 1)
            assert int(found["n"]) == meta["step"] and bool((found["x"] == meta["step"]).all())
            step = meta["step"] + 1
        server.stdin.close()
    assert step > 1 and midway > 0, "no kill came in the middle of a save: the test has shown nothing"


def test_the_newest_whole_one_is_read_once(tmp_path, monkeypatch):
    good = checkpoint.save(tmp_path, 3, {"x": torch.arange(3)}, {"step": 3})
    (tmp_path / "ckpt_000009.safetensors").write_bytes(good.read_bytes()[:-4])
    reads = []
    real = checkpoint.read_tensors
    monkeypatch.setattr(checkpoint, "read_tensors", lambda path, *a: reads.append(path) or real(path, *a))
    found = checkpoint.newest(tmp_path)
    assert found is not None and torch.equal(found[0]["x"], torch.arange(3)) and found[1] == {"step": 3}
    assert reads == [tmp_path / "ckpt_000009.safetensors", good] and checkpoint.newest(tmp_path / "none") is None
