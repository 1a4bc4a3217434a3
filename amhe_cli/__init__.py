"""amhe: physical parameters with honest uncertainty, from robot logs.

`import amhe_cli as amhe` gives the names below (docs/api.md). They are loaded on first use, so that
the command line starts at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amhe_cli.api.compare import compare
    from amhe_cli.api.estimator import Estimator
    from amhe_cli.api.export import export
    from amhe_cli.api.identify import Interrupted, Result, identify
    from amhe_cli.api.pool import pool
    from amhe_cli.api.repair import repair
    from amhe_cli.api.runs import probe, run, show
    from amhe_cli.core.belief import Belief
    from amhe_cli.core.errors import AmheError
    from amhe_cli.core.limits import limit
    from amhe_cli.core.log import Log
    from amhe_cli.estimation.online.horizon import Estimate
    from amhe_cli.logs.convert import convert
    from amhe_cli.logs.messages.writer import LogWriter
    from amhe_cli.logs.read import read_log
    from amhe_cli.system.system import System

__version__ = "0.1.0"

#: Public name -> the module that defines it.
_HOMES = {
    "AmheError": "amhe_cli.core.errors",
    "Belief": "amhe_cli.core.belief",
    "Estimate": "amhe_cli.estimation.online.horizon",
    "Estimator": "amhe_cli.api.estimator",
    "Interrupted": "amhe_cli.api.identify",
    "Log": "amhe_cli.core.log",
    "LogWriter": "amhe_cli.logs.messages.writer",
    "Result": "amhe_cli.api.identify",
    "System": "amhe_cli.system.system",
    "compare": "amhe_cli.api.compare",
    "convert": "amhe_cli.logs.convert",
    "export": "amhe_cli.api.export",
    "identify": "amhe_cli.api.identify",
    "limit": "amhe_cli.core.limits",
    "pool": "amhe_cli.api.pool",
    "probe": "amhe_cli.api.runs",
    "read_log": "amhe_cli.logs.read",
    "repair": "amhe_cli.api.repair",
    "run": "amhe_cli.api.runs",
    "show": "amhe_cli.api.runs",
}

__all__ = [
    "AmheError",
    "Belief",
    "Estimate",
    "Estimator",
    "Interrupted",
    "Log",
    "LogWriter",
    "Result",
    "System",
    "__version__",
    "compare",
    "convert",
    "export",
    "identify",
    "limit",
    "pool",
    "probe",
    "read_log",
    "repair",
    "run",
    "show",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    # the page of a value in a notebook: the room that draws it is loaded with the first
    displayed = import_module("amhe_cli.core.shown").Displayed
    displayed.painter = lambda value: import_module("amhe_cli.report.shown").shown(value)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
