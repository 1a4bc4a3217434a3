"""The style of a study's figures, which matplotlib draws for papers and for the study's page."""

from __future__ import annotations

import io
import logging
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amhe_cli.core.errors import printable

logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its notes on its font cache are of no use to users

#: Colour of texts and of what is true.
INK = "#1e293b"
#: Colour of what stands back.
MUTED = "#64748b"
#: Colour of rules and grids.
RULE = "#e2e8f0"
#: Colour of what identified parameters predict.
IDENTIFIED = "#2563eb"
#: Colour of what initial parameters predict.
INITIAL = "#d97706"
#: Colours as in style.css.
FONTS = "Inter, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif"

#: Width of the page's figures [inch].
WIDTH = 10.4

#: Coordinates in paths.
_PATH = re.compile(r' d="[^"]*"')
#: Digits below a hundredth of a point, which are too small to see.
_DIGITS = re.compile(r"(\.\d\d)\d+")

_STYLE = {
    "path.simplify": False,  # it would drop lines without length
    "svg.fonttype": "none",  # text stays text: small files, and it can be searched
    "font.family": "DejaVu Sans",  # matplotlib brings it; the page says what is really used
    "font.size": 9.0,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#f1f5f9",
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "text.parse_math": False,  # a '$' in a name is a '$'
}


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of equal size over the width of the page; twice as fast as matplotlib's layout engine."""

    count: int
    across: int
    height: float  # of a cell [inch]

    def figure(self) -> Figure:
        """An empty figure with room for the cells."""
        return Figure(figsize=(WIDTH, self.height * -(-self.count // self.across)))

    def axes(self, figure: Figure, index: int, bottom: float = 0.42, top: float = 0.26) -> Axes:
        """Axes in one cell, `bottom` and `top` inches from its lower and upper edge."""
        row, column = divmod(index, self.across)
        total = figure.get_figheight()
        low = total - (row + 1) * self.height + bottom
        width = WIDTH / self.across
        box = (column * width + 0.55, low, width - 0.67, self.height - bottom - top)
        return figure.add_axes((box[0] / WIDTH, box[1] / total, box[2] / WIDTH, box[3] / total))


def styled(salt: str, **more: Any) -> AbstractContextManager[None]:
    """The style of a figure; `salt` makes the ids of figures on the same page differ."""
    style: Any = {**_STYLE, "svg.hashsalt": salt, **more}
    return matplotlib.rc_context(style)


def svg(figure: Figure) -> Markup:
    """A figure for the page, which sets its size."""
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    whole = printable(text.getvalue(), keep="\n")
    whole = whole[whole.index("<svg") :].replace("'DejaVu Sans'", FONTS)
    return Markup("<figure class=drawn>{}</figure>").format(
        Markup(_PATH.sub(lambda path: _DIGITS.sub(r"\1", path[0]), whole))
    )
