"""Published weights: what is read, and what is refused without being executed."""

import os

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Budget
from scene_experts.core.reading.state import read_state
from support.messages import naming

BUDGET = Budget("file of weights", 1 << 20, floor=1 << 20, advice="install it again")
WANTED = {"a.weight": (2, 3), "a.count": ()}
TENSORS = {"a.weight": torch.arange(6.0).reshape(2, 3), "a.count": torch.tensor(3)}


def read(path):
    return read_state(path, BUDGET, WANTED, "get version 1")


@pytest.mark.parametrize("zipped", [True, False])
def test_tensors_by_name(tmp_path, zipped):
    torch.save(TENSORS, tmp_path / "w.pth", _use_new_zipfile_serialization=zipped)
    found = read(tmp_path / "w.pth")
    assert found.keys() == WANTED.keys() and torch.equal(found["a.weight"], TENSORS["a.weight"]) and found["a.count"] == 3


def test_other_tensors_are_refused_in_one_sentence(tmp_path):
    path = tmp_path / "w.pth"
    for odd, fact in [
        ({**TENSORS, "a.weight": torch.zeros(2, 4)}, "get version 1"),
        ({**TENSORS, "b": torch.zeros(1)}, "get version 1"),
        ({**TENSORS, "a.weight": torch.full((2, 3), torch.nan)}, "finite"),
        ([torch.zeros(1)], "no tensors by name"),
    ]:
        torch.save(odd, path)
        with pytest.raises(InputError, match=naming(path, fact)):
            read(path)


class Evil:
    def __reduce__(self):
        return os.mkdir, ("made-by-a-pickle",)


def test_code_is_not_executed_and_damage_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "w.pth"
    torch.save({**TENSORS, "a.weight": Evil()}, path)
    with pytest.raises(InputError, match=naming(path)):
        read(path)
    assert not (tmp_path / "made-by-a-pickle").exists()
    torch.save(TENSORS, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=naming(path, "install it again")):
        read(path)
    path.write_bytes(bytes(2 << 20))
    with pytest.raises(InputError, match=naming(path, "2,097,152")):
        read(path)
