"""Hooks of mkdocs: the README is the first page, and links out of docs/ lead to it or are plain text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

README = Path(__file__).parents[1] / "README.md"
#: [text](../path) of a file that is not in docs/.
_OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./[^)]*\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the README, whose links are relative to the folder above docs/, as the first page."""
    text = README.read_text(encoding="utf-8").replace("](docs/", "](../docs/")
    text = re.sub(r"\]\((?!\.\./|https?:|#)", "](../", text).replace("](../docs/", "](")
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links to the README lead to the first page; the names of other files stand without a link."""
    return _OUTSIDE.sub(r"\1", markdown.replace("](../README.md", "](index.md"))
