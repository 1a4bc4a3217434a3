"""One table, for a page and for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rich.box
import rich.table
from rich.text import Text

#: Look of a column of numbers.
NUMBER = "number"
#: Look of the numbers that matter most.
STRONG = "number strong"
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
    for row in table.rows:
        made.add_row(*(Text(text, style=(styles or {}).get(text.partition(":")[0], "")) for text in row))
    return made
