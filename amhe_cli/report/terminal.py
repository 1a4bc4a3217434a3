"""The terminal: what is printed on it is shown, never obeyed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from amhe_cli.core.text import printable


class PlainConsole(Console):
    """A console that knows no markup and writes out control characters; its own colours stay.

    Args:
        more: Arguments of rich's Console.
    """

    def __init__(self, **more: Any) -> None:
        super().__init__(markup=False, highlight=False, **more)

    def print_table(self, table: RenderableType) -> None:
        """Print a table at its own width: a narrow terminal wraps its lines, but no text is cut."""
        width = self.measure(table, options=self.options.update(width=1000)).maximum
        self.width = max(self.width, width)
        self.print(table)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The pieces of what is printed."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text, keep="\n"), style, control)
