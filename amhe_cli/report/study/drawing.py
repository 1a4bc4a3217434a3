"""How figures of a study are made: in one style, and each as SVG for the page, PNG and PDF for elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from amhe_cli.core.floor import Floor
from amhe_cli.report.figures import INK, MUTED, Grid, styled, svg
from amhe_cli.report.page import Section

#: Colour of each mode, everywhere; a mode of another name is grey.
COLORS = {"true": INK, "baseline": "#d97706", "stale": "#b91c1c", "adaptive": "#2563eb"}
TRUTH, DEFAULT, PATH = "#15803d", "#15803d", "#94a3b8"
#: Height of the legend below the panels [inch].
_STRIP = 0.34


class StudyTask(Protocol):
    """Properties of a task that figures need."""

    @property
    def name(self) -> str:
        """Name of the task in the study's cells."""
        ...

    @property
    def title(self) -> str:
        """The task in a few words."""
        ...

    @property
    def floor(self) -> Floor:
        """Path and goal of the box."""
        ...


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure that is still to be drawn.

    Args:
        name: Name of its files.
        title: Title of the figure.
        caption: Caption: how to read it.
        draw: Function that draws it.
    """

    name: str
    title: str
    caption: str
    draw: Callable[[], Figure]


def drawn(drawings: Sequence[Drawing], folder: Path) -> list[Section]:
    """Draw figures, write each as PNG and PDF, and return them as sections of a page.

    Args:
        drawings: The figures to draw.
        folder: Folder of the files; made where there is something to draw.
    """
    sections = []
    for drawing in drawings:
        folder.mkdir(exist_ok=True)
        with styled(drawing.name):
            figure = drawing.draw()
            element = svg(figure)
            figure.savefig(
                folder / f"{drawing.name}.png", dpi=200, facecolor="white", metadata={"Software": None}
            )
            figure.savefig(folder / f"{drawing.name}.pdf", metadata={"CreationDate": None})
        sections.append(
            Section(drawing.title, drawing.caption, figure=element, natural=True, name=drawing.name)
        )
    return sections


def color_of(mode: str) -> str:
    """Colour of a mode."""
    return COLORS.get(mode, MUTED)


def room(grid: Grid) -> Figure:
    """A figure of the grid's cells, with a strip for the legend below them."""
    figure = grid.figure()
    figure.set_figheight(figure.get_figheight() + _STRIP)
    return figure


def legend(figure: Figure, modes: Sequence[str], *others: Line2D) -> None:
    """A legend for all panels, below them: modes by their colour, and other lines."""
    lines = [Line2D([], [], color=color_of(mode), linewidth=1.8, label=mode) for mode in modes]
    handles = [*lines, *others]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8.5, handlelength=1.8)


def line(label: str, color: str, style: Literal["--", ":"] = "--") -> Line2D:
    """An entry of a legend."""
    return Line2D([], [], color=color, linestyle=style, linewidth=1.3, label=label)
