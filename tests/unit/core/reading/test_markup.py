"""XML without anything that grows or leads elsewhere."""

from pathlib import Path

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import POSES, Budget
from scene_experts.core.reading.markup import parse_xml
from scene_experts.core.reading.source import opening

LAUGHS = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;">]><a>&c;</a>'


def read(path: Path, data: bytes, budget: Budget = POSES):
    path.write_bytes(data)
    with opening(path, budget) as source:
        return parse_xml(source)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_elements_attributes_and_text(tmp_path: Path, encoding: str) -> None:
    root = read(tmp_path / "a.xml", '<a k="1"><b>x &amp; y</b><b/></a>'.encode(encoding))
    assert (root.tag, root.get("k"), [b.text for b in root]) == ("a", "1", ["x & y", None])


@pytest.mark.parametrize(
    "text",
    [
        LAUGHS,
        '<!DOCTYPE a SYSTEM "file:///etc/hostname"><a/>',
        '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]><a>&b;</a>',
        "<a>&b;</a>",
        "<a><b></a>",
        "<a/><b/>",
        "",
        "<a>" * 40 + "</a>" * 40,
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_what_is_refused(tmp_path: Path, text: str, encoding: str) -> None:
    with pytest.raises(InputError, match=r"a\.xml"):
        read(tmp_path / "a.xml", text.encode(encoding))


def test_the_budget_of_elements(tmp_path: Path) -> None:
    small = Budget("file of poses", 1 << 20, items=10)
    read(tmp_path / "a.xml", b"<a>" + b"<b/>" * 9 + b"</a>", small)
    with pytest.raises(InputError, match="elements"):
        read(tmp_path / "a.xml", b"<a>" + b"<b/>" * 10 + b"</a>", small)
