import json

import pytest
import torch
from PIL import Image

from scene_experts.core.errors import RunError
from scene_experts.scene import Traits
from scene_experts.strategy import Edit
from scene_experts.training.events import Densified, Previewed, Started, Stepped
from scene_experts.training.record import Recorder
from support.messages import naming

TRAITS = Traits("anchors", "anchors")


def step(i: int) -> Stepped:
    return Stepped(i, {"l1": 0.5}, 20.0, 10, 8, 50, 0.6, 1.0, {"cov": [0.5, 0.5]})


def lines(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_metrics_previews_and_what_a_resumed_run_writes_again(tmp_path):
    with Recorder(tmp_path, False) as record:
        record(Started(0, 30, 10, TRAITS))
        for i in (10, 20, 30):
            record(step(i))
        record(Densified(30, Edit(5, 1, 14)))
        record(Previewed(30, 0, torch.tensor([[[0.0, 0.5, 1.0]]])))
    assert [v["step"] for v in lines(tmp_path)] == [10, 20, 30, 30] and lines(tmp_path)[-1]["grown"] == 5
    assert Image.open(tmp_path / "previews" / "000030.png").getpixel((0, 0)) == (0, 128, 255)
    with (tmp_path / "metrics.jsonl").open("ab") as stream:
        stream.write(b'{"step": 31, "cut o\n\0\xff\xfe')  # a killed process and a power failure leave such bytes
    with Recorder(tmp_path, False) as record:
        record(Started(20, 30, 10, TRAITS))
        record(step(30))
    assert [v["step"] for v in lines(tmp_path)] == [10, 20, 30]
    with Recorder(tmp_path, False) as record:
        record(Started(0, 30, 10, TRAITS))
    assert lines(tmp_path) == []


def test_tensorboard_files_appear_when_asked(tmp_path):
    pytest.importorskip("tensorboard")
    with Recorder(tmp_path, True) as record:
        record(Started(0, 30, 10, TRAITS))
        record(step(10))
    assert list((tmp_path / "tensorboard").glob("events.out.*"))


def test_tensorboard_hides_what_a_resumed_or_a_new_run_writes_again(tmp_path):
    loaded = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    shown = []
    for start, end in ((0, 30), (10, 40), (0, 20)):
        with Recorder(tmp_path, True) as record:
            record(Started(start, end, 10, TRAITS))
            for i in range(start + 10, end + 1, 10):
                record(step(i))
        board = loaded.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
        shown.append([event.step for event in board.Scalars("psnr/train")])
    assert shown == [[10, 20, 30], [10, 20, 30, 40], [10, 20]]


def test_a_folder_that_cannot_be_written_is_reported(tmp_path):
    with Recorder(tmp_path / "no" / "folder", False) as record, pytest.raises(RunError, match=naming("metrics.jsonl")):
        record(step(1))
