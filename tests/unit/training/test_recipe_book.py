"""Recipes of other packages: found by entry points, imported when needed, and used like our own."""

import json
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

from scene_experts.commands.train import parse_train
from scene_experts.core.errors import InputError
from scene_experts.core.schedule import Every
from scene_experts.core.types import Mode
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.training import recipe_book, run_folder
from scene_experts.training.config import RunConfig, check
from scene_experts.training.events import Densified, Finished, Stepped
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipe_book import GROUP, RecipeBook
from scene_experts.training.recipes import RECIPES, moe_gs
from support import outside
from support.captures import load
from support.synthetic import make_capture


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, GROUP)


def use(monkeypatch, *entries: EntryPoint) -> None:
    monkeypatch.setattr(recipe_book, "entry_points", lambda group: entries if group == GROUP else ())
    monkeypatch.setattr(RECIPES, "_others", None)


def test_our_own_recipes_need_no_import_of_others(monkeypatch):
    use(monkeypatch, entry("bad", "no_such_module:recipe"))
    assert RECIPES["moe-gs"][1] is moe_gs and "moe-gs" in RECIPES and RECIPES._others is None


def test_the_recipe_of_another_package_is_one_of_ours(monkeypatch):
    use(monkeypatch, entry("dots", "support.outside:dots"))
    text, cfg = RECIPES["dots"]
    assert cfg == outside.dots and "support.outside" in text and "dots" in RECIPES and list(RECIPES)[-1] == "dots"
    check(cfg)


def test_an_entry_may_offer_several_with_a_sentence_each(monkeypatch):
    several = {"a": ("the first", outside.dots), "b": ("the second", outside.dots)}
    monkeypatch.setattr(outside, "several", several, raising=False)
    use(monkeypatch, entry("whatever", "support.outside:several"))
    assert RECIPES["b"][0] == "the second" and RECIPES["b"][1].recipe == "b"


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (entry("bad", "no_such_module:recipe"), "no_such_module"),
        (entry("bad", "support.outside:DotScene"), "a Train value"),
        (entry("moe-gs", "support.outside:dots"), "already is a recipe"),
    ],
)
def test_a_package_that_cannot_be_used_gives_one_warning(monkeypatch, caplog, bad, said):
    use(monkeypatch, bad, entry("dots", "support.outside:dots"))
    assert "dots" in RECIPES and len(RECIPES) == len(set(RECIPES)) and RECIPES["moe-gs"][1] is moe_gs
    (record,) = caplog.records
    assert said in record.getMessage() and "\n" not in record.getMessage()


def test_an_error_of_another_package_has_its_place_and_meets_who_asks_for_the_recipe(monkeypatch, tmp_path):
    (tmp_path / "broken_package.py").write_text("x = 1\nraise KeyError('nothing')\n")
    monkeypatch.syspath_prepend(tmp_path)
    use(monkeypatch, entry("bad", "broken_package:recipe"))
    with pytest.raises(InputError, match=r"broken_package\.py:2"):
        parse_train(["bad", "--help"])


def test_it_has_flags_on_the_command_line(monkeypatch):
    use(monkeypatch, entry("dots", "support.outside:dots"))
    flags = ["--scene.size", "0.3", "--optimizer.momentum", "0.5", "--loss.small", "0.2", "--growth.adjust.interval", "7"]
    cfg = parse_train(["dots", "--data", "somewhere", "--out", "there", *flags, "--rates.rgb.first", "0.2"]).cfg
    assert cfg.scene == outside.Dots(size=0.3) and cfg.optimizer == outside.Momentum(0.5)
    assert cfg.loss == replace(outside.dots.loss, small=0.2) and cfg.growth.adjust.interval == 7 and cfg.rates.rgb.first == 0.2


def test_it_trains_resumes_and_opens(monkeypatch, tmp_path):
    folder, out = make_capture(tmp_path / "capture", views=8).folder, tmp_path / "run"
    cfg = replace(outside.dots, iterations=12, schedule=12, growth=outside.Halve(adjust=Every(0, 12, 5)))
    capture, draw, config = load(folder), choose("auto", "cpu"), RunConfig(cfg, Data(folder))
    run_folder.prepare(out, config, False)
    first = list(train(cfg, Job(replace(config, stop_at=6), out=out, options=TrainOptions(log_every=1, preview_every=0)), capture, draw))
    events = first + list(train(cfg, Job(config, out=out, options=TrainOptions(resume=True, log_every=1, preview_every=0)), capture, draw))
    steps = [e for e in events if isinstance(e, Stepped)]
    assert [e.step for e in steps] == list(range(1, 13)) and set(steps[0].terms) == {"l1", "dssim", "size"}
    assert [e.edit.grown - e.edit.pruned < 0 for e in events if isinstance(e, Densified)] == [True, True]
    assert isinstance(events[-1], Finished)
    opened = run_folder.open_run(out)
    assert opened.scene.traits.family == "dots" and opened.config.train == cfg
    whole = list(train(cfg, Job(config, out=tmp_path / "whole"), capture, draw))
    assert isinstance(whole[-1], Finished)
    other = run_folder.checkpoint.newest(tmp_path / "whole" / "checkpoints")[0]
    again = run_folder.checkpoint.newest(out / "checkpoints")[0]
    assert other.keys() == again.keys() and any(name.startswith("optimizer.rgb") for name in again)
    assert all(torch.equal(other[name], again[name]) for name in other)  # resumed: bit for bit, momentum and all
    image = draw(
        opened.scene(capture.views[0].camera, 12, Mode.DRAW, draw.visible).gaussians, capture.views[0].camera, torch.zeros(3)
    ).image
    assert image.isfinite().all()
    capture.images.close()


OPEN = """
import json, sys
from pathlib import Path
from scene_experts.training.run_folder import read_config
print(json.dumps([read_config(Path(sys.argv[1])).train.scene.size, "support.outside" in sys.modules]))
"""


@pytest.mark.slow
def test_a_run_of_another_package_is_opened_by_importing_it(tmp_path):
    """Another process, with a package that is really installed: a .dist-info folder on the path."""
    info = tmp_path / "site" / "dots-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dots\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\ndots = support.outside:dots\n")
    run_folder.prepare(tmp_path / "run", RunConfig(replace(outside.dots, scene=outside.Dots(0.7)), Data(Path("x"))), False)
    path = ":".join([str(tmp_path / "site"), *(p for p in sys.path if p)])
    done = subprocess.run(
        [sys.executable, "-c", OPEN, str(tmp_path / "run")], env={"PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    assert json.loads(done.stdout) == [0.7, True], done.stderr


def test_a_book_without_others_is_its_own(monkeypatch):
    monkeypatch.setattr(recipe_book, "entry_points", lambda group: ())
    book = RecipeBook({"a": ("text", outside.dots)})
    assert dict(book) == {"a": ("text", outside.dots)} and "b" not in book
