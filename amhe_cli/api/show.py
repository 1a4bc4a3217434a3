"""A log and what the model predicts, as one page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amhe_cli.api.arguments import checked
from amhe_cli.core.files import write_whole
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Belief
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.system.system import System
from amhe_cli.view.open import page_of


@dataclass(frozen=True, slots=True)
class SavedView:
    """A page that needs no network; a notebook shows it as it is.

    Args:
        html: The page.
    """

    html: str

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all; returns its path."""
        write_whole(Path(path), self.html)
        return Path(path)

    def _repr_html_(self) -> str:
        """The page in a frame."""
        return (
            f'<iframe title="amhe view" style="width:100%;height:900px;border:0" '
            f'srcdoc="{html.escape(self.html)}"></iframe>'
        )

    def __repr__(self) -> str:
        return f"SavedView({len(self.html) / 1e6:.1f} MB)"


def show(
    system: System,
    logs: Log | Sequence[Log],
    belief: Belief | str | Path | None = None,
    *,
    belief_anyway: bool = False,
    threads: int | None = None,
) -> SavedView:
    """Show logs in three dimensions, with ghosts of what the model predicts from each clip's first state.

    Args:
        system: Model, parameters, signals and settings.
        logs: Logs that were read for this system.
        belief: A belief, or the path of a belief.yaml: its ghost is shown beside the nominal one.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.
        threads: CPU threads; None: all cores. The page does not depend on it.

    Raises:
        ConfigError: An argument is wrong.
        LogError: A log has no instant at which all of the state was measured.
    """
    hush_mujoco()
    _, threads = checked(0, threads)
    system, known = system.starting_from(belief, belief_anyway=belief_anyway)
    given = (logs,) if isinstance(logs, Log) else tuple(logs)
    return SavedView(page_of(system, given, belief=known, threads=threads))
