"""One target for each reader: small valid inputs, how their files are mutated, and the call that reads them."""

from __future__ import annotations

import base64
import io
import json
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from fuzz import containers
from fuzz.mutate import mutate, mutate_json
from fuzz.structure import mutate_structure
from scene_experts.core import checkpoint
from scene_experts.core.io import write_json
from scene_experts.core.reading.torch_archive import read_tensors
from scene_experts.data import capture
from scene_experts.data.images import FrameSource, decode, probe
from scene_experts.data.lens import Lens
from scene_experts.data.masks import Mask
from scene_experts.data.settings import Data
from scene_experts.evaluate import results
from scene_experts.evaluate.lpips import tensor_shapes
from scene_experts.evaluate.weights import _hash_tensors, _read_cache
from scene_experts.files import registry, result_folder
from scene_experts.files.anchors import compact, live, torchscript
from scene_experts.files.anchors.read import read_folder
from scene_experts.files.anchors.write import contents, describe
from scene_experts.files.formats.spz import spz_bytes
from scene_experts.report import page
from scene_experts.reproduce import store
from scene_experts.scene.fit import restore_foreign
from scene_experts.training.run_folder import open_run, read_config
from scene_experts.view.path_files import read_path
from support import foreign
from support.evaluated import make_run
from support.files import run_in_memory
from support.foreign_poses import make_bundler, make_metashape, make_polycam, make_realitycapture
from support.records import record
from support.scenes import CAMERA
from support.splats import splats
from support.synthetic import make_blender, make_capture, make_nerfstudio

