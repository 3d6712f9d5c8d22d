"""Write and read OpenUSD files in a process of its own: only this module imports usd-core.

`usd.py` starts it as `python -m scene_experts.files.formats.usd_worker write|read SOURCE TARGET
[MEMORY SECONDS]`. Arrays travel as NumPy archives. usd-core is compiled code that damaged files can
crash; its process takes the crash, and is held to the limits of memory in bytes and of processor
time in seconds. No layer but the given one is opened: references to other files are not followed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

KIND = "ParticleField3DGaussianSplat"  # of OpenUSD 26.3 and newer
DAMAGED, MISSING = 3, 4  # exit codes; what was found is printed
DEGREE, COEFFICIENTS = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"
WIDTHS = {"positions": 3, "scales": 3, "orientations": 4, "opacities": 1, COEFFICIENTS: 3}


def write(source: Path, target: Path) -> None:
    """Write the arrays of an archive as one prim: positions, scales [N, 3], orientations [N, 4] (x,
    y, z, w), opacities [N], sh [N, C, 3], and note (JSON text)."""
    sdf, usd, usd_geom, usd_vol, vt = map(_pxr, ("Sdf", "Usd", "UsdGeom", "UsdVol", "Vt"))
    with np.load(source) as data:
        arrays = {name: data[name] for name in data.files}
    stage = usd.Stage.CreateNew(str(target))
    usd_geom.SetStageUpAxis(stage, usd_geom.Tokens.y)
    usd_geom.SetStageMetersPerUnit(stage, 1.0)  # captures rarely know their unit
    prim = usd_vol.ParticleField3DGaussianSplat.Define(stage, sdf.Path("/Scene"))
    stage.SetDefaultPrim(prim.GetPrim())
    note = str(arrays["note"])
    if note:
        stage.GetRootLayer().customLayerData = {"scene-experts": note}
    sh = arrays["sh"]
    prim.CreatePositionsAttr(vt.Vec3fArray.FromNumpy(arrays["positions"]))
    prim.CreateScalesAttr(vt.Vec3fArray.FromNumpy(arrays["scales"]))
    prim.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(arrays["orientations"]))
    prim.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(arrays["opacities"]))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(round(sh.shape[1] ** 0.5) - 1)
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(sh.reshape(-1, 3))))
    if len(sh):
        reach = 3 * arrays["scales"].max(1, keepdims=True)  # three standard deviations, as the schema defines the kernel
        box = np.stack([(arrays["positions"] - reach).min(0), (arrays["positions"] + reach).max(0)])
        prim.CreateExtentAttr(vt.Vec3fArray.FromNumpy(box.astype(np.float32)))
    stage.Save()


def read(source: Path, target: Path) -> str | None:
    """Write the arrays of all prims of the kind `KIND`, with names as in the file, numbered by
    prim, their `count`, whether a transform moves one (`moved`), and the name of the axis that is
    up (`up`). Returns what is wrong, or None."""
    sdf = _pxr("Sdf")
    layer = sdf.Layer.OpenAsAnonymous(str(source))
    if layer is None:
        return "content that OpenUSD cannot read"
    prims: list[Any] = []

    def visit(path: Any) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() else None
        if spec is not None and spec.typeName == KIND:
            prims.append(spec)

    layer.Traverse(sdf.Path.absoluteRootPath, visit)
    if not prims:
        return f"no {KIND}"
    out: dict[str, Any] = {"count": len(prims), "moved": any(_moves(above) for spec in prims for above in _with_parents(layer, spec))}
    root = layer.pseudoRoot
    out["up"] = str(root.GetInfo("upAxis")) if root.HasInfo("upAxis") else "Y"
    for number, spec in enumerate(prims):
        degree = _default(spec, DEGREE)
        out[f"{number}:degree"] = 3 if degree is None else int(degree)  # the schema's default
        for name, width in WIDTHS.items():
            value = _default(spec, name)
            if value is None:
                value = _default(spec, f"{name}h")  # in half precision
            if value is None:
                return f"{spec.path} without {name}"
            out[f"{number}:{name}"] = np.asarray(value, np.float32).reshape(-1, width)
    np.savez(target, **out)
    return None


def read_note(source: Path) -> str:
    """The note of a layer (JSON text); empty where it has none."""
    layer = _pxr("Sdf").Layer.OpenAsAnonymous(str(source), metadataOnly=True)
    found = {} if layer is None else dict(layer.customLayerData)
    return str(found.get("scene-experts", ""))


def _with_parents(layer: Any, spec: Any) -> Iterator[Any]:
    """A prim and the prims above it."""
    path = spec.path
    while (found := layer.GetPrimAtPath(path)) is not None and path.IsPrimPath():
        yield found
        path = path.GetParentPath()


def _moves(spec: Any) -> bool:
    """Whether a prim has a transform other than the identity."""
    for name in _default(spec, "xformOpOrder") or ():
        name = str(name).removeprefix("!invert!")
        if name in spec.attributes and not _is_still(name.split(":")[1], spec.attributes[name].default):
            return True
    return False


def _is_still(kind: str, value: Any) -> bool:
    """Whether an operation on the frame of a prim (`translate`, `rotateXYZ`, `orient`, ...) changes
    nothing at this value."""
    if value is None:  # values over time
        return False
    if kind == "orient":
        return bool(np.all(np.asarray(value.imaginary) == 0))
    identity = np.eye(4) if kind == "transform" else 1.0 if kind.startswith("scale") else 0.0
    return bool(np.all(np.asarray(value) == identity))


def _default(spec: Any, name: str) -> Any:
    """The value of an attribute at no particular time; None without one."""
    attribute = spec.attributes.get(name)
    return None if attribute is None else attribute.default


def _pxr(name: str) -> Any:
    """A module of usd-core. Raises ImportError without it."""
    return import_module(f"pxr.{name}")


def limit(memory: int, seconds: int) -> None:
    """Hold this process to bytes of memory and seconds of processor time, where the system can."""
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(args: list[str]) -> int:
    """The exit code of one job; what is wrong is printed."""
    task, source, target, *limits = args
    try:
        if not hasattr(_pxr("UsdVol"), KIND):
            raise ImportError(f"a version of usd-core without {KIND}")
    except ImportError as error:
        print(error)
        return MISSING
    if limits:
        limit(*map(int, limits))
    if task == "note":
        print(read_note(Path(source)))
        return 0
    wrong = read(Path(source), Path(target)) if task == "read" else write(Path(source), Path(target))
    if wrong:
        print(wrong)
    return DAMAGED if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
