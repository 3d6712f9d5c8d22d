"""Load balancing by biases: the rule of Wang et al. (2024) by hand, and its state. Such a part needs only two files."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import scene_experts
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.plain import to_json
from scene_experts.core.types import Mode
from scene_experts.scene.anchors.balance import BalancedExperts, BalancedHead
from scene_experts.scene.anchors.experts import Experts, MixtureHead, Router
from scene_experts.training.config import check
from scene_experts.training.recipes import RECIPES
from support.messages import naming
from support.scenes import start_scene

SOURCE = Path(scene_experts.__file__).parent
STEP = 2000  # after the dense warm-up


def head(config: Experts, seed: int = 0) -> MixtureHead:
    torch.manual_seed(seed)
    made = config.build("color", 35, 16, 30, 32)
    assert isinstance(made, MixtureHead)
    return made


def test_the_part_touches_its_own_file_and_the_recipes_alone():
    own, names = (
        SOURCE / "scene" / "anchors" / "balance.py",
        ("BalancedExperts", "BalancedHead", "moe-gs-balance", "anchors.balance", "router_balance"),
    )
    naming = {p for p in SOURCE.rglob("*.py") if any(name in p.read_text() for name in names)}
    history = SOURCE / "training" / "old_hash.py"  # what earlier versions wrote
    assert naming == {own, SOURCE / "training" / "recipes.py", history}


def test_without_speed_it_is_the_mixture_of_the_paper_bit_for_bit():
    x, f = torch.randn(50, 35), torch.randn(50, 32)
    for step in (1, STEP):
        (a, ra), (b, rb) = (head(c)(x, f, step) for c in (Experts(), BalancedExperts(speed=0.0)))
        assert torch.equal(a, b) and torch.equal(ra.gates, rb.gates) and (step == 1 or torch.equal(ra.chosen, rb.chosen))


def test_biases_choose_and_gates_weigh():
    made = head(BalancedExperts(speed=0.0))
    f = torch.randn(40, 32)
    with torch.no_grad():
        made.router_balance.copy_(torch.tensor([0.0, 0.0, 2.0, 0.0, 1.5]))  # beyond any gate: everyone takes experts 2 and 4
    routing, w = made.route(f, STEP, None)
    assert (routing.chosen == torch.tensor([2, 4])).all()
    gates = torch.softmax(made.logits(f, None), 1)
    assert torch.equal(routing.gates, gates)
    torch.testing.assert_close(w, gates[:, [2, 4]] / gates[:, [2, 4]].sum(1, keepdim=True))


def test_the_biases_follow_the_count_of_a_training_view():
    made = head(BalancedExperts(num=3, top_k=1, speed=0.01))
    with torch.no_grad():
        made.router_w.zero_()
        made.router_b.copy_(torch.tensor([5.0, 0.0, 0.0]))
    f = torch.randn(6, 32)
    made.route(f, 1, None, Mode.TRAIN)
    assert not made.router_balance.any()  # nothing is chosen while dense
    made.route(f, STEP, None, Mode.DRAW)
    assert not made.router_balance.any()  # drawing moves nothing, with gradients or without
    made.route(f, STEP, None, Mode.TRAIN)
    assert made.router_balance.tolist() == pytest.approx([-0.01, 0.01, 0.01])  # counts 6, 0, 0; mean 2
    made.routing(f, STEP, mode=Mode.TRAIN)
    assert made.router_balance.tolist() == pytest.approx([-0.01, 0.01, 0.01])  # a loss over the whole scene asks again at the same step
    made.train()
    made.route(f, STEP + 1, None)
    assert made.router_balance.tolist() == pytest.approx([-0.01, 0.01, 0.01])
    assert not made.router_balance.requires_grad


def test_a_batch_moves_the_biases_once_by_the_counts_of_all_views():
    made, f = head(BalancedExperts(num=3, top_k=1, speed=0.01)), torch.randn(40, 32)
    made.batch = 4
    chosen = [made.route(f[view * 10 : view * 10 + 10], STEP + view, None, Mode.TRAIN)[0].chosen for view in range(4)]
    assert made.router_balance.tolist() == [0, 0, 0]
    count = torch.bincount(torch.cat(chosen).reshape(-1), minlength=3).float()
    assert made.counts()[0].tolist() == count.tolist()
    made.settle()
    assert made.router_balance.tolist() == pytest.approx((0.02 * (count.mean() - count).sign()).tolist())  # 0.01 sqrt(4)
    assert made.counts()[0].tolist() == [0, 0, 0]


def test_a_collapsed_router_is_evened_out():
    made, f = head(BalancedExperts(speed=0.002)), torch.randn(500, 32)
    with torch.no_grad():
        made.router_b[0] += 3.0
    share = lambda: torch.bincount(made.route(f, STEP, None)[0].chosen.reshape(-1), minlength=5) / 1000  # noqa: E731
    assert share()[0] > 0.45
    for i in range(600):
        made.route(f, STEP + 1 + i, None, Mode.TRAIN)
    assert (share() - 0.2).abs().max() < 0.03


def test_the_recipe_and_its_flags():
    recipe = RECIPES["moe-gs-balance"][1]
    check(recipe)
    assert recipe.loss.load == 0 and recipe.loss.opacity == 0.01 and recipe.scene.decoder == BalancedExperts()
    with pytest.raises(InputError, match=r"--scene\.decoder\.speed"):
        BalancedExperts(speed=-1.0).check()


def test_margin_weights_are_refused():
    """A bias may choose an expert whose gate is smaller than one that is not chosen: its margin, and the weight, would be below 0."""
    config = BalancedExperts(router=Router(weights="margin"))
    with pytest.raises(InputError, match=naming("--scene.decoder.router.weights", "margin")):
        config.check()
    scene = start_scene("moe-gs-balance")
    assert all(isinstance(h, BalancedHead) for h in scene.heads.values()) and scene.native_weights(STEP) is None
    assert {f"{a}.router_balance" for a in ("opacity", "cov", "color")} <= set(scene.network_tensors())


@pytest.mark.slow
def test_a_run_folder_is_read_where_nothing_else_named_the_part(tmp_path):
    train = to_json(RECIPES["moe-gs-balance"][1])
    write_json(tmp_path / "config.json", {"format": 1, "train": train, "data": {"path": "c"}, "type": "RunConfig"})
    code = "from pathlib import Path; from scene_experts.training.run_folder import read_config; "
    code += f"print(read_config(Path({str(tmp_path)!r})).train)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "BalancedExperts(" in done.stdout, done.stderr
