"""Texts from files, for people: no character in them acts on a terminal or a page."""

from __future__ import annotations


def printable(text: str, keep: str = "") -> str:
    r"""A text with its invisible characters as escapes: ESC as '\x1b', a line feed as '\n'.

    Args:
        text: The text.
        keep: Invisible characters that stay.
    """
    odd = {c for c in set(text) if not c.isprintable() and c not in keep}
    return text.translate({ord(c): c.encode("unicode_escape").decode() for c in odd}) if odd else text
