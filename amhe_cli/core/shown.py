"""How a value shows itself to people in a notebook: as HTML, made by a room that may draw."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amhe_cli.core.files import write_whole


@dataclass(frozen=True, slots=True)
class SavedView:
    """A page that needs no network; a notebook shows it as it is.

    Args:
        html: The page.
        height: Height of the frame in which a notebook shows it [px].
    """

    html: str
    height: int = 900

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all; returns its path."""
        write_whole(Path(path), self.html)
        return Path(path)

    def _repr_html_(self) -> str:
        """The page in a frame."""
        return (
            f'<iframe title="amhe" style="width:100%;height:{self.height}px;border:0" '
            f'srcdoc="{html.escape(self.html)}"></iframe>'
        )

    def __repr__(self) -> str:
        return f"SavedView({len(self.html) / 1e6:.1f} MB)"


class Displayed:
    """A value that a notebook shows as a page with tables and figures."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return page_of(self)._repr_html_()


Painter = Callable[[Displayed], SavedView]
#: Loads the painter; the package names it, as nothing below may know the room that draws.
_loaders: list[Callable[[], Painter]] = []


def painted_by(load: Callable[[], Painter]) -> None:
    """Say what loads the function that makes the page of a value."""
    _loaders[:] = [load]


def page_of(value: Displayed) -> SavedView:
    """The page of a value, as `_repr_html_` shows it."""
    return _loaders[0]()(value)
