"""The runner: skips, resumes, fails one by one, stops."""

import signal
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.core.plain import to_json
from scene_experts.reproduce import runner as module
from scene_experts.reproduce import store
from scene_experts.reproduce.plan import OWN, CaptureSpec, Scale, Spec
from scene_experts.reproduce.runner import Runner, last_line, reason, visible_device
from scene_experts.training.config import RunConfig
from scene_experts.training.run_folder import held
from support.records import record


def spec(recipe="moe-gs", seed=0, scene="fox"):
    return Spec(CaptureSpec(scene, OWN, Path("captures") / scene), recipe, seed, Scale(iterations=3000))


class Fake(Runner):
    """Writes what the commands would; recipes in `broken` fail in training."""

    def call(self, args, slot, log):
        self.calls.append(args)  # type: ignore[attr-defined]
        if args[0] == "train":
            if args[1] in self.broken:  # type: ignore[attr-defined]
                log.write_text("starting\nerror: expected luck, found none; try again\n")
                return 1
            folder = Path(args[args.index("--out") + 1])
            made = spec(args[1], int(args[args.index("--seed") + 1]))
            write_json(folder / "config.json", {"format": 1, **to_json(RunConfig(made.train, made.data))})
            return 0
        folder = Path(args[1])
        write_json(folder / "results.json", record().results)
        write_json(folder / "per_view.json", record().per_view)
        return 0


@pytest.fixture
def runner(tmp_path):
    made = Fake(tmp_path / "runs", tmp_path / "records", say=lambda _: None)
    made.calls, made.broken = [], set()  # type: ignore[attr-defined]
    return made


def test_what_is_done_is_not_done_again(runner):
    assert runner.run_all([spec(), spec(seed=1)]) == [] and len(runner.calls) == 4
    assert runner.run_all([spec(), spec(seed=1), spec("scaffold-gs")]) == [] and len(runner.calls) == 6
    assert len(store.load(runner.records)) == 3


def test_several_workers_find_the_kernels_built(runner, monkeypatch):
    built = []
    monkeypatch.setattr(module, "build_kernels", lambda: built.append(len(runner.calls)))
    runner.run_all([spec()])
    assert built == [], "one worker builds them itself"
    runner.workers = 2
    runner.run_all([spec("scaffold-gs"), spec(seed=1)])
    assert built == [2], "once, before the first of the workers' commands"


def test_kernels_are_built_only_for_a_gpu(monkeypatch):
    calls = []
    monkeypatch.setattr(module.subprocess, "run", lambda command, **options: calls.append(command))
    for there in (False, True):
        monkeypatch.setattr(module.torch.cuda, "is_available", lambda there=there: there)
        module.build_kernels()
    assert len(calls) == 1 and "explain_missing" in calls[0][-1]


def test_one_failure_does_not_lose_the_rest(runner):
    runner.broken, runner.workers = {"moe-gs"}, 2
    failures = runner.run_all([spec(), spec("scaffold-gs")])
    assert [f.spec.recipe for f in failures] == ["moe-gs"] and "expected luck" in failures[0].why
    assert [r.recipe for r in store.load(runner.records)] == ["scaffold-gs"]
    assert "expected luck" in last_line(failures[0].log)


