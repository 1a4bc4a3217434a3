"""How a value shows itself to people in a notebook: as HTML, made by a room that may draw."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

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
    #: Makes the page of a value. The package sets it, as nothing below may know the room that draws.
    painter: ClassVar[Callable[[Displayed], SavedView]]

    def plot(self) -> SavedView:
        """The value as a page of tables and figures; a notebook shows it."""
        return Displayed.painter(self)

    def _repr_html_(self) -> str:
        return self.plot()._repr_html_()
