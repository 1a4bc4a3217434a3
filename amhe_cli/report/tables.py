"""One table, for a page and for a terminal; on that, what is printed is shown, never obeyed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import rich.box
import rich.table
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from amhe_cli.core.errors import printable

#: Look of a column of numbers.
NUMBER = "number"
#: Look of the numbers that matter most.
STRONG = "number strong"
#: Look of verdicts: on a page a chip in the colour of the text up to a colon.
VERDICT = "judged"
#: Look of names of which a wide table shows repeats once; on a phone each row has its own.
ONCE = "once"
#: A look of sentences, which may take several lines of a terminal.
TEXT = "text"


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts.

    Args:
        head: Heading of each column.
        looks: CSS classes of each column; columns with the class 'number' are flush right.
        rows: One text for each column.
        remarks: A line below each row of a page; empty for none.
    """

    head: Sequence[str]
    looks: Sequence[str]
    rows: Sequence[Sequence[str]]
    remarks: Sequence[str] = ()

    def without(self, *names: str) -> Table:
        """The table without the columns of some headings."""
        kept = [i for i, name in enumerate(self.head) if name not in names]
        head, looks, *rows = ([row[i] for i in kept] for row in (self.head, self.looks, *self.rows))
        return Table(head, looks, rows, self.remarks)


def rich_table(table: Table, styles: Mapping[str, str] | None = None) -> rich.table.Table:
    """A table for a terminal that cuts no text; sentences may take several lines.

    Args:
        table: The table; its remarks are left out.
        styles: Text of a cell, up to a colon -> colour.
    """
    made = rich.table.Table(box=rich.box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    for name, look in zip(table.head, table.looks, strict=True):
        side = "right" if "number" in look else "left"
        made.add_column(name, justify=side, no_wrap=look != TEXT, overflow="fold")
    above: Sequence[str] = [""] * len(table.head)
    for row in table.rows:
        cells = (
            "" if (look, text) == (ONCE, old) else text
            for look, text, old in zip(table.looks, row, above, strict=True)
        )
        made.add_row(*(Text(text, style=(styles or {}).get(text.partition(":")[0], "")) for text in cells))
        above = row
    return made


class PlainConsole(Console):
    """A console that knows no markup and writes out control characters; its own colours stay.

    Args:
        more: Arguments of rich's Console.
    """

    def __init__(self, **more: Any) -> None:
        super().__init__(markup=False, highlight=False, **more)

    def print(self, *objects: Any, **more: Any) -> None:
        """Print; a table without sentences keeps its width: a terminal wraps its lines, and cuts no text."""
        terminal, ample = self.width, self.options.update(width=1000)
        for one in objects:
            if isinstance(one, rich.table.Table) and all(column.no_wrap for column in one.columns):
                self.width = max(self.width, self.measure(one, options=ample).maximum)
        super().print(*objects, **more)
        if self.width != terminal:
            self.width = terminal

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The pieces of what is printed."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text, keep="\n"), style, control)
