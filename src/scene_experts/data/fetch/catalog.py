"""The 17 scenes of the paper: where their owners publish them, under which terms, and in which
protocol the paper evaluates them.

The facts are those that the owners of the data publish. A checksum is listed only if many
independent users report the same one. This module uses neither the network nor the disk;
`data.fetch.obtain` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scene_experts.core.errors import InputError, nearest

PREFIX = "catalog:"
Numbers = tuple[tuple[str, float | int | str], ...]


@dataclass(frozen=True)
class RemoteArchive:
    """A file that contains several scenes."""

    name: str
    urls: tuple[str, ...]  # tried in order; the owner's address comes first
    page: str  # web page of the data set
    size: str  # as shown to users
    bytes: int | None = None  # exact; None: unknown
    sha256: str | None = None  # None: not published; later downloads are compared with the first
    notes: str = ""


@dataclass(frozen=True)
class Collection:
    """A data set: the scenes of one owner, in one archive."""

    key: str
    title: str
    archive: RemoteArchive
    licence: str  # as the owner states it
    source: str  # publication of its authors
    numbers: Numbers = ()
    """Settings of the scripts of Scaffold-GS and Octree-GS for these scenes, by the field of
    `Train`; in the captures' own units."""


@dataclass(frozen=True)
class CatalogScene:
    """A scene and its protocol in the paper: image sizes and held-out views as in 3DGS (Kerbl et
    al. 2023)."""

    name: str
    collection: Collection
    inside: tuple[str, ...]  # possible folders in the archive
    resolution: str  # policy of `--resolution`
    split: str = "mod8"
    views: int | None = None  # number of photographs; None: unknown
    also: str = ""  # other protocols in use

    @property
    def path(self) -> str:
        """Its folder inside the folder of captures, which is also its full name."""
        return f"{self.collection.key}/{self.name}"


MIP360 = RemoteArchive(
    "360_v2.zip",
    (
        "https://storage.googleapis.com/gresearch/refraw360/360_v2.zip",
        "https://huggingface.co/datasets/YouLiXiya/nerf/resolve/main/360_v2.zip",
    ),
    "https://jonbarron.info/mipnerf360/",
    "12.5 GB",
    notes="the second address is a copy by a third party",
)
TANDT_DB = RemoteArchive(
    "tandt_db.zip",
    (
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
        "https://huggingface.co/camenduru/gaussian-splatting/resolve/main/tandt_db.zip",
    ),
    "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/",
    "683 MB",
    682_628_995,
    "816e62f22a161abbfe841d2a6b10cdf036e297c9fa289b3bfeee9c6ec526d7e1",
    notes="COLMAP reconstructions by the authors of 3DGS; the second address is a copy by a third party",
)
BUNGEE = RemoteArchive(
    "bungeenerf.tar.gz",
    ("https://drive.usercontent.google.com/download?id=1nBLcf9Jrr6sdxKa1Hbd47IArQQ_X8lww&export=download&confirm=t",),
    "https://drive.google.com/file/d/1nBLcf9Jrr6sdxKa1Hbd47IArQQ_X8lww/view",
    "size not stated",
    notes="with COLMAP reconstructions by the authors of Scaffold-GS; also at https://pan.baidu.com/s/1AUYUJojhhICSKO2JrmOnCA, code 4whv",
)

_OCTREE = ("scene.select.base_layer", 10)
MIPNERF360 = Collection(
    "mipnerf360", "Mip-NeRF 360", MIP360, "not stated", "Barron et al., CVPR 2022", (("scene.voxel_size", 0.001), _OCTREE)
)
TANDT = Collection(
    "tandt",
    "Tanks and Temples",
    TANDT_DB,
    "https://www.tanksandtemples.org/license/ names CC BY 4.0 and, in the same text, non-commercial research only",
    "Knapitsch et al., SIGGRAPH 2017",
    (("scene.voxel_size", 0.01), _OCTREE, ("scene.select.visible_threshold", 0.9)),
)
DEEP_BLENDING = Collection(
    "db",
    "Deep Blending",
    TANDT_DB,
    "not stated",
    "Hedman et al., SIGGRAPH Asia 2018",
    (("scene.voxel_size", 0.005), ("scene.select.base_layer", 12), ("scene.select.visible_threshold", 0.9)),
)
BUNGEENERF = Collection(
    "bungeenerf",
    "BungeeNeRF",
    BUNGEE,
    "not stated; rendered with Google Earth Studio, whose terms apply",
    "Xiangli et al., ECCV 2022",
    (
        ("scene.voxel_rule", "squared_median"),
        ("growth.init_factor", 128),
        _OCTREE,
        ("scene.select.visible_threshold", 0.0),
        ("scene.select.dist_ratio", 0.99),
    ),
)

