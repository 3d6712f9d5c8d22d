"""The table of formats: what is written comes back by content, and what is none of them is refused in one sentence."""

import pytest
import torch

from scene_experts.errors import InputError
from scene_experts.export.standard import FORMATS, format_of, read_standard, write_standard
from test_export_splats import splats

NOTE = {"recipe": "moe-gs", "psnr": 21.88}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_ply_is_exact(tmp_path, degree, n):
    s = splats(n, degree)
    write_standard(tmp_path / "a.ply", s, "ply", NOTE)
    found = read_standard(tmp_path / "a.ply")
    assert all(torch.equal(getattr(found, name), getattr(s, name)) for name in ("means", "log_scales", "quats", "opacity_logit", "sh"))


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_known_by_its_content(tmp_path, format):
    write_standard(tmp_path / "whatever.bin", splats(300), format, NOTE)
    assert format_of(tmp_path / "whatever.bin") == format
    assert len(read_standard(tmp_path / "whatever.bin")) == 300


def test_what_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"expected a format of ply.*, found 'plx'; did you mean 'ply'"):
        write_standard(tmp_path / "a", splats(), "plx", {})
    s = splats()
    s.sh[2, 1, 0] = float("nan")
    with pytest.raises(InputError, match="expected finite sh, found 1 Gaussians"):
        write_standard(tmp_path / "a", s, "ply", {})
    with pytest.raises(InputError, match="found none; check the path"):
        read_standard(tmp_path / "a")
    (tmp_path / "a").write_bytes(b"plain words")
    with pytest.raises(InputError, match="found something else"):
        read_standard(tmp_path / "a")
