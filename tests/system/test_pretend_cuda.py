"""The CUDA path without a GPU: tensors that pretend to be on CUDA (support/pretend). `make pretend` installs what it needs and runs it.

The tests show that devices do not mix, and what a step costs in kernels, waits and copies.
"""

import pytest

from scene_experts.recipes import RECIPES
from support.pretend.start import run

MOST = {"scaffold-gs": 150, "moe-gs": 250}  # kernels of a step
LOSS_ERROR = 1e-4  # relative, of ten steps
FAMILIES = ["scaffold-gs-bank", "moe-gs-balance", "octree-gs", "scene-experts", "3dgs", "3dgs-mcmc", "sags"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("guard")


def passed(found):
    assert not {word: result["error"] for word, result in found.items() if "error" in result}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("word", ["scaffold-gs:fused", "moe-gs:fused", "moe-gs:sparse"])
def test_a_step_is_lean(word, folder):
    (result,) = passed(run(folder, "train", word)).values()
    assert result["kernels"] <= MOST[word.partition(":")[0]], result["where"]
    assert sum(result["waits"].values()) <= 3 and not result["blocking"], (result["waits"], result["blocking"])
    assert result["edits"] > 0 and result["baked"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("recipe", FAMILIES)
def test_a_family_trains_is_saved_scored_and_baked(recipe, folder):
    (result,) = passed(run(folder, "train", f"{recipe}:composed")).values()
    assert sum(result["waits"].values()) <= 20 and not result["blocking"], (result["waits"], result["blocking"])


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["moe-gs", "3dgs"])
def test_losses_are_those_of_the_cpu(recipe, folder):
    (found,) = passed(run(folder, "train", f"{recipe}:compare")).values()
    assert found["cuda"][0] == pytest.approx(found["cpu"][0], rel=1e-4), "before any step of the optimiser"
    assert found["cuda"] == pytest.approx(found["cpu"], rel=LOSS_ERROR)


@pytest.mark.slow
def test_all_other_recipes(folder):
    others = [name for name in RECIPES if name not in (*FAMILIES, *MOST)]
    passed(run(folder, "train", *(f"{name}:composed" for name in others)))
