"""The tensors of TorchScript and torch.save files, read without running any of it.

Both are zip archives with a pickle that describes objects and tensors (data.pkl) and the tensors'
bytes (data/0, data/1, ...); TorchScript adds source code, which is not looked at. The pickle is
read as data (`pickle_data`) and only these names in it mean something here: tensors and their
storages, ordered dictionaries, and TorchScript's own module classes (__torch__...), of which the
attributes are taken. Any other name is refused.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError, few
from scene_experts.core.reading.archives import Archive, open_zip
from scene_experts.core.reading.budget import NETWORK
from scene_experts.core.reading.numbers import expect_finite_tensors
from scene_experts.core.reading.pickle_data import Global, NotData, ObjectRecord, Outside, decode
from scene_experts.core.reading.source import opening, shorten

_STORAGES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16, "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64, "IntStorage": torch.int32, "ShortStorage": torch.int16, "CharStorage": torch.int8,
    "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
_RECORD_LIMIT = 1 << 30  # bytes of one record
_DIMENSIONS = 8  # of a tensor
_LARGEST = 1 << 62  # of a size, a stride, an offset


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Every tensor of the file by its dotted place (`0.weight`, `opacity_mlp.0.weight`), on the CPU
    in the file's own dtype.

    Raises InputError: absent, not such an archive, damaged, or naming anything that is not tensor
    data.
    """
    with opening(path, NETWORK) as source:
        try:
            with open_zip(source) as archive:
                reader = _TensorReader(archive)
                found: dict[str, Tensor] = {}
                reader.collect(decode(reader.record("data.pkl")), "", found, 0)
                expect_finite_tensors(found)
        except NotData as error:
            raise InputError(
                f"expected nothing but tensors in {path}, found otherwise: {error}; do not use this file, get it again"
            ) from None
    return found


def read_known_tensors(path: Path, wanted: dict[str, tuple[int, ...]], advice: str) -> dict[str, Tensor]:
    """The tensors of a file whose names and shapes are `wanted`, floats as float32.

    advice: What the user can do where the file has others; it ends the sentence.

    Raises InputError as `read_tensors` does, and for other names or shapes.
    """
    found = read_tensors(path)
    shapes = {name: tuple(value.shape) for name, value in found.items()}
    if odd := sorted(name for name in wanted.keys() | shapes.keys() if wanted.get(name) != shapes.get(name)):
        raise InputError(f"expected {len(wanted)} tensors of known shapes in {path}, found differences in {few(odd)}; {advice}")
    return {name: value.float() if value.is_floating_point() else value for name, value in found.items()}


class _TensorReader:
    """The records of one archive; `collect` turns the pickle's tree into tensors."""

    def __init__(self, archive: Archive) -> None:
        self.archive = archive
        self.last = ("", b"")  # name and bytes of the record read last: tensors may share one
        pickles = [name for name in archive.names if re.fullmatch(r"[^/]+/data\.pkl", name)]
        if len(pickles) != 1:
            raise NotData("no data.pkl in it")
        self.root = pickles[0].rpartition("/")[0]
        if f"{self.root}/byteorder" in archive.names and self.record("byteorder") != b"little":
            raise NotData("its numbers are big-endian")

    def record(self, name: str) -> bytes:
        place = f"{self.root}/{name}"
        if place not in self.archive.names:
            raise NotData(f"record {shorten(name, 60)} is missing")
        if self.last[0] != name:
            self.last = (name, self.archive.read(place, _RECORD_LIMIT))
        return self.last[1]

    def collect(self, value: Any, place: str, found: dict[str, Tensor], depth: int) -> None:
        """Put every tensor below `value` into `found`, named by the path to it."""
        self.archive.source.spend_items(1)  # a pickle of 100 bytes can name the same list 2^30 times
        if depth > NETWORK.depth:
            raise NotData("it is nested too deeply")
        if isinstance(value, ObjectRecord):
            inner = self.content(value)
            if isinstance(inner, Tensor):
                found[place] = inner
                return
            value = inner
        if isinstance(value, (list, tuple)):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            for key, item in value.items():
                self.collect(item, f"{place}.{key}" if place else str(key), found, depth + 1)
        elif not isinstance(value, (int, float, str, bool, type(None))):
            raise NotData(f"it holds {shorten(str(value))}, which is no tensor")

    def content(self, record: ObjectRecord) -> Tensor | dict[Any, Any]:
        """What an admitted record stands for: a tensor, or the named values of a module or
        dictionary. Others are refused."""
        name = str(record.what)
        if name == "torch._utils._rebuild_tensor_v2" and len(record.args) >= 4:
            return self.tensor(*record.args[:4])
        if name == "torch._utils._rebuild_parameter" and record.args and isinstance(record.args[0], ObjectRecord):
            return self.content(record.args[0])
        if name == "collections.OrderedDict" and not any(record.args):
            return record.items  # its state is torch's note of module versions
        if record.what.module.split(".")[0] == "__torch__" and not record.args:
            return record.state if isinstance(record.state, dict) else {}
        raise NotData(f"it asks for {shorten(name)}")

    def tensor(self, storage: Any, offset: Any, size: Any, stride: Any) -> Tensor:
        """A tensor from its storage's record, bounds checked."""
        key = storage.key if isinstance(storage, Outside) else None
        if not (isinstance(key, tuple) and len(key) == 5 and key[0] == "storage" and isinstance(key[2], str)):
            raise NotData("a tensor has no storage")
        known = isinstance(key[1], Global) and key[1].module.split(".")[0] == "torch"
        dtype = _STORAGES.get(key[1].name) if known else None
        if dtype is None:
            raise NotData(f"a tensor is stored as {shorten(str(key[1]))}")
        shape = (offset, *size, *stride) if isinstance(size, tuple) and isinstance(stride, tuple) and len(size) == len(stride) else (None,)
        if len(shape) > 2 * _DIMENSIONS or not all(isinstance(n, int) and 0 <= n < _LARGEST for n in shape):
            raise NotData("a tensor has no proper size")
        data = self.record(f"data/{key[2]}")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride)) if math.prod(size) else -1
        if (last + 1) * dtype.itemsize > len(data) or math.prod(size) * dtype.itemsize > _RECORD_LIMIT:
            raise NotData(f"a tensor of size {list(size)} does not fit its {len(data):,} bytes")
        self.archive.source.spend_bytes(math.prod(size) * dtype.itemsize)
        if last < 0:
            return torch.zeros(size, dtype=dtype)
        flat = torch.frombuffer(bytearray(data[: len(data) // dtype.itemsize * dtype.itemsize]), dtype=dtype)
        return flat.as_strided(size, stride, offset).clone(memory_format=torch.contiguous_format)
