"""Reads XML as plain elements: without document types and entities, within the budget's items and
depth."""

from __future__ import annotations

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.source import Source

_STEP = 1 << 16  # bytes parsed between two looks at the clock


def parse_xml(source: Source) -> Element:
    """Return the root element of an XML file. Raises Damaged for XML that is not well formed,
    declares a document type or entities, or has more or deeper elements than the budget allows."""
    parser, builder = expat.ParserCreate(), TreeBuilder()
    depth = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        source.items += 1 + len(attributes)
        if depth > source.budget.depth or source.items > source.budget.items:
            raise Damaged("more elements, or deeper ones, than a file of this kind has")
        builder.start(name, attributes)

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(name)

    def refuse(*_: object) -> None:
        raise Damaged("XML with a document type or entities, which is not read")

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = parser.UnparsedEntityDeclHandler = refuse
    data = source.read()
    try:
        for at in range(0, len(data), _STEP):
            parser.Parse(data[at : at + _STEP], False)
            source.check_time()
        parser.Parse(b"", True)
        return builder.close()
    except expat.ExpatError as error:
        raise Damaged(f"no well-formed XML ({error})") from None
