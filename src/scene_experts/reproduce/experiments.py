"""The tables and figures of the MoE-GS paper as data: their recipes, scenes and columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DATASETS: dict[str, tuple[str, ...]] = {
    "MipNeRF360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "TanksAndTemples": ("truck", "train"),
    "DeepBlending": ("playroom", "drjohnson"),
    "BungeeNeRF": ("amsterdam", "bilbao", "hollywood", "pompidou", "quebec", "rome"),
}
METHODS = {"3DGS": "3dgs", "Scaffold-GS": "scaffold-gs", "SAGS": "sags", "Octree-GS": "octree-gs", "MoE-GS": "moe-gs"}
ABLATION = {
    "w/o MoE": "scaffold-gs-opacity",
    "w/o CL": "moe-gs-no-cl",
    "w/o L_load": "moe-gs-no-load",
    "w/o L_opacity": "moe-gs-no-opacity",
    "MoE-GS": "moe-gs",
}
BEYOND = {
    "3DGS": "3dgs",
    "3DGS, MCMC": "3dgs-mcmc",
    "Scaffold-GS": "scaffold-gs",
    "Scaffold-GS, feature bank": "scaffold-gs-bank",
    "Scaffold-GS with the distance": "scaffold-gs-dist",
    "w/o MoE, as wide as five experts": "scaffold-gs-wide",
    "Octree-GS": "octree-gs",
    "Octree-GS with experts": "octree-moe-gs",
    "MoE-GS": "moe-gs",
    "Scene Experts": "scene-experts",
    "Scene Experts, one network of equal decode cost": "scene-experts-one",
    "Scene Experts, one network as wide as all experts": "scene-experts-wide",
}
ROUTINGS = ("top1", "top2", "dense")


@dataclass(frozen=True)
class Experiment:
    """One table or figure. `rows` maps the paper's name of each row or series to a recipe."""

    name: str
    title: str
    rows: dict[str, str]
    datasets: tuple[str, ...]
    kind: Literal["table", "figure"] = "table"
    columns: tuple[str, ...] = ("psnr", "ssim", "lpips_3dgs", "size_mb")
    added: tuple[str, ...] = ()  # columns that the paper does not have; shown where every record has a value
    scenes: tuple[str, ...] | None = None  # of the data sets; None: all
    paper: str | None = None  # the section of paper.yaml with the paper's numbers
    baselines: tuple[str, ...] = ()  # recipes; tables of the other recipes' differences from each are added

    def shows(self, dataset: str, scene: str) -> bool:
        return dataset in self.datasets and scene in self.scenes_of(dataset)

    def scenes_of(self, dataset: str) -> tuple[str, ...]:
        return tuple(s for s in DATASETS[dataset] if self.scenes is None or s in self.scenes)


EXPERIMENTS: dict[str, Experiment] = {
    e.name: e
    for e in (
        Experiment(
            "table1",
            "Table 1: the five methods",
            METHODS,
            ("MipNeRF360", "DeepBlending", "TanksAndTemples"),
            added=("cpu_seconds",),
            paper="table1",
        ),
        Experiment("table2", "Table 2: the five methods on large scenes", METHODS, ("BungeeNeRF",), added=("cpu_seconds",), paper="table2"),
        Experiment(
            "table3",
            "Table 3: share of Gaussians with positive opacity, with and without L_opacity",
            {"Scaffold-GS": "scaffold-gs", "Scaffold-GS+L_opacity": "scaffold-gs-opacity"},
            ("MipNeRF360", "DeepBlending", "TanksAndTemples"),
            columns=("active_percent",),
            paper="table3",
        ),
        Experiment("table4", "Table 4: what each part adds", ABLATION, ("DeepBlending", "TanksAndTemples"), paper="table4"),
        Experiment(
            "fig1b",
            "Figure 1(b): PSNR relative to 3DGS, scene by scene",
            {"3DGS": "3dgs", "Scaffold-GS": "scaffold-gs", "MoE-GS": "moe-gs"},
            ("DeepBlending", "MipNeRF360", "BungeeNeRF"),
            kind="figure",
            columns=("psnr", "size_mb"),
            scenes=("playroom", "room", "kitchen", "quebec", "pompidou", "garden", "stump", "bicycle"),
        ),
        Experiment(
            "fig3",
            "Figure 3: share of anchors per expert during training, without and with L_load (three experts, Top-2)",
            {"without L_load": "moe-gs-e3-no-load", "with L_load": "moe-gs-e3-top2"},
            ("BungeeNeRF",),
            kind="figure",
            columns=("psnr",),
            scenes=("quebec",),
        ),
        Experiment(
            "fig5",
            "Figure 5: the anchors of each expert, rendered alone (three experts, Top-2)",
            {"three experts": "moe-gs-e3-top2"},
            ("BungeeNeRF",),
            kind="figure",
            columns=("psnr",),
            scenes=("quebec",),
        ),
        Experiment(
            "fig6",
            "Figure 6: PSNR against training time for 2 to 5 experts and three routings",
            {f"{num} experts, {routing}": f"moe-gs-e{num}-{routing}" for num in (2, 3, 4, 5) for routing in ROUTINGS},
            ("DeepBlending",),
            kind="figure",
            columns=("psnr", "time", "size_mb"),
        ),
        Experiment(
            "fig7",
            "Figure 7: Scaffold-GS with more linear layers",
            {f"{depth} layers": f"scaffold-gs-depth{depth}" for depth in (2, 3, 4, 5, 6)},
            ("DeepBlending",),
            kind="figure",
            columns=("psnr", "ssim", "lpips_3dgs"),
        ),
        Experiment(
            "appendix",
            "Appendix and text: routers with the position as input, networks with the distance as input",
            {"MoE-GS": "moe-gs", "router with position": "moe-gs-posrouter", "networks with distance": "moe-gs-dist"},
            ("DeepBlending", "TanksAndTemples"),
        ),
        Experiment(
            "extras",
            "Beyond the paper: further recipes and the recipes they extend",
            BEYOND,
            ("MipNeRF360", "DeepBlending", "TanksAndTemples"),
        ),
    )
}
OURS = ("extras",)
"""Experiments that the paper does not have; `all` leaves them out."""
