"""Checks of the arguments that several calls have."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path

from amhe_cli.core.errors import ConfigError


def checked(
    seed: int,
    threads: int | None,
    *,
    times: Mapping[str, float | None] | None = None,
    files: Mapping[str, str | Path | None] | None = None,
) -> tuple[int, int]:
    """Refuse wrong arguments before any work is done.

    Args:
        seed: Seed of the random numbers.
        threads: CPU threads; None: all cores.
        times: Argument -> time [s]; None: it was not given.
        files: Argument -> file that will be written; None: it was not given.

    Returns:
        Seed and number of threads.

    Raises:
        ConfigError: A value makes no sense, or a file cannot be written where it is to be.
    """
    for name, least, value in (("seed", 0, seed), ("threads", 1, threads)):
        if value is not None and not (isinstance(value, Integral) and value >= least):
            raise ConfigError(f"`{name}`: {value!r} is no whole number of {least} or more")
    for name, value in (times or {}).items():
        if value is not None and not (isinstance(value, Real) and 0.0 < value < math.inf):
            raise ConfigError(f"`{name}`: {value!r} is no positive number of seconds")
    for name, value in (files or {}).items():
        if value is None:
            continue
        if not Path(value).absolute().parent.is_dir():
            raise ConfigError(f"`{name}`: there is no folder '{Path(value).parent}'; make it first")
        if Path(value).is_dir():
            raise ConfigError(f"`{name}`: '{value}' is a folder; give the path of a file")
    return int(seed), cores() if threads is None else int(threads)


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
