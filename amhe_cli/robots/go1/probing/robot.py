"""A real Go1 to probe: how it is reached, and who lets it stand up and down again."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

from amhe_cli.live.recorder import Recorder
from amhe_cli.live.target import Target
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.link.open import WireOptions

#: Holds a target ready for as long as it is entered.
Attend = Callable[[Target, Recorder, History], AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class Go1OnLink:
    """A robot at the end of a wire.

    Args:
        wire: How it is reached.
        attend: Checks it and lets it stand up; whatever happens then, lets it down.
    """

    wire: WireOptions
    attend: Attend
