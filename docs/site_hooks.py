"""Hooks of mkdocs: the README is the first page, and links out of docs/ lead to it or are plain text."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

README = Path(__file__).parents[1] / "README.md"

#: $$ ... $$ and $...$: equations in LaTeX, as GitHub renders them.
_DISPLAYED, _INLINE = re.compile(r"\$\$(.+?)\$\$", re.DOTALL), re.compile(r"(?<![\w`$])\$([^$\n]+)\$")
_KEPT = '<span style="white-space:nowrap">{}</span>'
_CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the README, whose links are relative to the folder above docs/, as the first page."""
    text = README.read_text(encoding="utf-8").replace("](docs/", "](../docs/")
    text = re.sub(r"\]\((?!\.\./|https?:|#)", "](../", text).replace("](../docs/", "](")
    files.append(File.generated(config, "index.md", content=text))
    return files


def on_page_content(html: str, **_: Any) -> str:
    """Lines of inline code do not end at a hyphen or within a name; options of blocks are whole, too."""
    html = re.sub(r"(?<!<pre>)<code>([^<]*)</code>", lambda m: f"<code>{_whole(m[1])}</code>", html)
    return re.sub(r"(?<=\s)--?\w[\w-]*(?=[^<>]*</code></pre>)", lambda m: _KEPT.format(m[0]), html)


def _whole(code: str) -> str:
    """Inline code as HTML: a short word stays whole, a long name may break at its marks."""

    def word(match: re.Match[str]) -> str:
        if "-" in match[0] and 2 <= len(match[0]) <= 24:
            return _KEPT.format(match[0])
        return re.sub(r"[/_.](?=\w)", r"\g<0><wbr>", match[0]) if len(match[0]) > 10 else match[0]

    return re.sub(r"\S+", word, code)


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links to the README lead to the first page, other files are named only, and equations are MathML."""
    up = "../" * (page.file.src_uri.count("/") + 1)  # out of docs/
    markdown = markdown.replace(f"]({up}README.md", f"]({up.removeprefix('../')}index.md")
    markdown = re.sub(rf"\[([^\]]*)\]\({re.escape(up)}[^)]*\)", r"\1", markdown)
    parts = _CODE.split(markdown)
    return "".join(part if part.startswith("`") else _with_equations(part) for part in parts)


def _with_equations(text: str) -> str:
    """A text without code, its equations as MathML, which browsers render without a script."""

    def shown(display: str, around: str = "{}") -> Callable[[re.Match[str]], str]:
        return lambda match: around.format(convert(match[1].strip(), display=display))

    block = shown("block", '<div class="equation">{}</div>')
    return _INLINE.sub(shown("inline"), _DISPLAYED.sub(block, text))
