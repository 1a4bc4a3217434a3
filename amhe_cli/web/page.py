"""Templates of pages that need no network: everything they show, and every script they run, is in them."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from functools import cache
from hashlib import sha256
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from amhe_cli.core.errors import printable
from amhe_cli.core.files import plain


@cache
def template(name: str) -> Any:
    """A template of this room, of reports or of views."""
    environment = Environment(
        loader=ChoiceLoader(
            [
                PackageLoader("amhe_cli.web", "assets"),
                PackageLoader("amhe_cli.report"),
                PackageLoader("amhe_cli.view", "web"),
            ]
        ),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["digest"] = script_digest
    environment.filters["said"] = said
    environment.filters["whole"] = whole
    return environment.get_template(name)


def said(text: str | Markup) -> Markup:
    """A sentence as HTML: `words` between backticks are code."""
    if isinstance(text, Markup):
        return text
    parts = re.split(r"`([^`]+)`", printable(text, keep="\n"))
    code = Markup("<code>{}</code>").format
    return Markup("").join(code(whole(part)) if i % 2 else escape(part) for i, part in enumerate(parts))


def whole(text: str) -> Markup:
    """A command, or a name, as HTML: no line ends within `--an-option`."""
    parts = re.split(r"(?<!\S)(--?[a-z][\w.-]*)", printable(text, keep="\n"))
    kept = Markup('<span style="white-space:nowrap">{}</span>').format
    return Markup("").join(kept(part) if i % 2 else escape(part) for i, part in enumerate(parts))


def script_digest(script: str) -> str:
    """What a page's content security policy calls a script, so that the page runs no other."""
    return f"sha256-{b64encode(sha256(script.encode()).digest()).decode()}"


def _shown(value: object) -> object:
    """What stands in the page for a value: a text without control characters; what is HTML stays as it is."""
    return printable(value, keep="\n") if type(value) is str else value


def data(values: Any) -> Markup:
    """Values as JSON in a script element, which a '<' in them cannot end."""
    text = json.dumps(plain(values), allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))
