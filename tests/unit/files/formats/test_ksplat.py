"""Files of GaussianSplats3D: every level and degree, buckets of all lengths, several sections, damaged files in one sentence."""

import struct
from pathlib import Path

import numpy as np
import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.formats import ksplat
from scene_experts.files.registry import READ_ONLY, about, read, recognise
from support import foreign
from support.messages import naming


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize(("n", "sections"), [(1, 1), (500, 1), (400, 3)])
def test_every_level_and_degree(tmp_path, degree, level, n, sections):
    s = foreign.gaussians(n, degree)
    path = tmp_path / "no_suffix"
    path.write_bytes(foreign.ksplat(s, level, sections=sections))
    found = read(path)
    assert recognise(path)[0] == "ksplat" and len(found) == n and found.degree == degree
    step = 0.51 * 4 / 32767 if level else 0
    assert np.abs(found.means.numpy() - s["means"]).max() <= step + 1e-7
    assert np.abs(found.log_scales.numpy() - s["log_scales"]).max() < (1e-3 if level else 1e-6)
    assert np.abs(found.opacity_logit.double().sigmoid().numpy() - 1 / (1 + np.exp(-s["logits"]))).max() < 0.51 / 255
    assert np.abs(found.sh[:, 0].numpy() - s["sh"][:, 0]).max() < 0.51 / 255 / foreign.C0
    assert np.abs(found.sh[:, 1:].numpy() - s["sh"][:, 1:]).max(initial=0) <= (0, 5e-4, 0.51 * 2.5 / 255)[level]
    assert np.abs(found.quats.numpy() - s["quats"]).max() <= (5e-4 if level else 0)


def test_what_is_refused(tmp_path):
    good, path = foreign.ksplat(foreign.gaussians(100, 1), 1), tmp_path / "a.ksplat"

    def refused(data, fact, copied=False):
        path.write_bytes(data)
        with pytest.raises(InputError, match=naming(path, fact)) as error:
            read(path)
        assert ("copy it" in str(error.value)) is copied

    def changed(at, form, value):
        return good[:at] + struct.pack(form, value) + good[at + struct.calcsize(form) :]

    refused(good[:100], "100 bytes", copied=True)
    refused(good[:-1], "100 Gaussians", copied=True)
    refused(changed(4, "<I", 10**6), "1,000,000 sections", copied=True)
    refused(changed(1, "<B", 2), "0.2")
    refused(changed(20, "<H", 3), "level 3")
    refused(changed(4096, "<I", 10**9), "1,000,000,000")
    refused(changed(4096 + 8, "<I", 1), "buckets")
    refused(changed(4096 + 16, "<f", float("inf")), "finite")
    refused(changed(4096 + 16, "<f", float("nan")), "finite")
    refused(changed(4096 + 20, "<H", 16), "16 bytes per bucket")
    refused(changed(4096 + 32, "<I", 10**9), "buckets")
    refused(changed(4096 + 40, "<H", 3), "degree 3")
    refused(b"", "0 bytes", copied=True)


def test_it_is_only_read():
    assert ksplat.FORMAT.write is None and "ksplat" in READ_ONLY and all(about(name) for name in READ_ONLY)
    assert not ksplat.looks_like(Path(__file__), bytes(4096)) and not ksplat.looks_like(Path(__file__), b"\0\1")
