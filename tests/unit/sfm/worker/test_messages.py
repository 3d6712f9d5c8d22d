"""Messages of the process that runs pycolmap."""

import json

from scene_experts.sfm.worker.messages import report


def test_a_message_is_a_line(capsys):
    report(step="unread", names=["a\nb.jpg"])
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line) == {"step": "unread", "names": ["a\nb.jpg"]}
