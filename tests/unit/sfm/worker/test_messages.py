"""Messages of the process that runs pycolmap."""

from scene_experts.sfm.worker.messages import report


def test_a_message_is_a_line(capsys):
    report(step="unread", names=["a\nb.jpg"])
    assert capsys.readouterr().out == '{"step": "unread", "names": ["a\\\\nb.jpg"]}\n'.replace("\\\\", "\\")
