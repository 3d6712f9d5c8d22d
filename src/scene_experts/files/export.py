"""Trained runs to files: the Scaffold-GS layout and the compact file, in the capture's own frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.data.views import Capture, World
from scene_experts.files import gaussians as explicit
from scene_experts.files.anchors.compact import Compact, Sizes, read_compact, write_compact
from scene_experts.files.anchors.extras import extra_networks, level_columns
from scene_experts.files.anchors.frame import Network, anchors_to_input, lattice_to_input, networks_to_input
from scene_experts.files.anchors.layout import SIDECAR, describe, read_sidecar, write_scaffold_folder
from scene_experts.files.anchors.networks import is_plain, sequential
from scene_experts.files.anchors.read import compact_anchors, run_tensors, world_in
from scene_experts.files.anchors.read import import_result as import_files
from scene_experts.files.bake.measure import counted, nothing_counted, scores
from scene_experts.files.cameras import write_cameras
from scene_experts.files.graph import read as graph_points_in
from scene_experts.files.graph import write as graph_points
from scene_experts.render import Rasterizer, as_trained
from scene_experts.scene.anchors.experts import MixtureHead
from scene_experts.scene.anchors.scene import ATTRIBUTES, AnchorScene
from scene_experts.scene.anchors.select import LevelSelector
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.scene.graph.scene import GraphScene
from scene_experts.training import run_folder
from scene_experts.training.config import Data, to_json
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import scene_from

COMPACT = "scene.compact"
_LATTICE_TOLERANCE = 1e-3  # voxels


def write_layout(run: OpenRun, capture: Capture, out: Path | None = None) -> Path:
    """Write point_cloud/iteration_<step>/, cameras.json and (not for SAGS) cfg_args below `out`, the run folder; the iteration's folder."""
    out = out or run.path
    own = {GaussianScene: explicit.write_folder, GraphScene: graph_points.write_folder}
    folder = own.get(type(run.scene), _write_anchors)(run, capture.world, out)
    write_cameras(out / "cameras.json", capture)
    return folder


def export_run(
    run: Path, format: str, out: Path | None = None, step: int | None = None, rasterize: Rasterizer | None = None, data: Path | None = None
) -> list[str]:
    """Write the newest checkpoint of a run (or the one at `step`) as "anchors" (the Scaffold-GS layout) or "compact"; says what it wrote.

    Standard files of Gaussians are `bake/run`'s.
    out: folder for anchors, file or folder for compact; inside the run folder by default.
    rasterize: what to draw the held-out views with, to say what a compact file costs in PSNR; None leaves that out.
    data: where the capture is now, if it moved.
    """
    opened = moved(run_folder.open_run(run, "cpu", step), data)
    graph_points.refuse(opened)
    anchors = len(opened.scene.table)
    if format == "anchors":
        out = out or run
        folder = _write_anchors(opened, world_of(opened), out)
        if out != run and (run / "cameras.json").is_file():
            write_bytes(out / "cameras.json", (run / "cameras.json").read_bytes())
        size = sum(p.stat().st_size for p in folder.iterdir())
        said = f"{anchors:,} anchors, {size / 1e6:.2f} MB with networks, in the capture's own frame"
        return [f"wrote {folder}", said, *warnings_of_layout(opened)]
    path = out or run / COMPACT
    path = path / COMPACT if path.is_dir() else path
    sizes = write_compact_run(opened, world_of(opened), path)
    lines = [f"wrote {path}", f"{anchors:,} anchors, {sizes.per_anchor:.1f} bytes an anchor, {sizes.total / 1e6:.2f} MB with networks"]
    if rasterize is not None:
        lines.append(_cost_line(opened, path, rasterize))
    return lines


@torch.no_grad()
def warnings_of_layout(run: OpenRun) -> list[str]:
    """What readers of the Scaffold-GS layout would get wrong of a run: single networks of another form than the layout can say."""
    if not isinstance(run.scene, AnchorScene) or not is_plain(networks := _networks(run.scene)):
        return []
    others = []
    for attribute, network in networks.items():
        x = torch.randn(64, network["w1"].shape[2], generator=torch.Generator().manual_seed(0))
        own, _ = run.scene.heads[attribute](x, x[:, : run.scene.config.F], run.step)
        if not torch.allclose(own, sequential(attribute, network)(x), atol=1e-4, rtol=1e-4):
            others.append(attribute)
    if not others:
        return []
    what = f"the {', '.join(others)} networks of '{run.config.train.recipe}' are not Linear, ReLU, ..., Linear"
    return [f"warning: {what}, which is all that the Scaffold-GS layout can say: other readers of it will draw another scene"]


def _cost_line(run: OpenRun, path: Path, rasterize: Rasterizer) -> str:
    if not run.config.data.path.exists():
        return f"its capture is not at {run.config.data.path}: the cost in PSNR was not measured (--data says where it is)"
    capture = run_folder.capture_of(run)
    try:
        views = len(counted(capture))
        if not views:
            return f"{nothing_counted(capture)}: the cost in PSNR was not measured"
        before, after = psnr_cost(run, capture, path, rasterize)
    finally:
        capture.images.close()
    return f"PSNR of {views} held-out views {before:.3f} dB, from this file {after:.3f} dB ({after - before:+.3f})"


def psnr_cost(run: OpenRun, capture: Capture, path: Path, rasterize: Rasterizer) -> tuple[float, float]:
    """Mean PSNR (dB, 8-bit pictures) of the held-out views drawn from the run and from its compact file."""
    again = scene_of_compact(run, read_compact(path), capture.world)
    scenes = {"run": (run.scene.frozen(run.step), run.step), "file": (again.frozen(run.step), run.step)}
    found = scores(scenes, capture, counted(capture), as_trained(rasterize, run.cfg.antialias))
    return found["run"].photographs, found["file"].photographs


