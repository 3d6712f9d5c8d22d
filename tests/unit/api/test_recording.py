"""A training into a folder writes everything that belongs there, and one without a folder writes nothing."""

from dataclasses import replace
from pathlib import Path

import pytest

from scene_experts.api import recording
from scene_experts.core.errors import InputError
from scene_experts.data.capture import Capture
from scene_experts.data.settings import Data
from scene_experts.files.anchors.sensitivity import FILE, kept
from scene_experts.render import choose
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Exported, Finished, Previewed, Saved, Started, Stopped
from scene_experts.training.job import Job
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture

CPU = choose("auto", "cpu")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Capture:
    return load(make_capture(tmp_path_factory.mktemp("capture"), views=9, size=(32, 24), points=200).folder)


def run_in(out: Path | None, capture: Capture, **settings) -> Job:
    cfg = replace(RECIPES["scaffold-gs"][1], iterations=4)
    return Job(RunConfig(cfg, Data(capture.root)), out, options=TrainOptions(preview_every=2, **settings))


def test_the_folder_is_complete_when_the_training_has_finished(tmp_path, capture):
    kinds = []
    for event in recording.train(run_in(tmp_path, capture), capture, CPU):
        kinds.append(type(event))
        if isinstance(event, Exported):
            assert event.path == tmp_path / "point_cloud" / "iteration_4" and event.step == 4 and not event.warnings
            assert "compact files" in event.notes[0] and len(event.notes) == 1
            with pytest.raises(InputError, match=naming(tmp_path)), run_folder.held(tmp_path):
                pass
    assert kinds[0] is Started and kinds[-2:] == [Exported, Finished] and {Previewed, Saved} < set(kinds)
    for name in ("config.json", "metrics.jsonl", "previews/000002.png", "point_cloud/iteration_4/point_cloud.ply", "cameras.json", FILE):
        assert (tmp_path / name).is_file(), name
    with run_folder.held(tmp_path):
        run = run_folder.open_run(tmp_path)
        assert run.step == 4 and kept(run) is not None


def test_a_complete_run_keeps_its_layout(tmp_path, capture):
    list(recording.train(run_in(tmp_path, capture), capture, CPU))
    layout = tmp_path / "point_cloud" / "iteration_4" / "point_cloud.ply"
    layout.write_bytes(b"mine")
    events = list(recording.train(run_in(tmp_path, capture, resume=True), capture, CPU))
    assert [type(event) for event in events] == [Started, Finished] and layout.read_bytes() == b"mine"
    left = layout.with_name(".color_mlp.pt.abc.part")
    for lost in (layout, layout.with_name("scene.json"), tmp_path / "cameras.json"):  # as if the process was killed before it was written
        lost.unlink()
        left.write_bytes(b"half")
        assert Exported in map(type, recording.train(run_in(tmp_path, capture, resume=True), capture, CPU)) and lost.is_file()
        assert not left.exists()


def test_a_run_that_has_ended_keeps_its_configuration(tmp_path, capture):
    list(recording.train(run_in(tmp_path, capture), capture, CPU))
    before = (tmp_path / "config.json").read_bytes()
    again = run_in(tmp_path, capture, resume=True)
    other = replace(again.config, stop_at=2, deterministic=True, command="another", versions={"torch": "0"})
    events = list(recording.train(replace(again, config=other), capture, CPU))
    assert [type(event) for event in events] == [Started, Finished] and events[-1].step == 4
    assert (tmp_path / "config.json").read_bytes() == before


def test_a_stopped_run_is_saved_and_has_no_layout_yet(tmp_path, capture):
    run = run_in(tmp_path, capture)
    events = []
    for event in recording.train(run, capture, CPU):
        events.append(event)
        if isinstance(event, Previewed):
            run.stop.append("enough")
    assert isinstance(events[-1], Stopped) and run_folder.open_run(tmp_path).step == 2 and not (tmp_path / "point_cloud").exists()


def test_nothing_is_written_without_a_folder_nor_before_the_first_event(tmp_path, capture, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kinds = [type(event) for event in recording.train(run_in(None, capture), capture, CPU)]
    recording.train(run_in(tmp_path / "run", capture), capture, CPU)
    assert kinds[0] is Started and kinds[-1] is Finished and Saved not in kinds and not list(tmp_path.iterdir())


def test_a_run_that_is_resumed_before_its_first_checkpoint_starts_from_the_scene_that_it_began_with(tmp_path, capture):
    list(recording.train(run_in(tmp_path / "first", capture), capture, CPU))
    longer = replace(RECIPES["scaffold-gs"][1], iterations=8)
    begun = RunConfig(longer, Data(capture.root), init_from=tmp_path / "first")
    run_folder.prepare(tmp_path / "second", begun, resume=False)  # and killed
    resumed = Job(replace(begun, init_from=None), tmp_path / "second", options=TrainOptions(resume=True))
    events = list(recording.train(resumed, capture, CPU))
    assert isinstance(events[0], Started) and events[0].step == 4
    assert run_folder.read_config(tmp_path / "second") == replace(begun, data=Data(capture.root.absolute()))


def test_a_stop_before_the_start_of_init_from_is_refused(tmp_path, capture):
    list(recording.train(run_in(tmp_path / "first", capture), capture, CPU))
    longer = replace(RECIPES["scaffold-gs"][1], iterations=8)
    begun = RunConfig(longer, Data(capture.root), stop_at=4, init_from=tmp_path / "first")
    with pytest.raises(InputError, match=naming("--stop-at", 4)):
        list(recording.train(Job(begun, tmp_path / "second"), capture, CPU))
    assert not (tmp_path / "second").exists()
