"""What to do about a message: the entries of docs/troubleshooting.md, each with the words that it is about.

An entry is a heading with an anchor; the comment below it, `<!-- anchor: words | words -->`, has what its
messages say; '...' stands for anything. So a message finds its entry, and `amhe help ANCHOR` prints it.
"""

from __future__ import annotations

import re
from functools import cache

from amhe_cli.core.bundled import bundled_root

_ENTRY = re.compile(r"^<!-- ([\w-]+): (.*) -->$", re.MULTILINE)
_ANCHOR = re.compile(r'^<a id="([\w-]+)"></a>\n', re.MULTILINE)


@cache
def _page() -> str:
    return (bundled_root() / "docs" / "troubleshooting.md").read_text(encoding="utf-8")


@cache
def _phrases() -> list[tuple[re.Pattern[str], str]]:
    """What messages say, and the anchor of their entry; the longest first."""
    found = [
        (phrase.strip(), anchor) for anchor, said in _ENTRY.findall(_page()) for phrase in said.split(" | ")
    ]
    found.sort(key=lambda pair: -len(pair[0]))
    return [(re.compile(re.escape(phrase).replace(r"\.\.\.", ".*")), anchor) for phrase, anchor in found]


def entry_of(message: str) -> str | None:
    """The anchor of the entry about a message; None: there is none."""
    return next((anchor for phrase, anchor in _phrases() if phrase.search(message)), None)


def entries() -> dict[str, str]:
    """Anchor -> the text of its entry, heading first, as Markdown."""
    parts = _ANCHOR.split(_page())
    texts = (re.split(r"\n## ", text)[0] for text in parts[2::2])
    return {
        anchor: _ENTRY.sub("", text).replace("\n\n\n", "\n\n").strip()
        for anchor, text in zip(parts[1::2], texts, strict=True)
    }
