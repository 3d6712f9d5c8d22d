"""TorchScript and torch.save files made by torch itself: equal tensors; made by an attacker: refused, and nothing runs."""

import io
import os
import pickle
import zipfile

import pytest
import torch
from torch import nn

from scene_experts.core.errors import InputError
from scene_experts.core.reading import pickle_data
from scene_experts.core.reading.torch_archive import read_known_tensors, read_tensors
from support.messages import naming

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")


def network(inputs=35, out=10):
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(inputs, 32), nn.ReLU(True), nn.Linear(32, out), nn.Tanh())


def same(found, state):
    return found.keys() == state.keys() and all(
        found[k].dtype == v.dtype and torch.equal(found[k], v) and found[k].is_contiguous() for k, v in state.items()
    )


@pytest.mark.parametrize("how", ["trace", "script"])
def test_a_torchscript_network(tmp_path, how):
    net = network()
    module = torch.jit.trace(net, (torch.rand(1, 35),)) if how == "trace" else torch.jit.script(net)
    module.save(str(tmp_path / "opacity_mlp.pt"))
    assert same(read_tensors(tmp_path / "opacity_mlp.pt"), net.state_dict())


class Codes(nn.Module):
    def __init__(self, dtype):
        super().__init__()
        self.embedding = nn.Embedding(5, 3)
        self.register_buffer("table", torch.arange(12).reshape(3, 4).t().to(dtype))  # not contiguous

    def forward(self, x):
        return self.embedding(x)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64, torch.int64, torch.int32, torch.uint8, torch.bool])
def test_nested_modules_dtypes_and_strides(tmp_path, dtype):
    module = Codes(dtype)
    torch.jit.trace(module, (torch.zeros(1, dtype=torch.long),)).save(str(tmp_path / "m.pt"))
    assert same(read_tensors(tmp_path / "m.pt"), module.state_dict())


def test_a_dictionary_of_state_dicts(tmp_path):
    a, b = network(35, 10), network(36, 70)
    whole = torch.arange(10.0)
    extra = {"parameter": nn.Parameter(torch.ones(2)), "none": torch.zeros(0, 3), "part": whole[2:8:2], "scalar": torch.tensor(3)}
    torch.save({"opacity_mlp": a.state_dict(), "cov_mlp": b.state_dict(), "note": "x", "list": [1, 2.5, None], **extra}, tmp_path / "c.pth")
    wanted = {f"opacity_mlp.{k}": v for k, v in a.state_dict().items()} | {f"cov_mlp.{k}": v for k, v in b.state_dict().items()}
    wanted |= {k: v.detach() for k, v in extra.items()}
    assert same(read_tensors(tmp_path / "c.pth"), wanted)


# --- attacks ------------------------------------------------------------------------------------------------------------------------------


def archive(path, data, records=None):
    with zipfile.ZipFile(path, "w") as out:
        out.writestr("archive/data.pkl", data)
        for name, value in (records or {"data/0": bytes(64)}).items():
            out.writestr(f"archive/{name}", value)
    return path


class Attack:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_malicious_pickle_is_refused_and_does_not_run(tmp_path, protocol):
    witness = tmp_path / "witness"
    data = pickle.dumps({"weight": Attack(os.system, f"touch {witness}")}, protocol=protocol)
    with pytest.raises(InputError, match=r"a\.pt"):
        read_tensors(archive(tmp_path / "a.pt", data))
    assert not witness.exists()
    pickle.loads(data)  # the same bytes do run where they are unpickled
    assert witness.exists()


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (Attack(eval, "1"), "eval"),
        (Attack(getattr, "x", "y"), "getattr"),
        (Attack(torch.load, "x"), "torch"),
        (eval, "eval"),
        ([Attack(exec, "1")], "exec"),
        ({"a": {"b": (Attack(print, "1"),)}}, "print"),
        (io.StringIO("x"), "StringIO"),
        (Attack(torch._utils._rebuild_parameter, 1), "_rebuild_parameter"),
        ({1, 2}, "set|EMPTY_SET"),
        (b"bytes", "encode|BINBYTES"),
    ],
)
def test_other_names_are_refused(tmp_path, value, name):
    for protocol in (2, 4):
        with pytest.raises(InputError, match=name):
            read_tensors(archive(tmp_path / "a.pt", pickle.dumps(value, protocol=protocol)))


@pytest.mark.parametrize("code", [b"cos\nsystem\n(S'true'\ntR.", b"(S'true'\nios\nsystem\n.", b"(cos\nsystem\nS'true'\no.", b"\x82\x01."])
def test_old_and_rare_ways_to_call(tmp_path, code):
    with pytest.raises(InputError, match=r"a\.pt"):
        read_tensors(archive(tmp_path / "a.pt", code))


def test_the_decoder_never_imports_or_calls(monkeypatch):
    record = pickle_data.decode(pickle.dumps(Attack(os.system, "false"), protocol=2))
    assert isinstance(record, pickle_data.ObjectRecord) and str(record.what) in ("posix.system", "nt.system") and record.args == ("false",)