def scene_of_compact(run: OpenRun, file: Compact, world: World) -> AnchorScene:
    """The scene that a compact file holds, in the world and with the configuration of the run it was written from."""
    old = anchors_of(run)
    tensors = run_tensors(compact_anchors(file), file.cells, file.networks, old.config.add_dist, old.voxel, world)
    return scene_from(run.cfg, tensors, old.meta())


def write_compact_run(run: OpenRun, world: World, path: Path) -> Sizes:
    """Write the compact file of an opened run. Raises InputError where the anchors are not on a lattice."""
    scene = anchors_of(run)
    if isinstance(scene.select, LevelSelector):
        raise InputError(f"expected anchors of one lattice for a compact file, found levels of detail ({run.path}); use --format anchors")
    cells, xyz = scene.table.facts["cell"], scene.table.facts["xyz"]
    if len(cells):
        away = float((cells.double() * scene.voxel - xyz.double()).abs().max())
        if away > _LATTICE_TOLERANCE * scene.voxel + 1e-6 * float(xyz.abs().max()):
            raise InputError("expected anchors on a lattice of known voxel size for a compact file, found others; use --format anchors")
    found = anchors_to_input(_anchors(scene), world)
    voxel, origin = lattice_to_input(scene.voxel, world)
    columns = (found["feature"], found["log_scaling"], found["offsets"])
    return write_compact(path, cells, voxel, origin, *columns, _networks_in_input(scene, world), sidecar_of(run, world))


def _write_anchors(run: OpenRun, world: World, out: Path) -> Path:
    scene = anchors_of(run)
    anchors = anchors_to_input(_anchors(scene), world) | level_columns(scene, world.scale)
    return write_scaffold_folder(out, run.step, anchors, _networks_in_input(scene, world), sidecar_of(run, world))


def _anchors(scene: AnchorScene) -> dict[str, Tensor]:
    """The anchors' columns in the trained world."""
    return {"xyz": scene.table.facts["xyz"].cpu(), **{k: v.detach().cpu() for k, v in scene.table.params.items()}}


def _networks(scene: AnchorScene) -> dict[str, Network]:
    """The heads' tensors by attribute, in trained units."""
    out: dict[str, Network] = {a: {} for a in ATTRIBUTES}
    for name, value in scene.network_tensors().items():
        attribute, _, rest = name.partition(".")
        if attribute in out:
            out[attribute][rest] = value.detach().cpu()
    return out


def _networks_in_input(scene: AnchorScene, world: World) -> dict[str, Network]:
    features = scene.config.mix.width(scene.config.F)
    return networks_to_input(_networks(scene), scene.config.add_dist, world.scale, features) | extra_networks(scene, world.scale)


def sidecar_of(run: OpenRun, world: World) -> dict[str, Any]:
    """The description of an opened run: `scaffold.describe` with the whole configuration, the capture's path left out."""
    scene = anchors_of(run)
    networks = _networks(scene)
    k = {a: head.k(run.step) for a, head in scene.heads.items() if isinstance(head, MixtureHead)}
    return describe(
        recipe=run.config.train.recipe,
        networks=networks,
        k=k,
        K=scene.K,
        F=scene.config.F,
        add_dist=scene.config.add_dist,
        voxel_size=scene.voxel,
        scale=world.scale,
        shift=world.shift,
        step=run.step,
        extra={
            "appearance_dim": scene.config.appearance,
            "feature_bank": scene.mix is not None,
            "extent": scene.extent,
            "scene": scene.meta(),
            "train": to_json(run.config.train),
            "data": run.config.data.settings(),
        },
    )


def anchors_of(run: OpenRun) -> AnchorScene:
    """The run's scene, which must be one of anchors. Raises InputError where it is none."""
    if not isinstance(run.scene, AnchorScene):
        raise InputError(f"expected a scene of anchors, found a run of '{run.config.train.recipe}', which has none; use --format ply")
    return run.scene


def moved(run: OpenRun, data: Path | None) -> OpenRun:
    """The run with its capture at `data` (a folder or catalog:SCENE), where that is given."""
    if data is None:
        return run
    return replace(run, config=replace(run.config, data=replace(run.config.data, path=run_folder.named(Data(data)).path)))


def world_of(run: OpenRun) -> World:
    """The world a run was trained in: from the description beside its exported anchors, else from its capture."""
    for path in sorted((run.path / "point_cloud").glob(f"iteration_*/{SIDECAR}"), key=lambda p: p.stat().st_mtime, reverse=True):
        try:
            found = read_sidecar(path)
        except InputError:
            continue  # the capture says it too
        if found.get("data") == run.config.data.settings():
            return world_in(found)
    capture = run_folder.capture_of(run)
    capture.images.close()
    return capture.world


def import_result(source: Path, data: Data, out: Path, iteration: int | None = None) -> Path:
    """Make the run folder `out` of a result folder, compact file (`incoming`) or PLY file of 3DGS, with its layout; returns it."""
    if not Path(source).exists():
        raise InputError(f"expected a result folder or a file of a scene at {source}, found nothing; check the path")
    if graph := graph_points_in.find_folder(source, iteration):
        capture = graph_points_in.import_folder(graph, data, out)
        write_layout(run_folder.open_run(out), capture)
        return out
    file = explicit.find_file(source, iteration)
    capture = import_files(source, data, out, iteration) if file is None else explicit.import_file(file, data, out, iteration)
    write_layout(run_folder.open_run(out), capture)
    return out
