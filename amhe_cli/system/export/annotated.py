"""Model files in which some numbers are replaced, each with a comment of what it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

#: Key of a comment: the kind of element ('body', 'joint', 'actuator'), and its name.
Place = tuple[str, str]


def with_comments(text: str, comments: Mapping[Place, Sequence[str]]) -> str:
    """A model file, MJCF or URDF, with comments before elements; those of elements it lacks come first.

    Args:
        text: The file.
        comments: Lines for each element.
    """
    root = ElementTree.fromstring(
        text, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    )
    parents = {child: parent for parent in root.iter() for child in parent}
    left = dict(comments)
    for element, parent in list(parents.items()):
        place = _place(element, parent)
        for line in left.pop(place, ()) if place else ():
            parent.insert(list(parent).index(element), _comment(line))
    for place in reversed(list(left)):
        for line in reversed(left[place]):
            root.insert(0, _comment(f"{place[1]}: {line}"))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _place(element: Element, parent: Element) -> Place | None:
    name = element.get("name")
    if name is None or not isinstance(element.tag, str):
        return None
    if parent.tag == "actuator":
        return "actuator", name
    kind = {"link": "body", "freejoint": "joint"}.get(element.tag, element.tag)
    return (kind, name) if kind in ("body", "joint") else None


def _comment(text: str) -> Any:
    return ElementTree.Comment(f" {text.replace('--', '- -')} ")
