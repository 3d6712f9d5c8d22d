"""Files to runs of explicit Gaussians: a file of any format of standard Gaussians, or a result
folder of 3DGS, published or ours."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.plain import from_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import guarding
from scene_experts.core.table import Table
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.data.transform import read_transform
from scene_experts.data.views import Capture, Vector, World
from scene_experts.files import result_folder
from scene_experts.files.formats.ply import has_gaussians, property_names
from scene_experts.files.formats.splats import Splats
from scene_experts.files.gaussians.write import KIND
from scene_experts.files.placed import place_cameras
from scene_experts.files.registry import Imported, recognise, scene_file
from scene_experts.files.registry import read as read_file
from scene_experts.files.scene_folder import tell_origin
from scene_experts.files.transform import move
from scene_experts.scene import Scene
from scene_experts.scene.gaussians import Explicit, GaussianScene
from scene_experts.training.config import Train
from scene_experts.training.recipes import gs_3d
from scene_experts.training.run_folder import OpenRun

log: logging.Logger = logging.getLogger(__name__)
DRAWN_AT = 3  # the step to draw scenes of `scene_of` at: all their harmonics are in use from this step on


def find(source: Path, iteration: int | None) -> Path | None:
    """The PLY of a result folder with Gaussians; None for other scenes."""
    path = result_folder.iteration_folder(source, iteration) / "point_cloud.ply"
    return path if has_gaussians(property_names(path)) else None


def read(source: Path, data: Data | None, iteration: int | None, transform: Path | None = None) -> Imported:
    """The run in a file of Gaussians, published or ours, in the frame and unit of the capture.

    The recipe is 3DGS and the step 0, or `iteration`, unless the description or the name of its
    folder says otherwise. transform: `transform.read_transform`. Whether it is drawn with
    antialiasing, the description beside it (FILE.json) or the file says. data: None for a scene
    without its capture, whose frame is then that of the file. Raises InputError where the
    description says that the file is in another frame."""
    antialias = is_antialiased(source)
    about = result_folder.read_description(source.parent) or {}
    if data is None:
        data, splats, noted = result_folder.data_in(about), read_splats(source), noted_origin(source)
        x, y, z = origin = far_origin(splats) if noted is None else noted
        world = World(1.0, (-x, -y, -z))
        placed = world.seen_from(noted or (0.0, 0.0, 0.0))
        capture = place_cameras(source, placed.from_input(splats.means.double()), world, noted or (0.0, 0.0, 0.0), data.background)
    else:
        data = result_folder.drawn_as(data, about)
        capture = captures.load(data)
        capture.images.close()
        made_on = beside(source).get("capture")
        if made_on not in (None, "", capture.fingerprint()):
            log.warning(
                "%s was made with other views or another --resolution than those of %s; check that it is the same capture (and --split)",
                source,
                capture.root,
            )
        splats, origin = read_splats(source), (0.0, 0.0, 0.0)
        placed = capture.world if transform is not None else file_world(source, splats, capture)
    if transform is not None:
        columns = table_columns(move(splats, read_transform(transform, capture)), capture.world)
    else:
        columns = table_columns(splats, placed)
    step = about.get("step") or iteration or result_folder.iteration_of(source.parent) or 0
    degree = math.isqrt(columns["sh_rest"].shape[1] + 1) - 1
    cfg = replace(gs_3d, scene=Explicit(sh_degree=degree), iterations=step or gs_3d.iterations, antialias=antialias)
    if about.get("kind") == KIND and "train" in about:
        cfg = from_json(Train, about["train"], "train")
        try:
            cfg = replace(cfg, scene=replace(cfg.scene, sh_degree=degree))  # some formats keep fewer harmonics
        except TypeError:
            raise InputError(
                f"expected the recipe of a scene of Gaussians in the description beside {source}, found '{cfg.recipe}'; remove it"
            ) from None
    tensors = {f"params.{name}": value for name, value in columns.items()}
    return Imported(cfg, data, capture, tensors, {"extent": capture.extent}, step, origin)


def file_world(source: Path, splats: Splats, capture: Capture) -> World:
    """The capture's world for positions as a file holds them.

    The description of its result folder, the one beside it (FILE.json) or the note of a PLY states
    their origin. Where none does and float32 cannot hold positions of the capture, the origin is
    that of our own files if the Gaussians lie nearer to the cameras from there, which a warning
    tells.
    """
    if (noted := noted_origin(source)) is not None:
        return capture.world.seen_from(noted)
    origin = capture.world.local_origin(capture.extent)
    middle = splats.means.double().median(0).values
    away = [float(world.from_input(middle).norm()) for world in (capture.world.seen_from(origin), capture.world)]
    if not any(origin) or away[1] <= away[0]:
        return capture.world
    log.warning("the positions in %s are taken %s", source, tell_origin(origin))
    return capture.world.seen_from(origin)


def noted_origin(source: Path) -> Vector | None:
    """The origin that the description of the result folder of a file, the one beside it (FILE.json)
    or the note in it states; None where none does."""
    places = (lambda: result_folder.read_description(source.parent) or {}, lambda: beside(source), lambda: note_in(source))
    for about in (place() for place in places):
        if "origin" in about:
            with guarding(source, budget.JSON, "description of a file"):
                return result_folder.origin_in(about)
    return None


def note_in(source: Path) -> dict[str, Any]:
    """The note on how a file was made that the file itself holds; empty where there is none."""
    path = scene_file(source)
    if not path.is_file():
        return {}
    format = recognise(path)[1]
    return {} if format.read_note is None else format.read_note(path)


def far_origin(splats: Splats) -> Vector:
    """A place of whole numbers near Gaussians whose positions float32 cannot hold; 0 where it
    can."""
    x, y, z = splats.means.double().median(0).values.tolist()
    away = (splats.means.double() - torch.tensor((x, y, z), dtype=torch.float64)).norm(dim=1)
    return World(1.0, (-x, -y, -z)).local_origin(float(away.median()))


def read_splats(path: Path) -> Splats:
    """The Gaussians of a file of any format. Raises InputError for files without Gaussians and for
    values that are not finite."""
    found: Splats = read_file(path)
    if not len(found):
        raise InputError(f"expected Gaussians in {path}, found none; export the result again")
    with guarding(path, budget.HEAD):
        return found.checked(path)


def table_columns(splats: Splats, world: World) -> dict[str, Tensor]:
    """The columns of a table of explicit Gaussians, trained world: the inverse of
    `write.splats_of`."""
    return {
        "means": world.from_input(splats.means.double()).float(),
        "log_scales": (splats.log_scales.double() + math.log(world.scale)).float(),
        "quats": splats.quats,
        "raw_opacity": splats.opacity_logit,
        "sh_dc": splats.sh[:, 0].contiguous(),
        "sh_rest": splats.sh[:, 1:].contiguous(),
    }


def scene_of(columns: dict[str, Tensor], extent: float) -> GaussianScene:
    """A scene of explicit Gaussians with these columns. Draw it at step `DRAWN_AT` or later for all
    harmonics."""
    degree = round((columns["sh_rest"].shape[1] + 1) ** 0.5) - 1
    return GaussianScene(Explicit(sh_degree=degree, sh_ramp=1), Table(columns, {}), extent)


def scene(run: OpenRun, contents: Splats, world: World) -> tuple[Scene, int]:
    """The scene that a file holds, in the run's world, and the step to draw it at."""
    return scene_of(table_columns(contents, world), run.scene.extent), DRAWN_AT


def beside(path: Path) -> dict[str, Any]:
    """The description that `export` writes beside a file (FILE.json); empty where there is none."""
    file = path.with_name(path.name + ".json")
    found = read_json(file, "description of a file") if file.is_file() else None
    return found if isinstance(found, dict) else {}


def forget_description(path: Path) -> None:
    """Remove the description beside a file that another one has replaced."""
    if beside(path).keys() & {"gaussians", "bytes"}:
        path.with_name(path.name + ".json").unlink(missing_ok=True)


def is_antialiased(path: Path) -> bool:
    """Whether the description beside a file, or without one the file itself, says that it is drawn
    with antialiasing.

    Raises InputError where the description says that the file is not in the capture's own frame.
    """
    found = beside(path)
    if not found:
        format = recognise(path)[1]
        return format.is_antialiased is not None and format.is_antialiased(path)
    if found.get("frame") == "trained":
        raise InputError(
            f"expected a file in the capture's own frame, found {path} in the trained one; export it again with --frame capture"
        )
    return found.get("antialias") is True
