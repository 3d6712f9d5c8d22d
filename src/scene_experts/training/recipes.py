"""The methods and ablations of the paper as recipes. Training, rendering and evaluation do not
depend on the names of recipes. Other packages can add recipes; see `training/recipe_book.py`.

3DGS: Kerbl et al., SIGGRAPH 2023.  3DGS-MCMC: Kheradmand et al., NeurIPS 2024.
Scaffold-GS: Lu et al., CVPR 2024.  Octree-GS: Ren et al., 2024.  SAGS: Ververas et al., ECCV 2024.
MoE-GS: Fu et al., "Scene Experts", AAAI 2026. Table and figure numbers below refer to this paper.
"""

from __future__ import annotations

from dataclasses import replace

from scene_experts.core.parts import load_with
from scene_experts.scene.anchors.balance import Balanced
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.mlp import ATTRIBUTES, Attribute, Decoder, Plain
from scene_experts.scene.anchors.places import Places
from scene_experts.scene.anchors.rates import Rates
from scene_experts.scene.anchors.routers import Linear
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.scene.anchors.select import Octree
from scene_experts.scene.gaussians import Explicit, ExplicitRates
from scene_experts.scene.graph.scene import GraphPoints, GraphRates
from scene_experts.strategy.grow_octree import GrowOctree
from scene_experts.strategy.grow_points import GrowPoints
from scene_experts.strategy.mcmc import MCMC
from scene_experts.strategy.split_clone import SplitClone
from scene_experts.training.config import Train
from scene_experts.training.losses import Weights
from scene_experts.training.recipe_book import Recipe, RecipeBook

EXPERTS = Experts(num=5, top_k=2, warmup=1500)
AFTER_GROWTH = (15_000, 22_500)  # iterations: the end of growth, and the middle of what follows
FEW = 46  # training views up to which a plane sweep gives the first points
PROPOSED = "one-network"
"""The recipe that `info` and `capture` propose and `make` trains."""

scaffold_gs: Train = Train(recipe="scaffold-gs", scene=Anchors(decoder=Plain()), loss=Weights(scale=0.01))
moe_gs: Train = replace(
    scaffold_gs,
    recipe="moe-gs",
    scene=Anchors(decoder=EXPERTS),
    loss=Weights(scale=0.01, opacity=0.01, load=0.01),
)
octree_gs: Train = replace(
    scaffold_gs,
    recipe="octree-gs",
    scene=Anchors(decoder=Plain(), select=Octree()),
    growth=GrowOctree(),
    iterations=40_000,
    schedule=40_000,
)
gs_3d: Train = Train(recipe="3dgs", scene=Explicit(), loss=Weights(scale=0.0), growth=SplitClone(), rates=ExplicitRates())
gs_mcmc: Train = replace(
    gs_3d,
    recipe="3dgs-mcmc",
    scene=Explicit(opacity=0.5, size=0.1),
    loss=Weights(scale=0.0, mean_opacity=0.01, mean_size=0.01),
    growth=MCMC(),
)
sags: Train = Train(recipe="sags", scene=GraphPoints(), loss=Weights(scale=0.0), growth=GrowPoints(), rates=GraphRates())


def _moe(name: str, *, loss: Weights = moe_gs.loss, add_dist: tuple[Attribute, ...] = (), **experts: object) -> Train:
    decoder = replace(EXPERTS, **experts)  # type: ignore[arg-type]
    return replace(moe_gs, recipe=name, scene=replace(moe_gs.scene, decoder=decoder, add_dist=add_dist), loss=loss)


def _flagship(name: str, decoder: Decoder, hidden: int) -> Train:
    return replace(
        scaffold_gs,
        recipe=name,
        scene=Anchors(hidden=hidden, decoder=decoder, dropout=0.2, view_jitter=0.5, few_views=20),
        loss=Weights(scale=0.01, opacity=0.01),
        rates=Rates(networks=2.0, anneal=0.1),
    )


def _for_photographs(name: str) -> Train:
    plain = _flagship(name, Plain(), 64)
    return replace(
        plain,
        scene=replace(plain.scene, few_fall=AFTER_GROWTH),
        loss=replace(plain.loss, depth=0.2),
        half_until=AFTER_GROWTH[0],
        dense_views=FEW,
        far_points=5.0,
        mean_background=True,
        near_share=0.5,
        random_background=True,
        random_background_from=AFTER_GROWTH[0],
    )


def _scaffold(name: str, **scene: object) -> Train:
    return replace(scaffold_gs, recipe=name, scene=replace(scaffold_gs.scene, **scene))  # type: ignore[arg-type]