Files = dict[str, bytes]
Pack = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Target:
    """A reader under test.

    Attributes:
        make: Writes valid inputs into an empty folder and returns the names of the files to mutate, one list for each input.
        read: Reads an input in a folder. Whatever it returns must hold finite numbers only.
        packs: By the suffix of a file: mutations that reach hidden content. Half of the mutations of such a file use them.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    mutated: tuple[str, ...] = ("*",)
    packs: Mapping[str, Pack] = field(default_factory=dict)


STRUCTURED = 10**12
"""From this number on, half of the mutations are those of `structure`. Lower numbers keep the inputs that they always had."""


LARGEST = 64 << 20
"""Mutated files are cut at this number of bytes: the memory that a larger one honestly takes would count as a finding."""


def mutate_files(files: Files, target: Target, rng: random.Random, structured: bool = False) -> Files:
    """Return the files of an input with one of them mutated."""
    names = sorted(name for name in files if any(Path(name).match(pattern) for pattern in target.mutated))
    name, other = rng.choice(names), rng.choice(names)
    pack = target.packs.get(Path(name).suffix)
    if structured and rng.random() < 0.5:
        pack, certain = mutate_structure, True
    else:
        certain = False
    try:
        new = pack(files[name], rng) if pack is not None and (certain or rng.random() < 0.5) else mutate(files[name], rng, files[other])
    except Exception:  # the first mutation has damaged the container
        new = mutate(files[name], rng, files[other])
    return {**files, name: new[:LARGEST]}


# --- the values that readers return -------------------------------------------------------------------------------------------------------


def find_not_finite(value: Any, where: str = "", depth: int = 0) -> str:
    """Return the place of a number in a result that is not finite, else ""."""
    if isinstance(value, torch.Tensor):
        return where if value.is_floating_point() and not bool(value.isfinite().all()) else ""
    if isinstance(value, np.ndarray):
        return where if value.dtype.kind == "f" and not np.isfinite(value).all() else ""
    if isinstance(value, float):
        return "" if math.isfinite(value) else where
    if depth > 8 or isinstance(value, (str, bytes, int, type(None))):
        return ""
    if isinstance(value, torch.nn.Module):
        value = dict(value.state_dict())
    if is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in fields(value)}
    parts = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    return next((found for key, part in parts if (found := find_not_finite(part, f"{where}.{key}", depth + 1))), "")


# --- valid inputs -------------------------------------------------------------------------------------------------------------------------


def _gaussians(format: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        found = registry.format_named(format)
        assert found.write is not None
        found.write(folder / f"scene{found.suffix}", splats(20, 3 if found.sh_degree else 0), {})

    return make


def _read_only_file(folder: Path) -> Any:
    return registry.read(next(p for p in sorted(folder.iterdir()) if p.is_file()))


def _ply_texts(folder: Path) -> None:
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (folder / "scene.ply").write_text(head + "".join(" ".join(f"{i + j / 7:.4f}" for j in range(len(names))) + "\n" for i in range(3)))


def _foreign(name: str, make: Callable[[dict[str, Any]], bytes]) -> Callable[[Path], None]:
    """A file as another program writes it."""

    def write(folder: Path) -> None:
        (folder / name).write_bytes(make(foreign.gaussians(40, 1)))

    return write


def _sog_folder(folder: Path) -> None:
    foreign.folder(folder, foreign.sogs_1(foreign.gaussians(40, 2)))


def _ply_of_others(folder: Path) -> None:
    """Colours in place of harmonics, and the two scales of 2DGS; one opacity is infinite and one row is empty."""
    columns = {name: values.copy() for name, values in foreign.ply_columns(foreign.gaussians(20, 1)).items()}
    columns = {name: values for name, values in columns.items() if not name.startswith("f_dc") and name != "scale_2"}
    columns["opacity"][3] = np.inf
    for values in columns.values():
        values[7] = 0
    foreign.ply(folder / "scene.ply", columns | {name: np.arange(20, dtype=np.uint8) for name in ("red", "green", "blue")})


def _compressed_1(folder: Path) -> None:
    foreign.compressed_ply_before_2(folder / "scene.ply", foreign.gaussians(300, 1))


def _gltf(folder: Path) -> None:
    """An SPZ file inside the JSON and one beside it."""
    data = spz_bytes(splats(20, 2))
    scene = foreign.with_spz(20, len(data), "KHR_gaussian_splatting_compression_spz_2")
    scene["meshes"].append({"primitives": [{"attributes": {}, "extensions": {"KHR_spz_gaussian_splats_compression": {"bufferView": 1}}}]})
    scene["bufferViews"].append({"buffer": 1, "byteLength": len(data)})
    buffers = [
        {"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()},
        {"byteLength": len(data), "uri": "x.bin"},
    ]
    (folder / "scene.gltf").write_text(json.dumps(scene | {"buffers": buffers}))
    (folder / "x.bin").write_bytes(data)


def _gltf_plain(folder: Path) -> None:
    registry.format_named("glb").write(folder / "scene.glb", splats(20, 1), {})
    data = (folder / "scene.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    scene = json.loads(data[20 : 20 + size])
    scene["buffers"][0]["uri"] = "x.bin"
    (folder / "scene.gltf").write_text(json.dumps(scene))
    (folder / "x.bin").write_bytes(data[28 + size :])
    (folder / "scene.glb").unlink()


def _zip(folder: Path) -> None:
    registry.format_named("ply").write(folder / "scene.ply", splats(20, 1), {})
    (folder / "scene.zip").write_bytes(foreign.zipped({"a/scene.ply": (folder / "scene.ply").read_bytes()}, deflate=True))
    (folder / "scene.ply").unlink()


def _compact(folder: Path) -> None:
    compact.write(folder / "scene.compact", _anchors(), {})


def _live(folder: Path) -> None:
    live.write(folder / "scene.html", _anchors(), {})


def _anchors() -> Any:
    run = run_in_memory("moe-gs")
    return contents(run, _world(), describe(run, _world()) | {"train": _to_json(run.config.train)})


def _world() -> Any:
    from scene_experts.data.views import World

    return World()


def _to_json(value: Any) -> Any:
    from scene_experts.core.plain import to_json

    return to_json(value)


def _networks(folder: Path) -> None:
    torch.save({"0.weight": torch.randn(4, 3), "0.bias": torch.randn(4), "2.weight": torch.randn(2, 4)}, folder / "net.pt")


def _traces(folder: Path) -> None:
    network = {"w1": torch.randn(1, 4, 3), "b1": torch.randn(1, 4), "w2": torch.randn(1, 2, 4), "b2": torch.randn(1, 2)}
    module = torchscript.sequential("opacity", network)
    torchscript._save_trace(folder / "net.pt", module, torch.rand(1, 3))


def _result(folder: Path) -> None:
    from scene_experts.files.anchors import write

    run = run_in_memory("scaffold-gs")
    place = folder / "point_cloud" / "iteration_30"
    place.mkdir(parents=True)
    about = describe(run, _world()) | {"train": _to_json(run.config.train)}
    write.write(run, _world(), place, about)
    write_json(place / "scene.json", about)
    (folder / "cfg_args").write_text("Namespace(voxel_size=0.01, sh_degree=3, images='images', eval=True, ratio=[1, 2], add_level=False)")


def _read_result(folder: Path) -> Any:
    place = result_folder.iteration_folder(folder)
    return read_folder(place), result_folder.read_settings(place)


def _run(recipe: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        run = run_in_memory(recipe, 3000)
        scene = run.scene
        tensors = {f"params.{k}": v.detach() for k, v in scene.table.params.items()}
        tensors |= {f"facts.{k}": v for k, v in scene.table.facts.items()}
        tensors |= {f"network.{k}": v.detach() for k, v in scene.network_tensors().items()}
        meta = {"recipe": recipe, "step": 3000, "seconds": 1.0, "cpu_seconds": 1.0, "load": {}, **scene.meta(), "capture": ""}
        make_run(folder, recipe, pictures=False)
        checkpoint.save(folder / "checkpoints", 3000, tensors, meta)

    return make


def _read_run(folder: Path) -> Any:
    opened = open_run(folder)
    return opened.config, opened.scene, dict(opened.scene.table.params.items())


def _report(folder: Path) -> None:
    make_run(folder, pictures=False)
    for kind in ("gt", "renders", "errors"):
        (folder / "test" / kind).mkdir(parents=True)
        for i in range(3):
            Image.new("RGB", (8, 6), (10 * i, 0, 0)).save(folder / "test" / kind / f"{i}.png")


def _read_report(folder: Path) -> Any:
    page.write([folder], folder / "page.html")
    store.read_run(folder, "fox")
    return results.load_results(folder), read_config(folder)


def _capture(folder: Path) -> None:
    make_capture(folder, 4, (16, 12), points=30)


def _capture_text(folder: Path) -> None:
    make_capture(folder, 4, (16, 12), points=30, text=True)


def _capture_lens(folder: Path) -> None:
    make_capture(folder, 3, (16, 12), points=20, distortion=Lens("OPENCV", 16, 12, (14, 14, 8, 6, 0.05, 0.01, 0.001, 0.001)))


def _nerfstudio(folder: Path) -> None:
    make_nerfstudio(folder, views=4, size=(16, 12), points=30)


def _points(folder: Path) -> None:
    make_capture(folder, 3, (16, 12), points=20)
    make_nerfstudio(folder / "cloud", views=2, size=(16, 12), points=30)
    (folder / "cloud/sparse_pc.ply").rename(folder / "lidar.ply")
    (folder / "sparse/0/test.txt").write_text("view_001.png\n")


def _read_own_points(folder: Path) -> Any:
    found = capture.load(Data(folder, points=folder / "lidar.ply", model="sparse/0"))
    found.images.close()
    return found.views, found.points, found.world, found.extent


def _poses(make: Callable[[Path, int, tuple[int, int], int], Any]) -> Callable[[Path], None]:
    return lambda folder: make(folder, 3, (16, 12), 10) and None


def _blender(folder: Path) -> None:
    make_blender(folder, 4, 12)


def _read_capture(folder: Path) -> Any:
    found = capture.load(Data(folder), allow_no_points=True)
    frames = [found.images.get(i) for i in range(min(2, len(found.images)))]
    found.images.close()
    return found.views, found.points, found.world, found.extent, frames


def _picture(format: str, **options: Any) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 4 if format in ("PNG", "WEBP") else 3), np.uint8)
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, format, **options)
        (folder / "photo").write_bytes(stream.getvalue())
        Image.fromarray(pixels[..., 0]).save(folder / "mask", "PNG")

    return make


def _exr(folder: Path) -> None:
    import OpenEXR

    _picture("PNG")(folder)
    (folder / "photo").unlink()
    pixels = np.random.default_rng(0).random((12, 16, 4)).astype(np.float32)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGBA": pixels}).write(str(folder / "photo.exr"))


def _read_picture(folder: Path) -> Any:
    photo = next(folder.glob("photo*"))
    size = probe(photo).size
    return decode(FrameSource(photo, Lens("PINHOLE", *size, (9, 9, 8, 6)), (8, 6), Mask(folder / "mask"), True, (1.0, 1.0, 1.0)))


def _path(folder: Path) -> None:
    pose = np.eye(4)
    keys = [{"time": t, "camera_to_world": pose.tolist(), "fov": 50.0} for t in (0, 0.5, 1.0)]
    value = {"format": 1, "fps": 10, "loop": False, "width": 32, "height": 24, "keyframes": keys}
    write_json(folder / "path.json", value)


def _path_nerfstudio(folder: Path) -> None:
    entries = [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.3} for _ in range(4)]
    value = {"camera_type": "perspective", "render_height": 24, "render_width": 32, "camera_path": entries, "fps": 24}
    write_json(folder / "path.json", value)


def _read_path(folder: Path) -> Any:
    return [camera.world_to_cam for camera in read_path(folder / "path.json", _world(), CAMERA).cameras]


def _record(folder: Path) -> None:
    store.write(folder, record())
    next(folder.glob("*.json")).rename(folder / "record.json")


def _weights(folder: Path) -> None:
    from safetensors.torch import save_file

    tensors = {name: torch.zeros(shape) for name, shape in tensor_shapes("alex").items() if name.startswith("lin")}
    save_file(tensors, folder / "w.safetensors", {"sha256": _hash_tensors(tensors), "source": "test"})


def _scene_of_compact(folder: Path) -> Any:
    """Read a compact file and build its scene, as `import` does."""
    from scene_experts.core.plain import from_json
    from scene_experts.core.reading import budget
    from scene_experts.core.reading.source import guarding
    from scene_experts.files.anchors.data import by_attribute
    from scene_experts.files.anchors.read import check_networks, tensors_of
    from scene_experts.training.config import Train

    path = folder / "scene.compact"
    data = registry.read(path)
    with guarding(path, budget.HEAD):
        networks, about = by_attribute(data.networks), data.about or {}
        check_networks(networks, str(path))
        result_folder.check_description(about)
        config = from_json(Train, about["train"], "train")
        meta = {**about.get("scene", {}), "voxel": about["voxel_size"]["trained"], "extent": about["extent"], "step": data.step}
        scene = restore_foreign(config.scaled_scene(), tensors_of(data, networks, _world(), meta["voxel"]), meta)
    return data, scene


_JSON = {".json": mutate_json, ".gltf": mutate_json}
_TENSORS = {".safetensors": containers.tensors}
TARGETS: dict[str, Target] = {
    "ply": Target(_gaussians("ply"), _read_only_file),
    "ply-ascii": Target(_ply_texts, _read_only_file),
    "compressed-ply": Target(_gaussians("compressed-ply"), _read_only_file),
    "splat": Target(_gaussians("splat"), _read_only_file),
    "spz": Target(_gaussians("spz"), _read_only_file, packs={".spz": containers.gzipped}),
    "sog": Target(_gaussians("sog"), _read_only_file, packs={".sog": containers.zipped}),
    "glb": Target(_gaussians("glb"), _read_only_file, packs={".glb": containers.glb}),
    "baked-html": Target(_gaussians("baked-html"), _read_only_file),
    "ply-others": Target(_ply_of_others, _read_only_file),
    "compressed-ply-1": Target(_compressed_1, _read_only_file),
    "sog-1": Target(_foreign("scene.sog", lambda s: foreign.zipped(foreign.sogs_1(s))), _read_only_file, packs={".sog": containers.zipped}),
    "sog-folder": Target(_sog_folder, registry.read, packs=_JSON),
    "gltf": Target(_gltf_plain, lambda folder: registry.read(folder / "scene.gltf"), packs=_JSON),
    "gltf-spz": Target(_gltf, lambda folder: registry.read(folder / "scene.gltf"), packs=_JSON),
    "ksplat": Target(_foreign("scene.ksplat", lambda s: foreign.ksplat(s, 2, 8, sections=2)), _read_only_file),
    "ksplat-0": Target(_foreign("scene.ksplat", lambda s: foreign.ksplat(s, 0)), _read_only_file),
    "zip": Target(_zip, _read_only_file, packs={".zip": containers.zipped}),
    "compact": Target(_compact, _scene_of_compact, packs={".compact": containers.compact}),
    "html": Target(_live, _read_only_file),
    "networks": Target(_networks, lambda folder: read_tensors(folder / "net.pt"), packs={".pt": containers.zipped}),
    "torchscript": Target(_traces, lambda folder: read_tensors(folder / "net.pt"), packs={".pt": containers.zipped}),
    "result-folder": Target(_result, _read_result, packs={".pt": containers.zipped}),
    "run-anchors": Target(_run("octree-moe-gs"), _read_run, ("*.safetensors", "config.json"), _TENSORS),
    "run-gaussians": Target(_run("3dgs"), _read_run, ("*.safetensors", "config.json"), _TENSORS),
    "run-graph": Target(_run("sags"), _read_run, ("*.safetensors", "config.json"), _TENSORS),
    "report": Target(_report, _read_report),
    "record": Target(_record, lambda folder: store.read(folder / "record.json")),
    "colmap": Target(_capture, _read_capture, ("*.bin",)),
    "colmap-text": Target(_capture_text, _read_capture, ("*.txt",)),
    "colmap-lens": Target(_capture_lens, _read_capture, ("cameras.bin", "images.bin")),
    "nerfstudio": Target(_nerfstudio, _read_capture, ("*.json", "*.ply")),
    "points": Target(_points, _read_own_points, ("lidar.ply", "test.txt")),
    "realitycapture": Target(_poses(make_realitycapture), _read_capture, ("*.csv", "*.ply")),
    "metashape": Target(_poses(make_metashape), _read_capture, ("*.xml", "*.ply")),
    "bundler": Target(_poses(make_bundler), _read_capture, ("*.out", "*.txt")),
    "polycam": Target(_poses(make_polycam), _read_capture, ("*.json",)),
    "blender": Target(_blender, _read_capture, ("*.json", "*.png")),
    "exr": Target(_exr, _read_picture),
    "png": Target(_picture("PNG"), _read_picture),
    "jpeg": Target(_picture("JPEG"), _read_picture),
    "webp": Target(_picture("WEBP", lossless=True), _read_picture),
    "tiff": Target(_picture("TIFF", compression="tiff_deflate"), _read_picture),
    "camera-path": Target(_path, _read_path),
    "camera-path-nerfstudio": Target(_path_nerfstudio, _read_path),
    "lpips": Target(_weights, lambda folder: _read_cache(folder / "w.safetensors")),
}


def make_seed(target: Target, folder: Path) -> Files:
    """Return the files of a target's valid input."""
    folder.mkdir(parents=True, exist_ok=True)
    target.make(folder)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def describe_files(files: Files) -> str:
    """Return the sizes of the files of an input."""
    return json.dumps({name: len(data) for name, data in files.items()})
