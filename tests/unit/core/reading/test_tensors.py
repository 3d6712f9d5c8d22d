"""Named tensors: round trip and damaged headers."""

import pytest
import torch
from safetensors.torch import save_file

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CHECKPOINT
from scene_experts.core.reading.tensors import find_not_finite, read_metadata, read_safetensors
from support.messages import naming


def test_tensors_and_metadata(tmp_path):
    tensors = {"a": torch.arange(3.0), "b": torch.zeros(0, 2, dtype=torch.int64)}
    save_file(tensors, tmp_path / "t", metadata={"k": "v"})
    found, meta = read_safetensors(tmp_path / "t", CHECKPOINT)
    assert meta == read_metadata(tmp_path / "t", CHECKPOINT) == {"k": "v"}
    assert all(torch.equal(found[name], value) for name, value in tensors.items())
    assert find_not_finite({"params.a": torch.tensor([float("nan")]), "b": torch.ones(1)}, ("params.",)) == "params.a"
    assert find_not_finite({"params.a": torch.tensor([float("nan")])}, ("b",)) is None


def test_damaged_files(tmp_path):
    save_file({"a": torch.arange(3.0)}, tmp_path / "t")
    data = (tmp_path / "t").read_bytes()
    for broken in (b"", data[:20], data[:-1], data + b"x", b"\xff" * 8 + data[8:], (60 << 20).to_bytes(8, "little") + data[8:]):
        (tmp_path / "b").write_bytes(broken)
        for read in (read_safetensors, read_metadata):
            with pytest.raises(InputError, match=naming("b", "checkpoint")):
                read(tmp_path / "b", CHECKPOINT)
