"""A log and what the model predicts, as one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amhe_cli.api.arguments import checked
from amhe_cli.core.belief import Belief
from amhe_cli.core.log import Log
from amhe_cli.core.shown import SavedView
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.system.system import System
from amhe_cli.view.open import view_of


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
    return SavedView(view_of(system, given, belief=known, threads=threads).page())
