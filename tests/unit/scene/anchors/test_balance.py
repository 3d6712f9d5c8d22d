"""Load balancing by biases: the rule of Wang et al. (2024) by hand, and its state. Such a part needs only two files."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import scene_experts
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.plain import to_json
from scene_experts.core.types import Mode
from scene_experts.scene.anchors.balance import Balanced, BalancedModule
from scene_experts.scene.anchors.experts import Experts, Mixture
from scene_experts.training.config import check
from scene_experts.training.recipes import RECIPES
from support.scenes import start_scene

SOURCE = Path(scene_experts.__file__).parent
STEP = 2000  # after the dense warm-up


def head(config: Experts, seed: int = 0) -> Mixture:
    torch.manual_seed(seed)
    made = config.build("color", 35, 16, 30, 32)
    assert isinstance(made, Mixture)
    return made


def test_the_part_touches_its_own_file_and_the_recipes_alone():
    own, names = (
        SOURCE / "scene" / "anchors" / "balance.py",
        ("Balanced(", "BalancedModule", "moe-gs-balance", "anchors.balance", "self.balance"),
    )
    naming = {p for p in SOURCE.rglob("*.py") if any(name in p.read_text() for name in names)}
    assert naming == {own, SOURCE / "training" / "recipes.py"}


def test_without_speed_it_is_the_mixture_of_the_paper_bit_for_bit():
    x, f = torch.randn(50, 35), torch.randn(50, 32)
    for step in (1, STEP):
        (a, ra), (b, rb) = (head(c)(x, f, step) for c in (Experts(), Experts(router=Balanced(speed=0.0))))
        assert torch.equal(a, b) and torch.equal(ra.gates, rb.gates) and (step == 1 or torch.equal(ra.chosen, rb.chosen))


def test_biases_choose_and_gates_weigh():
    made = head(Experts(router=Balanced(speed=0.0)))
    f = torch.randn(40, 32)
    with torch.no_grad():
        made.router.balance.copy_(torch.tensor([0.0, 0.0, 2.0, 0.0, 1.5]))  # beyond any gate: everyone takes experts 2 and 4
    routing, w = made.route(f, STEP, None)
    assert (routing.chosen == torch.tensor([2, 4])).all()
    gates = torch.softmax(made.router.logits(f, None), 1)
    assert torch.equal(routing.gates, gates)
    torch.testing.assert_close(w, gates[:, [2, 4]] / gates[:, [2, 4]].sum(1, keepdim=True))


def test_the_biases_follow_the_count_of_a_training_view():
    made = head(Experts(num=3, top_k=1, router=Balanced(speed=0.01)))
    balance = made.router.balance
    with torch.no_grad():
        made.router.w.zero_()
        made.router.b.copy_(torch.tensor([5.0, 0.0, 0.0]))
    f = torch.randn(6, 32)
    for step, mode in ((1, Mode.TRAIN), (STEP, Mode.DRAW)):  # nothing is chosen while dense; drawing counts nothing
        made.route(f, step, None, mode)
        made.end_batch(1)
        assert not balance.any()
    made.route(f, STEP, None, Mode.TRAIN)
    assert not balance.any()
    made.end_batch(1)
    assert balance.tolist() == pytest.approx([-0.01, 0.01, 0.01])  # counts 6, 0, 0; mean 2
    made.end_batch(1)
    assert balance.tolist() == pytest.approx([-0.01, 0.01, 0.01]) and balance.grad is None


def test_a_batch_moves_the_biases_once_by_the_counts_of_all_views():
    made, f = head(Experts(num=3, top_k=1, router=Balanced(speed=0.01))), torch.randn(40, 32)
    balance = made.router.balance
    chosen = [made.route(f[view * 10 : view * 10 + 10], STEP + view, None, Mode.TRAIN)[0].chosen for view in range(4)]
    assert balance.tolist() == [0, 0, 0]
    count = torch.bincount(torch.cat(chosen).reshape(-1), minlength=3).float()
    assert balance.grad.tolist() == count.tolist()  # the exchange of gradients adds up the counts of several processes
    balance.grad /= 4  # as it divides gradients
    made.end_batch(4)
    assert balance.tolist() == pytest.approx((0.02 * (count.mean() - count).sign()).tolist())  # 0.01 sqrt(4)


def test_a_collapsed_router_is_evened_out():
    made, f = head(Experts(router=Balanced(speed=0.002))), torch.randn(500, 32)
    with torch.no_grad():
        made.router.b[0] += 3.0
    share = lambda: torch.bincount(made.route(f, STEP, None)[0].chosen.reshape(-1), minlength=5) / 1000  # noqa: E731
    assert share()[0] > 0.45
    for i in range(600):
        made.route(f, STEP + 1 + i, None, Mode.TRAIN)
        made.end_batch(1)
    assert (share() - 0.2).abs().max() < 0.03


def test_the_recipe_and_its_flags():
    recipe = RECIPES["moe-gs-balance"][1]
    check(recipe)
    assert recipe.loss.load == 0 and recipe.loss.opacity == 0.01 and recipe.scene.decoder == Experts(router=Balanced())
    wrong = replace(recipe.scene, decoder=Experts(router=Balanced(speed=-1.0)))
    with pytest.raises(InputError, match=r"--scene\.decoder\.router\.speed"):
        check(replace(recipe, scene=wrong))


def test_the_scene_of_the_recipe_keeps_its_biases():
    scene = start_scene("moe-gs-balance")
    assert all(isinstance(h.router, BalancedModule) for h in scene.heads.values())
    assert {f"{a}.router_balance" for a in ("opacity", "cov", "color")} <= set(scene.network_tensors())


@pytest.mark.slow
def test_a_run_folder_is_read_where_nothing_else_named_the_part(tmp_path):
    train = to_json(RECIPES["moe-gs-balance"][1])
    write_json(tmp_path / "config.json", {"format": 1, "train": train, "data": {"path": "c"}, "type": "RunConfig"})
    code = "from pathlib import Path; from scene_experts.training.run_folder import read_config; "
    code += f"print(read_config(Path({str(tmp_path)!r})).train)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "Balanced(" in done.stdout, done.stderr