def test_a_process_that_a_signal_has_ended_is_told_apart_from_an_error(tmp_path):
    log = tmp_path / "run.log"
    assert reason(3, log) == "exit code 3"
    log.write_text("200/3,000  0:10 left\n\n")
    assert reason(1, log) == "200/3,000  0:10 left"
    killed = subprocess.run([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"], check=False).returncode
    assert all(word in reason(killed, log) for word in ("SIGKILL", "memory", "200/3,000"))
    assert "SIGTERM" in reason(-signal.SIGTERM, log) and "memory" not in reason(-signal.SIGTERM, log)


def test_a_picture_that_fails_does_not_lose_the_rest_either(runner):
    def after(made, folder):
        if made.recipe == "moe-gs":
            raise InputError("expected experts, found none")

    runner.after = after
    failures = runner.run_all([spec(), spec("scaffold-gs")])
    assert [(f.spec.recipe, f.why) for f in failures] == [("moe-gs", "expected experts, found none")]
    assert {r.recipe for r in store.load(runner.records)} == {"moe-gs", "scaffold-gs"}


def test_a_stop_between_training_and_scoring_leaves_both_for_the_next_time(runner):
    call = runner.call

    def stopping(args, slot, log):
        runner.stop.set()
        return call(args, slot, log)

    runner.call = stopping
    assert runner.run_all([spec()]) == [] and [args[0] for args in runner.calls] == ["train"] and store.load(runner.records) == []


def test_a_stop_while_a_run_is_being_started_reaches_it(tmp_path, monkeypatch):
    made = Runner(tmp_path, tmp_path)

    class Popen(subprocess.Popen):
        def __init__(self, args, **options):
            super().__init__(["sleep", "60"], **options)
            made.end()  # it is not yet among those that run

    monkeypatch.setattr(subprocess, "Popen", Popen)
    assert made.call(["train"], 0, tmp_path / "log") == -signal.SIGTERM


def test_a_run_without_a_whole_checkpoint_begins_anew(runner):
    folder = spec().folder(runner.runs)
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.json").write_text("torn")
    assert runner.run_all([spec()]) == [] and "--resume" not in runner.calls[0]


def test_a_run_that_another_process_is_at_is_left_alone(runner):
    folder = spec().folder(runner.runs)
    folder.mkdir(parents=True)
    (folder / "metrics.jsonl").write_text("the other's")
    with held(folder):
        (failure,) = runner.run_all([spec()])
    assert str(folder) in failure.why and (folder / "metrics.jsonl").read_text() == "the other's" and not runner.calls


def test_what_another_command_records_meanwhile_is_not_done_again(runner):
    runner.after = lambda made, folder: store.write(runner.records, record(seed=1))
    assert runner.run_all([spec(), spec(seed=1)]) == [] and len(runner.calls) == 2


@pytest.mark.parametrize("what", ["train", "eval"])
def test_a_run_that_another_command_trains_or_scores_is_left_alone(tmp_path, runner, what):
    other, failures = Fake(runner.runs, runner.records, say=lambda _: None), []
    other.calls, other.broken = [], set()  # type: ignore[attr-defined]
    call = runner.call

    def at_work(args, slot, log):
        if args[0] == what:
            failures.extend(other.run_all([spec()]))
        return call(args, slot, log)

    runner.call = at_work
    assert runner.run_all([spec()]) == [] and other.calls == []  # type: ignore[attr-defined]
    assert len(failures) == 1 and str(spec().folder(runner.runs)) in failures[0].why


def test_run_folders_go_when_asked_after_what_else_is_taken(runner):
    seen = []
    runner.discard, runner.after = True, lambda made, folder: seen.append((made.recipe, folder.is_dir()))
    runner.run_all([spec()])
    assert seen == [("moe-gs", True)] and not spec().folder(runner.runs).exists() and len(store.load(runner.records)) == 1


def test_nothing_begins_after_a_stop(runner):
    runner.end()
    assert runner.run_all([spec()]) == [] and runner.calls == []


def test_a_terminal_s_ctrl_c_reaches_a_run_once(tmp_path, monkeypatch):
    """A terminal signals the whole foreground group, and our own signal on top would end a training without saving it."""
    seen = {}

    class Popen(subprocess.Popen):
        def __init__(self, args, **options):
            seen.update(options)
            super().__init__(["true"], **options)

    monkeypatch.setattr(subprocess, "Popen", Popen)
    assert Runner(tmp_path, tmp_path).call(["train"], 0, tmp_path / "log") == 0 and seen["process_group"] == 0


def test_devices_are_among_those_of_a_scheduler(tmp_path, monkeypatch):
    assert visible_device("1", None) == "1"
    assert visible_device("1", "4,5") == "5"
    assert visible_device("GPU-8f", "4,5") == "GPU-8f"
    for visible in ("4,5", ""):
        with pytest.raises(InputError, match="--devices"):
            visible_device("2", visible)
    seen = {}

    class Popen(subprocess.Popen):
        def __init__(self, args, env, **options):
            seen.update(env)
            super().__init__(["true"], **options)

    monkeypatch.setattr(subprocess, "Popen", Popen)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    Runner(tmp_path, tmp_path).call(["train"], 0, tmp_path / "log")
    assert seen["CUDA_VISIBLE_DEVICES"] == "7", "without --devices, that of the scheduler"


def test_a_repeated_run_waits_for_the_training_of_a_lost_worker(runner):
    folder = spec().folder(runner.runs)
    runner.patience = 20.0
    with ExitStack() as stack:
        stack.enter_context(held(folder))
        threading.Timer(0.3, stack.close).start()
        assert runner.run_all([spec()]) == [] and len(runner.calls) == 2
