"""cfg_args is read as literals; nothing in it is evaluated."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.anchors.cfg_args import cfg_args_text, read_cfg_args


def test_literals_come_back_and_the_rest_is_left_out(tmp_path):
    path = tmp_path / "cfg_args"
    path.write_text(
        "Namespace(voxel_size=0.001, appearance_dim=0, eval=True, name='a\\'b', list=[1, -2.5, None], pair=(1, 2), "
        "device=device(type='cuda'), "
        "root=PosixPath('/x'), nan=nan, call=__import__('os').system('touch witness'))\n"
    )
    assert read_cfg_args(path) == {
        "voxel_size": 0.001,
        "appearance_dim": 0,
        "eval": True,
        "name": "a'b",
        "list": [1, -2.5, None],
        "pair": (1, 2),
    }


def test_what_we_write_we_read(tmp_path):
    values = {"voxel_size": 1 / 3, "source_path": "/a b/'c\"", "flags": [True, None], "n": -4}
    (tmp_path / "cfg_args").write_text(cfg_args_text(values))
    assert read_cfg_args(tmp_path / "cfg_args") == values
    import argparse

    assert cfg_args_text(values) == repr(argparse.Namespace(**values))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "Namespace",
        "Namespace(1)",
        "dict(a=1)",
        "os.system('x')",
        "Namespace(a=1); x",
        "Namespace(a=",
        "\0",
        "(" * 5000,
        "a" * (1 << 21),
    ],
)
def test_other_texts(tmp_path, text):
    (tmp_path / "cfg_args").write_text(text)
    with pytest.raises(InputError, match="cfg_args"):
        read_cfg_args(tmp_path / "cfg_args")


def test_other_bytes(tmp_path):
    (tmp_path / "cfg_args").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="cfg_args"):
        read_cfg_args(tmp_path / "cfg_args")
