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
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.files.archive.pickle_data import Global, NotData, Outside, Record, decode

_STORAGES = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16, "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64, "IntStorage": torch.int32, "ShortStorage": torch.int16, "CharStorage": torch.int8,
    "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
_RECORD_LIMIT = 1 << 30  # bytes of one record
_DEPTH_LIMIT = 50
_VALUE_LIMIT = 1_000_000  # values looked at; a pickle of 100 bytes can name the same list 2^30 times
_LARGEST = 1 << 62  # of a size, a stride, an offset


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Every tensor of the file by its dotted place (`0.weight`, `opacity_mlp.0.weight`), on the CPU
    in the file's own dtype.

    Raises InputError: absent, not such an archive, damaged, or naming anything that is not tensor data.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a network file at {path}, found none; check the path")
    try:
        with zipfile.ZipFile(path) as archive:
            reader = _Reader(archive)
            found: dict[str, Tensor] = {}
            reader.collect(decode(reader.record("data.pkl")), "", found, 0)
    except NotData as error:
        raise InputError(f"expected nothing but tensors in {path}, found otherwise: {error}; do not use this file, get it again") from None
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, OSError, EOFError, RuntimeError, ValueError) as error:
        raise InputError(
            f"expected a TorchScript or torch.save archive at {path}, found another or damaged file ({error}); get it again"
        ) from None
    return found


class _Reader:
    """The records of one archive; `collect` turns the pickle's tree into tensors."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self.archive, self.values = archive, 0
        pickles = [name for name in archive.namelist() if re.fullmatch(r"[^/]+/data\.pkl", name)]
        if len(pickles) != 1:
            raise NotData("no data.pkl in it")
        self.root = pickles[0].rpartition("/")[0]
        if f"{self.root}/byteorder" in archive.namelist() and self.record("byteorder") != b"little":
            raise NotData("its numbers are big-endian")

    def record(self, name: str) -> bytes:
        try:
            info = self.archive.getinfo(f"{self.root}/{name}")
        except KeyError:
            raise NotData(f"record {name} is missing") from None
        if info.file_size > _RECORD_LIMIT:
            raise NotData(f"record {name} claims {info.file_size:,} bytes")
        return self.archive.read(info)

    def collect(self, value: Any, place: str, found: dict[str, Tensor], depth: int) -> None:
        """Put every tensor below `value` into `found`, named by the path to it."""
        self.values += 1
        if depth > _DEPTH_LIMIT or self.values > _VALUE_LIMIT:
            raise NotData("it is nested too deeply" if depth > _DEPTH_LIMIT else f"it holds more than {_VALUE_LIMIT:,} values")
        if isinstance(value, Record):
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
            raise NotData(f"it holds {value}, which is no tensor")

    def content(self, record: Record) -> Tensor | dict[Any, Any]:
        """What an admitted record stands for: a tensor, or the named values of a module or
        dictionary. Others are refused."""
        name = str(record.what)
        if name == "torch._utils._rebuild_tensor_v2" and len(record.args) >= 4:
            return self.tensor(*record.args[:4])
        if name == "torch._utils._rebuild_parameter" and record.args and isinstance(record.args[0], Record):
            return self.content(record.args[0])
        if name == "collections.OrderedDict" and not any(record.args):
            return record.items  # its state is torch's note of module versions
        if record.what.module.split(".")[0] == "__torch__" and not record.args:
            return record.state if isinstance(record.state, dict) else {}
        raise NotData(f"it asks for {name}")

    def tensor(self, storage: Any, offset: Any, size: Any, stride: Any) -> Tensor:
        """A tensor from its storage's record, bounds checked."""
        key = storage.key if isinstance(storage, Outside) else None
        if not (isinstance(key, tuple) and len(key) == 5 and key[0] == "storage" and isinstance(key[2], str)):
            raise NotData("a tensor has no storage")
        known = isinstance(key[1], Global) and key[1].module.split(".")[0] == "torch"
        dtype = _STORAGES.get(key[1].name) if known else None
        if dtype is None:
            raise NotData(f"a tensor is stored as {key[1]}")
        shape = (offset, *size, *stride) if isinstance(size, tuple) and isinstance(stride, tuple) and len(size) == len(stride) else (None,)
        if not all(isinstance(n, int) and 0 <= n < _LARGEST for n in shape):
            raise NotData("a tensor has no proper size")
        data = self.record(f"data/{key[2]}")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride)) if math.prod(size) else -1
        if (last + 1) * dtype.itemsize > len(data) or math.prod(size) * dtype.itemsize > _RECORD_LIMIT:
            raise NotData(f"a tensor of size {list(size)} does not fit its {len(data):,} bytes")
        if last < 0:
            return torch.zeros(size, dtype=dtype)
        flat = torch.frombuffer(bytearray(data[: len(data) // dtype.itemsize * dtype.itemsize]), dtype=dtype)
        return flat.as_strided(size, stride, offset).clone(memory_format=torch.contiguous_format)
