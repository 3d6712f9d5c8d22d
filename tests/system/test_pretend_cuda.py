"""The CUDA path without a GPU: tensors that pretend to be on CUDA (support/pretend).

The tests show that devices do not mix, and what a step costs in kernels, waits and copies.

It needs gsplat and triton (`pip install 'scene-experts[cuda]'`), and no GPU. It measures no time and runs no CUDA code.
"""

import pytest

from scene_experts.recipes import RECIPES
from support.lanes import slow_except
from support.pretend.start import run

MOST = {"scaffold-gs": 150, "moe-gs": 250}  # kernels of a step


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("guard")


def passed(found):
    assert not {word: result["error"] for word, result in found.items() if "error" in result}
    return found


@pytest.mark.slow
def test_a_step_is_lean(folder):
    found = passed(run(folder, "train", "scaffold-gs:fused", "moe-gs:fused", "scaffold-gs:sparse"))
    for word, result in found.items():
        assert result["kernels"] <= MOST[word.partition(":")[0]], result["where"]
        assert sum(result["waits"].values()) <= 3 and not result["blocking"], (result["waits"], result["blocking"])
        assert result["edits"] > 0 and result["baked"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("recipe", slow_except(RECIPES))
def test_every_recipe_trains_is_saved_scored_and_baked(recipe, folder):
    passed(run(folder, "train", f"{recipe}:composed"))


@pytest.mark.slow
@pytest.mark.parametrize("recipe", slow_except(RECIPES))
def test_losses_are_those_of_the_cpu(recipe, folder):
    (found,) = passed(run(folder, "train", f"{recipe}:compare")).values()
    assert found["cuda"][0] == pytest.approx(found["cpu"][0], rel=1e-4), "before any step of the optimiser"
    assert found["cuda"] == pytest.approx(found["cpu"], rel=2e-3)
