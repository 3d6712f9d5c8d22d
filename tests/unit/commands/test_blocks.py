"""`scene-experts blocks`: its commands can be pasted, and its errors name what is wrong."""

import shlex

import pytest

from scene_experts import cli
from scene_experts.commands.train import parse_train
from scene_experts.scene.anchors.balance import Balanced
from scene_experts.scene.anchors.few_views import find_weight
from scene_experts.training.config import check
from support.captures import load
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return make_capture(tmp_path_factory.mktemp("plan") / "box", views=9, size=(48, 32), points=300).folder


def trainings(plan):
    return [line for line in (plan / "commands.sh").read_text().splitlines() if " train " in line]


def test_the_commands_of_a_plan_are_commands_of_train(capture, tmp_path, capsys):
    out = tmp_path / "my plan"
    given = ["--blocks", "3", "--recipe", "scaffold-gs", "--iterations", "900", "--background", "1", "1", "0.5"]
    given += ["--train=--seed 3", "--coarse-anchors", "500", "--max-memory", "4"]
    assert cli.main(["blocks", "plan", str(capture), "--out", str(out), *given, "--ignore-principal-point"]) == 0
    lines = (out / "commands.sh").read_text().splitlines()[2:]
    assert "\n".join(lines) in capsys.readouterr().out and len(lines) == 1 + 3 + 1 + 1
    words = [shlex.split(line) for line in lines]
    trains = [parse_train(line[2:]) for line in words if line[1] == "train"]
    assert [train.init_from for train in trains] == [None, *[out / "coarse"] * 3, out / "merged"]
    assert [train.cfg.iterations for train in trains] == [900, 900, 900, 900, 990] and trains[0].options.stop_at == 300
    assert all(train.cfg.seed == 3 for train in trains)
    assert [train.cfg.max_anchors for train in trains[:2]] == [500, 0] and [t.options.max_memory for t in trains] == [4, 4, 4, 4, 0]
    assert all(train.data.background == (1, 1, 0.5) and train.data.ignore_principal_point for train in trains)
    assert [train.data.views for train in trains[1:4]] == [out / f"block{number}.json" for number in range(3)]
    assert words[4][1:3] == ["blocks", "merge"]
    joint = trains[-1].cfg.rates  # the constant rates fall while the blocks are trained together
    assert joint.at("feature", 900, 990, 1.0) == pytest.approx(0.0075, rel=1e-3)
    assert joint.at("feature", 990, 990, 1.0) == pytest.approx(0.05 * 0.0075)


@pytest.mark.parametrize(("batch", "iterations", "joint"), [(1, 100, 110), (4, 100, 112), (50, 100, 150)])
def test_the_joint_training_ends_with_a_whole_batch(batch, iterations, joint, capture, tmp_path):
    given = ["--blocks", "2", "--iterations", str(iterations), f"--train=--batch {batch}"]
    assert cli.main(["blocks", "plan", str(capture), "--out", str(tmp_path / "plan"), *given]) == 0
    cfg = parse_train(shlex.split(trainings(tmp_path / "plan")[-1])[2:]).cfg
    assert cfg.iterations == joint
    check(cfg)


@pytest.mark.parametrize(("warmup", "until"), [(1500, 300), (15_000, 450)])
def test_the_coarse_training_outlasts_the_warm_up(capture, tmp_path, warmup, until):
    given = ["--blocks", "2", "--recipe", "scene-experts", "--iterations", "900", f"--train=--scene.decoder.warmup={warmup}"]
    assert cli.main(["blocks", "plan", str(capture), "--out", str(tmp_path / "plan"), *given]) == 0
    coarse = shlex.split((tmp_path / "plan/commands.sh").read_text().splitlines()[2])
    assert parse_train(coarse[2:]).options.stop_at == until