OWN: dict[str, Recipe] = {
    "one-network": (
        "one network per attribute, for photographs of your own: few or many (ours, the default)",
        _for_photographs("one-network"),
    ),
    "scaffold-gs": ("Scaffold-GS: one network per attribute (the baseline)", scaffold_gs),
    "scene-experts": (
        "Scene Experts: five experts per attribute, each for one part of the scene (ours)",
        _flagship("scene-experts", Experts(num=5, top_k=1, warmup=10_000, router=Places()), 64),
    ),
    "scene-experts-one": (
        "scene-experts with one network of the same decode cost per attribute (control)",
        _flagship("scene-experts-one", Plain(), 64),
    ),
    "scene-experts-wide": (
        "scene-experts with one network as wide as all experts together (control)",
        _flagship("scene-experts-wide", Plain(), 320),
    ),
    "moe-gs": ("MoE-GS: five experts per attribute, Top-2 after a dense warm-up (the paper's main results)", moe_gs),
    "3dgs": ("3DGS: explicit Gaussians with spherical harmonics, cloned and split", gs_3d),
    "3dgs-mcmc": ("3DGS-MCMC: explicit Gaussians, relocated and perturbed, at most a million", gs_mcmc),
    "octree-gs": ("Octree-GS: anchors on levels of detail; each view uses the levels for its distance", octree_gs),
    "octree-moe-gs": (
        "Octree-GS with five experts per attribute, Top-2 after a dense warm-up (unpublished)",
        replace(octree_gs, recipe="octree-moe-gs", scene=replace(octree_gs.scene, decoder=EXPERTS), loss=moe_gs.loss),
    ),
    "sags": ("SAGS: points with a graph and a hash grid, denser in flat regions", sags),
    "scaffold-gs-bank": ("Scaffold-GS with the feature bank", _scaffold("scaffold-gs-bank", mix=FeatureBank())),
    "scaffold-gs-opacity": (
        "Scaffold-GS with the opacity hinge ('w/o MoE' in Table 4; row 2 of Table 3)",
        replace(scaffold_gs, recipe="scaffold-gs-opacity", loss=Weights(scale=0.01, opacity=0.01)),
    ),
    "scaffold-gs-wide": (
        "Scaffold-GS with the opacity hinge and networks as wide as five experts together (control; not in the paper)",
        replace(_scaffold("scaffold-gs-wide", hidden=160), loss=Weights(scale=0.01, opacity=0.01)),
    ),
    "scaffold-gs-dist": (
        "Scaffold-GS whose decoders also see the distance (control of moe-gs-dist)",
        _scaffold("scaffold-gs-dist", add_dist=ATTRIBUTES),
    ),
    "moe-gs-no-cl": ("Without the curriculum: Top-2 from the first iteration (Table 4)", _moe("moe-gs-no-cl", warmup=0)),
    "moe-gs-no-load": ("Without the load-balancing losses (Table 4)", _moe("moe-gs-no-load", loss=replace(moe_gs.loss, load=0.0))),
    "moe-gs-no-opacity": ("Without the opacity hinge (Table 4)", _moe("moe-gs-no-opacity", loss=replace(moe_gs.loss, opacity=0.0))),
    "moe-gs-dist": ("The decoders also see the distance, as the paper's text says", _moe("moe-gs-dist", add_dist=ATTRIBUTES)),
    "moe-gs-posrouter": (
        "The routers also see the anchor's position (appendix)",
        _moe("moe-gs-posrouter", router=Linear(input_pos=True)),
    ),
    "moe-gs-balance": (
        "Biases balance the experts instead of L_load (Wang et al. 2024; not in the paper)",
        _moe("moe-gs-balance", loss=replace(moe_gs.loss, load=0.0), router=Balanced()),
    ),
    "moe-gs-e3-no-load": (
        "Three experts without L_load (Figure 3a)",
        _moe("moe-gs-e3-no-load", num=3, loss=replace(moe_gs.loss, load=0.0)),
    ),
    **{
        f"moe-gs-e{num}-{name}": (
            f"{num} experts, {name.replace('top', 'Top-')} (Figure 6)",
            _moe(f"moe-gs-e{num}-{name}", num=num, top_k=k),
        )
        for num in (2, 3, 4, 5)
        for name, k in (("top1", 1), ("top2", 2), ("dense", None))
    },
    **{
        f"scaffold-gs-depth{depth}": (
            f"Scaffold-GS with {depth} linear layers (Figure 7)",
            _scaffold(f"scaffold-gs-depth{depth}", decoder=Plain(depth)),
        )
        for depth in (2, 3, 4, 5, 6)
    },
}

RECIPES = RecipeBook(OWN)
"""All recipes by name: a one-sentence description and the value of each."""
load_with(RECIPES.load)
