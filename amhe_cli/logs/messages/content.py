"""What the messages of one layout hold, for people: names, quantities, paths of numbers."""

from __future__ import annotations

import re

from amhe_cli.logs.messages.layout import Layout
from amhe_cli.logs.messages.types import TypeInfo

#: Paths of times, which are no measurements.
_TIMES = re.compile(r"(^|\.)(stamp|time_from_start)(\.|$)|(^|\.)header\.")


def entries(layout: Layout) -> list[str]:
    """Names of joints and child frames; '[n]' for an array of n numbers."""
    names = [*layout.names("name"), *layout.names("joint_names")]
    frames = [text for path, text in layout.strings.items() if path.split(".")[-1] == "child_frame_id"]
    data = layout.leaves.get("data")
    sizes = [f"[{data.count}]"] if data is not None and data.count is not None else []
    return [*names, *frames, *sizes]


def numbers(layout: Layout) -> dict[str, int | None]:
    """Paths of a layout's numbers, stamps left out -> their count where they are an array."""
    return {p: leaf.count for p, leaf in layout.leaves.items() if not _TIMES.search(p)}


def carried(layout: Layout, info: TypeInfo | None) -> list[str]:
    """Quantities with values in this layout; an empty array, such as an unmeasured effort, is absent."""
    if info is None:
        return []
    count = layout.counts.get(info.elements, 0) if info.elements else 1
    prefixes = [f"{info.elements}[{i}]." if info.elements else "" for i in range(count)]
    return [
        quantity
        for quantity, paths in info.fields.items()
        if any(layout.columns(prefix + paths[0]) for prefix in prefixes)
    ]
