import ast
import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import pytest

import scene_experts
from scene_experts.core.fields import default_of
from scene_experts.core.parts import Part, find, names_of
from scene_experts.core.plain import lean
from scene_experts.scene.anchors.experts import Experts
from scene_experts.training.config import Train
from scene_experts.training.recipes import PROPOSED, RECIPES
from support.golden import recorded

SOURCE = Path(scene_experts.__file__).parent


def test_moe_gs_is_scaffold_gs_with_experts_and_their_losses():
    scaffold, moe = RECIPES["scaffold-gs"][1], RECIPES["moe-gs"][1]
    assert replace(moe, recipe="scaffold-gs", scene=replace(moe.scene, decoder=scaffold.scene.decoder), loss=scaffold.loss) == scaffold
    assert (moe.loss.scale, moe.loss.opacity, moe.loss.load, moe.loss.dssim) == (0.01, 0.01, 0.01, 0.2)
    assert moe.scene.decoder == Experts(num=5, top_k=2, warmup=1500)


def test_every_ablation_of_the_paper_has_a_recipe():
    names = {"scaffold-gs-opacity", "moe-gs-no-cl", "moe-gs-no-load", "moe-gs-no-opacity", "moe-gs-dist", "moe-gs-posrouter"}
    names |= {f"moe-gs-e{e}-{k}" for e in (2, 3, 4, 5) for k in ("top1", "top2", "dense")} | {f"scaffold-gs-depth{d}" for d in range(2, 7)}
    assert names <= set(RECIPES)
    assert RECIPES["moe-gs-no-cl"][1].scene.decoder.warmup == 0
    assert RECIPES["moe-gs-no-load"][1].loss.load == 0 and RECIPES["moe-gs-no-opacity"][1].loss.opacity == 0
    assert RECIPES["moe-gs-e4-top1"][1].scene.decoder.top_k == 1 and RECIPES["moe-gs-e3-dense"][1].scene.decoder.top_k is None
    assert RECIPES["scaffold-gs-opacity"][1].loss.opacity == 0.01


def defaults_of(kind):
    """The number of a part's changes, and the default of each of its settings."""
    fields = {f.name: lean(default_of(f)) for f in dataclasses.fields(kind) if default_of(f) is not dataclasses.MISSING}
    return {"changes": kind.version() if issubclass(kind, Part) else 0, **json.loads(json.dumps(fields))}


OURS = [Train, *(kind for name in names_of(Part) if (kind := find(name, Part)) and kind.__module__.startswith("scene_experts."))]


@pytest.mark.parametrize("kind", OURS, ids=lambda kind: kind.__name__)
def test_a_default_changes_only_with_a_sentence_in_changes(kind):
    """Records state what differs from the defaults: with another default, those that exist would mean other runs."""
    known, now = recorded("defaults.json", kind.__name__, lambda: defaults_of(kind)), defaults_of(kind)
    assert known is not None, "run `make record-flags`"
    if known["changes"] == now["changes"]:  # a new setting needs no record, and one that is gone had its default everywhere
        changed = {name for name in known.keys() & now.keys() if known[name] != now[name]}
        assert changed == set(), f"say in `{kind.__name__}.changes` what it computes now, then run `make record-flags`"


NAMED = {
    "reproduce/experiments.py",
    "reproduce/claims.py",
    "reproduce/figures.py",
    "bench/step.py",
    "commands/train.py",
    "commands/blocks.py",
}


@pytest.mark.parametrize("path", [p for p in SOURCE.rglob("*.py") if p.name != "recipes.py"], ids=lambda p: str(p.relative_to(SOURCE)))
def test_no_recipe_name_steers_code_elsewhere(path):
    names = set(RECIPES) - {"scene-experts"}  # which is the name of the program too
    tree = ast.parse(path.read_text())
    if str(path.relative_to(SOURCE)) in NAMED:  # what to run is data there; nothing may depend on it
        tree = [node for node in ast.walk(tree) if isinstance(node, ast.Compare)]
        found = [n.value for compare in tree for n in ast.walk(compare) if isinstance(n, ast.Constant) and n.value in names]
    else:
        found = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and n.value in names]
    assert not found


def test_the_proposed_recipe_is_one():
    assert PROPOSED in RECIPES and RECIPES[PROPOSED][1].recipe == PROPOSED
