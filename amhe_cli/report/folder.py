"""The folder that a command writes: refused early if it is not empty."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from tempfile import mkdtemp

from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import abandoned, filling, fresh, write_whole

logger = logging.getLogger(__name__)


class PageError(AmheError):
    """The page of results that are written cannot be made."""


def reserve(out: Path | None, command: str, force: bool) -> Path:
    """The folder to write to; refused before any work is done. Warns of what a killed command left there.

    Args:
        out: The folder that the user named; None: a new `amhe-out/<command>-<date>-<time>`.
        command: Name of the command.
        force: Whether a folder that is not empty may be written to; its other files stay.

    Raises:
        ConfigError: `out` is not empty and `force` is not given, or it is a file or cannot be written.
    """
    if out is None:
        out = fresh(Path("amhe-out") / f"{command}-{datetime.now():%Y%m%d-%H%M%S}")
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; `out` needs a folder")
    if out.exists() and not force and any(out.iterdir()):
        raise ConfigError(
            f"{out}: is not empty; choose another folder, or give `force=True` to write into it"
        )
    for left in abandoned(out):
        log = next(left.glob(".*.mcap.*.partial"), None)
        readable = f"; `amhe inspect {log}` reads the log in it" if log else ""
        logger.warning("%s is what an earlier command wrote before it was killed%s", left, readable)
    ancestor = next(path for path in (out, *out.absolute().parents) if path.exists())
    try:  # permissions do not tell whether a file system takes files
        Path(mkdtemp(dir=ancestor)).rmdir()
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); choose another `out`") from error
    return out


@contextmanager
def results(folder: Path, page: Callable[[], str], force: bool) -> Iterator[Path]:
    """Yield an empty folder for results; they and report.html then take the place of others, all or none.

    A fault of the page, or Ctrl-C while it is made, costs only the page: what was found is kept.

    Args:
        folder: Folder of the results; made if it does not exist.
        page: Makes the page.
        force: Write into a folder that is not empty.

    Raises:
        PageError: The page cannot be made.
    """
    fault: BaseException | None = None
    with filling(folder, force=force) as scratch:
        yield scratch
        try:
            write_page(scratch, page)
        except BaseException as error:
            fault = error
    if fault is not None:
        (folder / "report.html").unlink(missing_ok=True)  # that of other results
        if isinstance(fault, OSError) and fault.filename:
            fault.filename = str(folder / "report.html")
        raise fault


def write_page(folder: Path, page: Callable[[], str]) -> None:
    """Write report.html beside results that are written: a fault of the page must not cost them.

    Args:
        folder: Folder of the results.
        page: Makes the page.

    Raises:
        PageError: It cannot be made; the traceback is in the log, at level debug.
    """
    path = folder / "report.html"
    path.unlink(missing_ok=True)  # that of other results
    try:
        content = page()
    except Exception as fault:
        logger.debug("report.html", exc_info=True)
        raise PageError(
            f"report.html could not be made ({type(fault).__name__}: {fault}); the results beside it are "
            "complete. This is a bug in amhe: please report it"
        ) from fault
    write_whole(path, content)
