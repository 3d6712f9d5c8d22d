"""docs/python.md: every block runs, in order, on a shipped capture; smaller numbers stand for those of the page."""

import re

import pytest

import scene_experts as se
from support.places import DEMO, ROOT

PAGE = (ROOT / "docs" / "python.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
SMALLER = (  # what keeps the test short; it changes no call
    (r'resolution="longest:\d+"', 'resolution="longest:48", max_views=16'),
    (r"iterations=\d+", 'iterations=4, **{"scene.voxel_size": 0.2}'),
    (r'\*\*\{"scene.voxel_size": 0.2\}, \*\*\{', "**{"),
    (r"stop_at=\d+", "stop_at=6"),
    (r"preview_every=\d+", "preview_every=2"),
    (r"event.step >= \d+", "event.step >= 2"),
    (r"frames=\d+", "frames=2"),
    (r"refine=\d+", "refine=1"),
    (r"\b(0\.02|0\.04)\b(?=[,)])", "0.2"),
)


def smaller(code: str) -> str:
    for old, new in SMALLER:
        code = re.sub(old, new, code)
    return code


@pytest.mark.slow
def test_every_block_runs(tmp_path, monkeypatch, capsys):
    (tmp_path / "demo").symlink_to(DEMO)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for code in BLOCKS:
        try:
            exec(compile(smaller(code), "docs/python.md", "exec"), names)
        except Exception as error:
            pytest.fail(f"{error!r} in this block of docs/python.md:\n{smaller(code)}")
    said = capsys.readouterr().out
    assert len(BLOCKS) > 10 and "'moe-gs'" in said and "report.html" in said
    for made in ("runs/buddha/scene.compact", "runs/from_memory/config.json", "buddha.ply", "orbit/00001.png"):
        assert (tmp_path / made).is_file(), made


@pytest.mark.parametrize("name", [name for name in se.__all__ if name[0] != "_"])
def test_every_public_name_is_taught(name):
    assert re.search(rf"\b{name}\b", PAGE), f"docs/python.md does not name `{name}`"