def tensor_pickle(storage="FloatStorage", key="0", offset=0, size=(2, 2), stride=(2, 1)):
    """A tensor as torch writes it, with free choice of its numbers."""
    number = lambda n: b"L%dL\n" % n  # noqa: E731
    numbers = lambda values: b"(" + b"".join(number(v) for v in values) + b"t"  # noqa: E731
    pid = (
        b"(X\x07\0\0\0storagectorch\n" + storage.encode() + b"\nX" + bytes([len(key)]) + b"\0\0\0" + key.encode() + b"X\x03\0\0\0cpuK\x10tQ"
    )
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + pid + number(offset) + numbers(size) + numbers(stride) + b"\x89)tR."


def test_bounds_of_tensors(tmp_path):
    floats = torch.arange(16.0)
    records = {"data/0": floats.numpy().tobytes()}
    read = lambda **kw: read_tensors(archive(tmp_path / "t.pt", tensor_pickle(**kw), records))[""]  # noqa: E731
    assert torch.equal(read(offset=3), floats[3:7].reshape(2, 2))
    assert torch.equal(read(size=(4, 4), stride=(1, 4)), floats.reshape(4, 4).t())
    assert read(size=(0, 5), stride=(5, 1)).shape == (0, 5)
    for wrong in (
        {"offset": 13},
        {"offset": -1},
        {"size": (2, 15)},
        {"size": (2, -2)},
        {"stride": (2,)},
        {"stride": (-1, 1)},
        {"size": (1 << 40, 1 << 40), "stride": (0, 0)},
        {"size": (0, 10**30), "stride": (1, 1)},
        {"key": "1"},
        {"key": "../0"},
        {"storage": "QInt8Storage"},
        {"storage": "load"},
    ):
        with pytest.raises(InputError, match=r"t\.pt"):
            read(**wrong)


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "n.pt"
    with pytest.raises(InputError, match=naming(path)):
        read_tensors(path)
    torch.jit.trace(network(), (torch.rand(1, 35),)).save(str(path))
    data = path.read_bytes()
    for cut in (0, 10, 200, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=naming(path)):
            read_tensors(path)
    path.write_bytes(data.replace(b"FloatStorage", b"floatStorage"))
    with pytest.raises(InputError):
        read_tensors(path)
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(InputError, match=naming(path)):
        read_tensors(path)
    with zipfile.ZipFile(path, "w") as out:
        out.writestr("other.txt", "x")
    with pytest.raises(InputError, match=naming("data.pkl")):
        read_tensors(path)


def test_any_damaged_byte_is_an_input_error(tmp_path):
    path = tmp_path / "n.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:  # torch stores; others may deflate
        out.writestr("archive/data.pkl", tensor_pickle())
        out.writestr("archive/data/0", torch.arange(16.0).numpy().tobytes())
    data = path.read_bytes()
    refused = 0
    for i in range(len(data)):
        path.write_bytes(data[:i] + bytes([data[i] ^ 0xFF]) + data[i + 1 :])
        try:
            read_tensors(path)
        except InputError:
            refused += 1
    assert refused > len(data) // 2  # the rest is times and flags that say nothing


def test_a_storage_that_is_text(tmp_path):
    with pytest.raises(InputError, match=naming("torch.FloatStorage")):
        read_tensors(archive(tmp_path / "t.pt", tensor_pickle().replace(b"ctorch\nFloatStorage\n", b"X\x12\0\0\0torch.FloatStorage")))


@pytest.mark.parametrize(
    "code", [b"", b".", b"\x80\x02", b"}K\x01s.", b"]}s.", b"}]K\x01s.", b"h\x05.", b"t.", b"K\x01b.", b"(K\x01d.", b"cbad.", b"\xff."]
)
def test_damaged_pickles(code):
    with pytest.raises(pickle_data.NotData):
        pickle_data.decode(code)


def test_a_value_that_contains_itself(tmp_path):
    loop = []
    loop.append(loop)
    with pytest.raises(InputError, match=naming("a.pt")):
        read_tensors(archive(tmp_path / "a.pt", pickle.dumps(loop, protocol=2)))


def test_a_hundred_bytes_that_name_a_list_a_billion_times(tmp_path):
    deep: list = [1]
    for _ in range(30):
        deep = [deep, deep]
    with pytest.raises(InputError, match=naming("200,000")):
        read_tensors(archive(tmp_path / "a.pt", pickle.dumps(deep, protocol=2)))


def test_only_the_wanted_names_and_shapes_are_read(tmp_path):
    path, wanted = tmp_path / "w.pth", {"a.weight": (2, 3), "count": ()}
    torch.save({"a.weight": torch.arange(6.0).reshape(2, 3).half(), "count": torch.tensor(3)}, path)
    found = read_known_tensors(path, wanted, "get version 1")
    assert found["a.weight"].dtype == torch.float32 and found["a.weight"].flatten().tolist() == [0, 1, 2, 3, 4, 5] and found["count"] == 3
    for odd in ({"a.weight": (2, 4), "count": ()}, {"a.weight": (2, 3)}, {**wanted, "b": (1,)}):
        with pytest.raises(InputError, match=naming(path, "get version 1")):
            read_known_tensors(path, odd, "get version 1")
