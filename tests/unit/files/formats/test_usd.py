"""OpenUSD: exact, as usd-core sees it in USD's own frame, and damaged files in one sentence."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.files import registry
from scene_experts.files.formats import usd
from scene_experts.files.formats.usd_worker import COEFFICIENTS
from scene_experts.geometry.rotation import covariance
from scene_experts.geometry.sh import sh_to_rgb
from support.messages import naming
from support.splat_quanta import check, scene

LOOK = """
import json, sys
import numpy as np
from pxr import Usd, UsdGeom, UsdVol
stage = Usd.Stage.Open(sys.argv[1])
prim = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
get = lambda attribute: np.asarray(attribute.Get(), dtype=np.float32)
np.savez(sys.argv[2], positions=get(prim.GetPositionsAttr()), scales=get(prim.GetScalesAttr()),
    orientations=get(prim.GetOrientationsAttr()), opacities=get(prim.GetOpacitiesAttr()),
    sh=get(prim.GetRadianceSphericalHarmonicsCoefficientsAttr()), extent=get(prim.GetExtentAttr()),
    degree=prim.GetRadianceSphericalHarmonicsDegreeAttr().Get(), up=UsdGeom.GetStageUpAxis(stage),
    note=stage.GetRootLayer().customLayerData.get("scene-experts", ""))
"""


def test_without_the_library_one_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"usd-core.*pip install .usd-core"):
        usd.write(tmp_path / "a.usdc", scene(3), {})
    (tmp_path / "a.usdc").write_bytes(b"PXR-USDC" + bytes(80))
    with pytest.raises(InputError, match="usd-core"):
        registry.read(tmp_path / "a.usdc")


def test_a_worker_that_takes_too_long_is_told_in_one_sentence(monkeypatch, tmp_path):
    def wait(command, **rest):
        raise subprocess.TimeoutExpired(command, rest["timeout"])

    monkeypatch.setattr(usd, "expect_library", lambda: None)
    monkeypatch.setattr(usd.subprocess, "run", wait)
    with pytest.raises(RunError, match=naming("a.usdc", "3600 s")):
        usd.write(tmp_path / "a.usdc", scene(3), {})
    (tmp_path / "a.usdc").write_bytes(b"PXR-USDC" + bytes(80))
    with pytest.raises(InputError, match="takes longer"):
        usd.read(tmp_path / "a.usdc")


def test_arrays_that_do_not_fit_are_refused():
    class Source:
        budget, size = usd.budget.USD, 1000

        def spend_bytes(self, count):
            pass

    good = {"0:positions": np.zeros((4, 3)), "0:scales": np.ones((4, 3)), "0:orientations": np.ones((4, 4)), "0:opacities": np.ones((4, 1))}
    good |= {f"0:{COEFFICIENTS}": np.zeros((16, 3)), "0:degree": 1}
    assert usd._prim(Source(), good, 0)[4].shape == (4, 4, 3)  # type: ignore[arg-type]
    for change in ({"0:degree": 2}, {"0:degree": -1}, {"0:scales": np.ones((3, 3))}, {"0:opacities": np.full((4, 1), np.nan)}):
        with pytest.raises(usd.Damaged):
            usd._prim(Source(), good | change, 0)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.foreign
def test_round_trip_is_exact_and_usd_sees_the_scene_half_turned(tmp_path):
    """Covariances and colours in USD's frame are those of ours, turned by 180 degrees about x."""
    pytest.importorskip("pxr")
    s, path = scene(60, 3), tmp_path / "a.usdc"
    usd.write(path, s, {"recipe": "moe-gs"})
    assert registry.recognise(path)[0] == "usd"
    check("usd", registry.read(path), s)
    subprocess.run([sys.executable, "-c", LOOK, str(path), str(tmp_path / "seen.npz")], check=True, timeout=60)
    with np.load(tmp_path / "seen.npz") as data:
        seen = {name: torch.from_numpy(data[name]) if data[name].ndim else data[name].item() for name in data.files}
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    torch.testing.assert_close(seen["positions"], s.means @ turned)
    q = seen["orientations"]
    torch.testing.assert_close(q.norm(dim=1), torch.ones(60))
    ours = covariance(torch.nn.functional.normalize(s.quats, dim=1), s.log_scales.exp())
    torch.testing.assert_close(covariance(q[:, [3, 0, 1, 2]], seen["scales"]), turned @ ours @ turned, rtol=1e-4, atol=1e-7)
    sh, look = seen["sh"].reshape(60, 16, 3), torch.randn(60, 3)
    torch.testing.assert_close(sh_to_rgb(sh, look @ turned, 3), sh_to_rgb(s.sh, look, 3), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(seen["opacities"], s.opacity_logit.sigmoid())
    assert seen["degree"] == 3 and seen["up"] == "Y" and json.loads(seen["note"]) == {"recipe": "moe-gs"}
    assert (seen["extent"][0] < seen["positions"].min(0).values).all() and (seen["extent"][1] > seen["positions"].max(0).values).all()


@pytest.mark.slow
@pytest.mark.foreign
def test_text_files_and_damaged_files(tmp_path, caplog):
    pytest.importorskip("pxr")
    path, s = tmp_path / "a.usda", scene(5, 1)
    usd.write(path, s, {})
    text = path.read_text()
    assert text.startswith("#usda") and "ParticleField3DGaussianSplat" in text
    check("usd", registry.read(path), s)
    for bad in (text.replace("ParticleField3DGaussianSplat", "Points"), text.replace("Degree = 1", "Degree = 2"), text[: len(text) // 2]):
        path.write_text(bad)
        with pytest.raises(InputError, match=naming(path)):
            registry.read(path)
    for inside, told in (("", False), ("double3 xformOp:translate = (1, 2, 3)", True)):
        order = 'uniform token[] xformOpOrder = ["xformOp:translate"]'
        path.write_text(text.replace('"Scene"\n{', f'"Scene"\n{{\n    {inside}\n    {order}\n', 1))
        caplog.clear()
        assert len(registry.read(path)) == 5 and ("not applied" in caplog.text) is told
    for up, told in (('    upAxis = "Z"\n', True), ("", False)):  # y is up where a file does not say
        path.write_text(text.replace('    upAxis = "Y"\n', up))
        caplog.clear()
        assert len(registry.read(path)) == 5 and ("axis Z up" in caplog.text) is told
    binary = tmp_path / "b.usdc"
    binary.write_bytes(b"PXR-USDC" + bytes(range(256)) * 4)
    with pytest.raises(InputError, match=naming(binary)):
        registry.read(binary)
