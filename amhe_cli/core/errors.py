"""Every error a user can cause, as one line: what, where, what to do; texts of files do nothing in it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches


def printable(text: str, keep: str = "") -> str:
    r"""A text with its invisible characters as escapes: ESC as '\x1b', a line feed as '\n'.

    Args:
        keep: Invisible characters that stay.
    """
    odd = {c for c in set(text) if not c.isprintable() and c not in keep}
    return text.translate({ord(c): c.encode("unicode_escape").decode() for c in odd}) if odd else text


#: Level of a log message that users should see although nothing is wrong, between info and warning.
NOTE = 25


#: Names that an error lists: all words of a system.yaml, but not all bodies of a large model.
_LISTED = 60


class AmheError(Exception):
    """Base class of all expected errors; the command line prints its text and no traceback."""


class ConfigError(AmheError):
    """A setting, a system folder or an option is wrong."""


class LogError(AmheError):
    """A log exists but cannot be used."""


class EstimationError(AmheError):
    """The data were read, but no estimate could be made from them."""


class SimulationError(AmheError):
    """The simulator refused to run."""


class OperatorStopError(AmheError):
    """Whoever watches a robot has stopped it: no fault, and what was recorded is kept."""


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run or a probe ended; what it recorded is kept in any case.

    Args:
        interrupted: Whether the user stopped it.
        error: The error that ended it; None: there was none.
    """

    interrupted: bool = False
    error: Exception | None = None


def and_more(names: Sequence[str], most: int) -> str:
    """The first names, and how many more there are: 'a, b and 3 more', never 'and 1 more'."""
    if len(names) <= most + 1:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"


def one_of(kind: str, name: str, known: Iterable[str]) -> str:
    """Say that `name` is no known `kind`, and what would be: 'no joint 'hip'; ...'."""
    names = sorted(set(known))
    close = get_close_matches(str(name), names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    listed = and_more([*map(printable, names)], _LISTED) if names else f"no {kind} at all"
    return f"no {kind} {name!r}{hint}; there is: {listed}"
