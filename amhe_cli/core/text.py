"""Texts from files, for people: no character in them acts on a terminal or a page."""

from __future__ import annotations

from base64 import b64encode
from hashlib import sha256


def printable(text: str, keep: str = "") -> str:
    r"""A text with its invisible characters as escapes: ESC as '\x1b', a line feed as '\n'.

    Args:
        text: The text.
        keep: Invisible characters that stay.
    """
    odd = {c for c in set(text) if not c.isprintable() and c not in keep}
    return text.translate({ord(c): c.encode("unicode_escape").decode() for c in odd}) if odd else text


def script_digest(script: str) -> str:
    """What a page's content security policy calls a script, so that the page runs no other."""
    return f"sha256-{b64encode(sha256(script.encode()).digest()).decode()}"
