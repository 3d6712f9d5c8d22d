"""Runs on a Dask cluster: what a worker is sent and says, and three runs of which one loses its worker."""

import gc
import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import scene_experts
from scene_experts import cli
from scene_experts.core.errors import InputError
from scene_experts.reproduce import cluster as module
from scene_experts.reproduce import store
from scene_experts.reproduce.cluster import ClusterRunner, PlacedRun, make_task, threads, work
from scene_experts.reproduce.plan import OWN, CaptureSpec, Scale, Spec
from support.synthetic import make_capture
from support.trainings import assert_same, last_tensors

distributed = pytest.importorskip("distributed", reason="needs distributed: pip install 'scene-experts[cluster]'")


@pytest.fixture
def job(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "get_worker", lambda: SimpleNamespace(address="tcp://there:1"))
    for name in ("runs", "records", "box"):
        (tmp_path / name).mkdir()
    for name in ("runs", "records"):
        (tmp_path / name / ".token").touch()
    spec = Spec(CaptureSpec("box", OWN, tmp_path / "box"), "moe-gs", 0, Scale(iterations=10))
    return PlacedRun(spec, tmp_path / "runs", tmp_path / "records", ".token", "[1/1]", {})


def test_a_worker_without_the_package_says_so(job, monkeypatch):
    packed = distributed.protocol.pickle.dumps(make_task())
    for name in [name for name in sys.modules if name.partition(".")[0] == "scene_experts"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "scene_experts", None)
    kind, text = distributed.protocol.pickle.loads(packed)("1.2.3", b"")
    assert kind == "input" and "scene-experts 1.2.3" in text and "tcp://there:1" in text and "install" in text


def test_a_worker_with_another_version_says_so(job):
    kind, text = make_task()("0.0.0", b"")
    assert kind == "input" and "0.0.0" in text and scene_experts.__version__ in text and "tcp://there:1" in text


@pytest.mark.parametrize(("gone", "flag"), [("runs/.token", "--out"), ("records/.token", "--records"), ("box", "--captures")])
def test_a_worker_that_does_not_see_a_folder_says_so(job, tmp_path, gone, flag):
    (tmp_path / gone).rename(tmp_path / "elsewhere")
    kind, text = work(pickle.dumps(job))
    assert kind == "input" and str(tmp_path / gone.partition("/")[0]) in text and flag in text and "tcp://there:1" in text


def test_an_address_that_does_not_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CONNECT", 1.0)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        runner = ClusterRunner(tmp_path / "runs", tmp_path / "records", say=lambda _: None, address=address)
        spec = Spec(CaptureSpec("box", OWN, tmp_path), "moe-gs", 0, Scale(iterations=10))
        with pytest.raises(InputError, match=address):
            runner.run_all([spec])


def test_a_client_that_cannot_connect_is_closed_before_the_garbage_collector_comes(monkeypatch):
    """The collector may come while a thread holds the lock that closing takes, and then that thread waits for ever."""
    monkeypatch.setattr(module, "CONNECT", 1.0)
    clients = lambda: [thing for thing in gc.get_objects() if issubclass(type(thing), distributed.Client)]  # noqa: E731
    before = clients()
    gc.disable()
    try:
        for address in ("tcp://127.0.0.1:9", "nonsense://x"):
            with pytest.raises(InputError), module.connect(address):
                pass
        made = [client for client in clients() if client not in before]
    finally:
        gc.enable()
    assert {client.status for client in made} == {"closed"}


def test_without_distributed_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install .distributed"), module.connect("tcp://127.0.0.1:9"):
        pass


def test_threads_of_a_run():
    assert threads(8, {}, {}) == 1, "eight runs at a time"
    assert threads(8, {"GPU": 1}, {"GPU": 1}) == 8
    assert threads(8, {"GPU": 2.0}, {"GPU": 1}) == 4
    assert threads(1, {"GPU": 4}, {"GPU": 1}) == 1


def specs_of(capture: Path) -> list[Spec]:
    scene = CaptureSpec("box", OWN, capture)
    return [Spec(scene, recipe, 0, Scale(iterations=150)) for recipe in ("moe-gs", "3dgs")]


def kill_a_worker_half_way(specs: list[Spec], runs: Path, killed: list[int]) -> None:
    """Kill the worker process whose training is the first to have begun."""
    until = time.monotonic() + 500
    while time.monotonic() < until and not killed:
        for spec in specs:
            metrics = spec.folder(runs) / "metrics.jsonl"
            if metrics.is_file() and metrics.stat().st_size and not (spec.folder(runs) / "results.json").is_file():
                training = training_of(spec.folder(runs))
                if training is not None:
                    os.kill(training, signal.SIGKILL)
                    killed.append(training)
                    return
        time.sleep(0.02)


def training_of(folder: Path) -> int | None:
    """The process that started the training of a run folder."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"\0--out\0{folder}\0" in (process / "cmdline").read_text():
                return int((process / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    return None


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the worker of a training is found in /proc")
def test_runs_with_a_worker_killed_half_way_equal_local_ones(tmp_path):
    specs = specs_of(make_capture(tmp_path / "box", views=12, size=(48, 32), points=300).folder)
    said, killed = [], []
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "host": "127.0.0.1", "silence_logs": 50}
    with distributed.LocalCluster(**options, local_directory=str(tmp_path / "dask")) as workers:
        runner = ClusterRunner(tmp_path / "runs", tmp_path / "records", say=said.append, address=workers.scheduler_address)
        killer = threading.Thread(target=kill_a_worker_half_way, args=(specs, runner.runs, killed), daemon=True)
        limit = threading.Timer(500, runner.end)
        for thread in (killer, limit):
            thread.start()
        try:
            failures = runner.run_all(specs)
        finally:
            limit.cancel()
        killer.join(timeout=60)
    assert not failures and len(killed) == 1, said
    logs = [spec.folder(runner.runs).with_name(spec.folder(runner.runs).name + ".log").read_text() for spec in specs]
    assert sum(log.count("$ scene-experts train") for log in logs) == 3, "the killed run was started again"
    assert [path.name for path in runner.runs.glob(".cluster*")] == []
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for spec in specs:
            here = tmp_path / "local" / spec.recipe
            assert cli.main(spec.arguments(here)) == 0
            assert_same(last_tensors(spec.folder(runner.runs)), last_tensors(here))
        assert cli.main(["eval", str(here)]) == 0
        alone, placed = store.read_run(here, "box"), store.find(store.load(runner.records), spec)
        assert placed and all(placed.results[name] == round(alone.results[name], 6) for name in ("psnr", "ssim", "lpips"))
    finally:
        torch.set_num_threads(before)