@pytest.mark.parametrize("options", ["scaffold-gs-bank", "moe-gs-balance", "scaffold-gs --train=--scene.appearance=8"])
def test_blocks_leave_what_all_anchors_share_as_it_is(options, capture, tmp_path):
    assert cli.main(["blocks", "plan", str(capture), "--out", str(tmp_path), "--recipe", *options.split()]) == 0
    cfg = parse_train(shlex.split(trainings(tmp_path)[1])[2:]).cfg
    loaded = load(capture)
    scene = cfg.scene.start(loaded.points, loaded.extent, [loaded.views[i].camera for i in loaded.train])
    loaded.images.close()
    rates = {name: cfg.rates.at(name, 1, 100, 1.0) for name in scene.rate_groups()}
    assert {name for name, rate in rates.items() if rate} == {"feature", "offsets", "log_scaling"}
    router = getattr(cfg.scene.decoder, "router", None)
    assert getattr(router, "speed", 0) == 0  # of the biases that balance the experts
    assert isinstance(router, Balanced) == options.startswith("moe-gs-balance")


@pytest.mark.parametrize(("few", "weight"), [(3, 0.0), (4, 0.25), (7, 1.0)])  # of 7 views
def test_blocks_have_the_dropout_and_the_jitter_of_a_training_of_all_views(few, weight, capture, tmp_path):
    recipe = ["--recipe", "scene-experts", f"--train=--scene.few-views={few} --scene.dropout 0.3"]
    assert cli.main(["blocks", "plan", str(capture), "--out", str(tmp_path), *recipe]) == 0
    coarse, block, *_, joint = (parse_train(shlex.split(line)[2:]).cfg.scene for line in trainings(tmp_path))
    kept = find_weight(block.few_views, 2)
    assert (block.dropout * kept, block.view_jitter * kept) == pytest.approx((0.3 * weight, 0.5 * weight))
    assert coarse.few_views == joint.few_views == few


def test_a_rate_of_the_networks_is_that_of_the_coarse_and_the_joint_training(capture, tmp_path):
    words = ["blocks", "plan", str(capture), "--out", str(tmp_path / "plan"), "--blocks", "2", "--train=--rates.networks 0.001"]
    assert cli.main(words) == 0
    lines = [line for line in (tmp_path / "plan" / "commands.sh").read_text().splitlines() if "--out" in line and "train" in line]
    assert [line.partition("--rates.networks ")[2].split()[0] for line in lines] == ["0.001", "0", "0", "0.001"]


def test_words_that_do_not_fit(capture, tmp_path, capsys):
    out = ["--out", str(tmp_path / "plan")]
    for words, found in (
        (["blocks"], "plan or merge"),
        (["blocks", "plans"], "'plan'"),
        (["blocks", "plan", str(capture), *out, "--recipe", "moegs"], "--recipe"),
        (["blocks", "plan", str(capture), *out, "--blocks", "0"], "--blocks"),
        (["blocks", "plan", str(capture), *out, "--views", "x.json"], "--views"),
        (["blocks", "plan", str(capture), *out, "--train=--seeed 3"], "seeed"),
        (["blocks", "plan", str(capture), *out, "--train=--seed -1"], "--seed from 0"),
        (["blocks", "plan", str(capture), *out, "--blocks", "0"], "--blocks of at least 1"),
        (["blocks", "plan", str(capture), *out, "--margin", "-1"], "--margin of at least 0"),
        (["blocks", "plan", str(capture), *out, "--iterations", "100", "--train=--batch 8"], "--batch 8 divides"),
        (["blocks", "plan", str(capture), *out, "--blocks", "300"], "same coordinate; give smaller --blocks"),
        (["blocks", "plan", str(capture), *out, "--train=--seed '3"], "--train"),
        (["blocks", "plan", str(capture), *out, "--train=--exposure"], "--exposure"),
        (["blocks", "plan", str(capture), *out, "--train=--stop-at 9"], "--stop-at, which it sets"),
        (["blocks", "plan", str(capture), *out, "--train=--init_from=x"], "which it sets"),
        (["blocks", "plan", str(capture), *out, "--train=--refine-poses"], "--refine-poses"),
        (["blocks", "plan", str(capture), *out, "--train=--resolution longest:40"], "--resolution"),
        (["blocks", "merge", str(tmp_path), *out, "--runs", str(tmp_path)], "plan.json"),
    ):
        assert cli.main(words) == 2 and found in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


def test_views_of_another_capture(capture, tmp_path, capsys):
    (tmp_path / "views.json").write_text('["elsewhere.png"]')
    assert cli.main(["info", str(capture), "--views", str(tmp_path / "views.json")]) == 2
    assert "elsewhere.png" in capsys.readouterr().err