_CAP = "cap1600 (Scaffold-GS, Octree-GS and their kin: full-size photographs, at most 1600 px wide)"
_LOD = "first:31 (the scripts of Scaffold-GS and SAGS, `--lod 30`)"
_OUTDOOR = {"bicycle": 194, "garden": None, "stump": None}  # images_4, as 3DGS reads them
_INDOOR = {"bonsai": 292, "counter": None, "kitchen": 279, "room": None}  # images_2
_CITIES = ("amsterdam", "bilbao", "hollywood", "pompidou", "quebec", "rome")

SCENES: tuple[CatalogScene, ...] = (
    *(CatalogScene(name, MIPNERF360, (name, f"360_v2/{name}"), "inria:4", views=views, also=_CAP) for name, views in _OUTDOOR.items()),
    *(CatalogScene(name, MIPNERF360, (name, f"360_v2/{name}"), "inria:2", views=views, also=_CAP) for name, views in _INDOOR.items()),
    *(CatalogScene(name, TANDT, (f"tandt/{name}",), "as-is", views=views) for name, views in (("truck", 251), ("train", 301))),
    *(CatalogScene(name, DEEP_BLENDING, (f"db/{name}",), "as-is", views=views) for name, views in (("drjohnson", 263), ("playroom", 225))),
    *(CatalogScene(name, BUNGEENERF, (f"bungeenerf/{name}", name), "as-is", also=_LOD) for name in _CITIES),
)
COLLECTIONS = (MIPNERF360, TANDT, DEEP_BLENDING, BUNGEENERF)


def select(words: Sequence[str]) -> list[CatalogScene]:
    """Return the scenes that `words` name, each once and in catalog order.

    A word names a scene ("bonsai", "mipnerf360/bonsai"), a data set ("tandt") or everything
    ("all"). Raises InputError for any other word and suggests the nearest names.
    """
    chosen: list[CatalogScene] = []
    for word in words:
        name = word.removeprefix(PREFIX).strip("/").lower()
        found = [s for s in SCENES if name in (s.name, s.path, s.collection.key, "all")]
        if not found:
            known = [*(s.name for s in SCENES), *(s.path for s in SCENES), *(c.key for c in COLLECTIONS), "all"]
            raise InputError(
                f"expected a scene or data set of the catalog, found '{word}'{nearest(name, known)}; see `scene-experts catalog`"
            )
        chosen += found
    return [scene for scene in SCENES if scene in chosen]


def one(word: str) -> CatalogScene:
    """Return the scene that `word` names. Raises InputError if it names none or several."""
    found = select([word])
    if len(found) != 1:
        raise InputError(f"expected one scene of the catalog, found '{word}', which names {len(found)}; choose one of {_names(found)}")
    return found[0]


@dataclass(frozen=True)
class Defaults:
    """What a capture brings where no option says otherwise."""

    normalise: Literal["extent", "none"] = "extent"
    """How the world is scaled: the numbers of a data set are in its own units."""
    numbers: Numbers = ()
    """Numbers of its data set for a recipe that is chosen by name."""


def defaults_of(capture: str | Path) -> Defaults:
    """Return what a capture brings: `catalog:SCENE` the units and numbers of its data set, any
    other path nothing.

    Its resolution and split are those that `obtain.resolve` puts in place of "auto". Raises
    InputError for an unknown scene.
    """
    word = str(capture)
    return Defaults("none", one(word).collection.numbers) if word.startswith(PREFIX) else Defaults()


def defaults_in(args: Sequence[str]) -> Defaults:
    """Return what the capture among the words of a command brings. Raises InputError for an unknown
    scene."""
    words = (arg.removeprefix("--data=").removeprefix("-s=") for arg in args)
    return defaults_of(next((word for word in words if word.startswith(PREFIX)), ""))


def _names(scenes: Sequence[CatalogScene]) -> str:
    return ", ".join(scene.name for scene in scenes)
