"""The CUDA path without a GPU: tensors that pretend to be on CUDA (support/pretend). `make pretend` installs what it needs and runs it.

The tests show that devices do not mix, that steps are those of the CPU, and what a step costs in kernels, waits, copies and bytes.
"""

from typing import NamedTuple

import pytest

from scene_experts.training.recipes import RECIPES
from support.pretend.start import run


class Most(NamedTuple):
    """Limits of a step without densification, a little above what is counted."""

    kernels: int
    waits: int
    bytes: float


LEAN = {
    "scaffold-gs:fused": Most(29, 3, 1.1e6),
    "scaffold-gs:sparse": Most(29, 3, 1.1e6),
    "moe-gs:fused": Most(37, 3, 4.7e6),
}
FAMILIES = {
    "scaffold-gs-bank:composed": Most(200, 3, 2.1e6),
    "scene-experts:fused": Most(40, 3, 3.6e6),  # with dropout and the displaced position
    "octree-gs:fused": Most(48, 4, 0.7e6),
    "moe-gs-balance:composed": Most(440, 12, 7.6e6),  # counts its experts on the host
    "3dgs:composed": Most(25, 2, 0.27e6),
    "3dgs-mcmc:composed": Most(97, 2, 0.16e6),
    "sags:composed": Most(117, 4, 63e6),
}
GROUPS = [list(LEAN)[:2], list(LEAN)[2:], *(list(FAMILIES)[i : i + 2] for i in range(0, len(FAMILIES), 2))]  # a process each
CLOSE = 1e-4  # relative, of losses and gradients
ROUNDING = 3.3e-6  # relative, of an alpha at 1/255 in float32: ten roundings of 6e-8 of its exponent, up to ln 255
PIXEL = 6e-7  # of a colour in [0, 1] in float32
DRAWN = {"picture": 1e-5, "depth": 1e-5, "gradients": 1e-4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("guard")


def passed(found):
    assert not {word: result["error"] for word, result in found.items() if "error" in result}
    return found


@pytest.mark.slow
@pytest.mark.parametrize("words", GROUPS, ids="+".join)
def test_a_recipe_trains_within_its_limits_and_is_saved_drawn_scored_and_baked(words, folder):
    for word, result in passed(run(folder, "train", *words)).items():
        most = (LEAN | FAMILIES)[word]
        assert result["kernels"] <= most.kernels, (word, result["where"])
        assert sum(result["waits"].values()) <= most.waits, (word, result["waits"])
        assert result["bytes"] <= most.bytes, (word, result["moved"])
        assert not result["blocking"], (word, result["blocking"])
        assert result["edits"] > 0 and result["baked"] > 0, word
        assert result["frozen"] is None or result["frozen"]["equal"], word
        assert result["frozen"] or word not in LEAN


@pytest.mark.slow
@pytest.mark.parametrize("recipes", [("scaffold-gs", "octree-gs", "3dgs"), ("moe-gs", "sags")], ids="+".join)
def test_each_step_is_that_of_the_cpu(recipes, folder):
    for recipe, found in passed(run(folder, "compare", *recipes)).items():
        assert len(found["losses"]) == 10 and max(*found["losses"], *found["gradients"]) < CLOSE, (recipe, found)


@pytest.mark.slow
def test_a_step_with_the_rate_is_that_of_the_cpu(folder):
    found = passed(run(folder, "compare", "scaffold-gs:rate"))["scaffold-gs:rate"]
    assert len(found["losses"]) == 10 and max(*found["losses"], *found["gradients"]) < CLOSE, found


@pytest.mark.slow
def test_a_step_differs_only_where_an_alpha_lies_on_its_threshold(folder):
    found = passed(run(folder, "compare", "moe-gs-e2-dense"))["moe-gs-e2-dense"]
    steps = list(zip(found["losses"], found["gradients"], found["close"]))
    clear = [max(loss, gradient) for loss, gradient, close in steps if close > ROUNDING]
    assert len(clear) >= 8 and max(clear) < CLOSE, found
    assert all(loss < CLOSE and gradient < 1e-2 for loss, gradient, _ in steps), found


@pytest.mark.slow
def test_steps_of_a_training_as_it_starts(folder):
    """A gradient differs only where a colour equals the photograph up to rounding, and in one step of octree-gs, where depths are equal."""
    for word, found in passed(run(folder, "compare", "sags:unchanged", "octree-gs:unchanged")).items():
        clear = [gradient for gradient, error in zip(found["gradients"], found["errors"]) if error > PIXEL]
        assert len(clear) >= 5 and sum(gradient > CLOSE for gradient in clear) <= (word == "octree-gs:unchanged"), (word, found)
        assert max(found["losses"]) < CLOSE and max(found["gradients"]) < 2e-2, (word, found)


@pytest.mark.slow
def test_ten_steps_on_their_own(folder):
    for word, found in passed(run(folder, "compare", "3dgs:alone", "sags:alone", "octree-gs:alone")).items():
        assert len(found["losses"]) == 10 and max(found["losses"]) < CLOSE, (word, found)


@pytest.mark.slow
def test_the_adapter_draws_as_the_reference(folder):
    cases = run(folder, "adapter")
    assert len(cases) == 6
    for name, found in cases.items():
        assert found["radii"] and found["finite"], name
        assert found["picture"] < DRAWN["picture"] and found["depth"] < DRAWN["depth"], (name, found)
        assert max(found["gradients"].values()) < DRAWN["gradients"], (name, found)


@pytest.mark.slow
def test_all_other_recipes(folder):
    tested = {word.partition(":")[0] for word in LEAN | FAMILIES}
    passed(run(folder, "train", *(f"{name}:composed" for name in RECIPES if name not in tested)))
