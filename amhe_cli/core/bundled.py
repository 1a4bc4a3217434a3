"""Where the logs and models that come with amhe are; quick to import, as completion needs it."""

from __future__ import annotations

from pathlib import Path

import amhe_cli
from amhe_cli.core.errors import ConfigError, one_of

#: What a name of a bundled log or model begins with.
EXAMPLE = "example:"


def bundled_root() -> Path:
    """Folder of `models`, `examples/logs` and `docs/troubleshooting.md`: in a wheel, or a checkout's top."""
    package = Path(amhe_cli.__file__).parent
    inside = package / "_bundled"
    return inside if inside.is_dir() else package.parent


def bundled_logs() -> dict[str, Path]:
    """Names and files of the logs that come with amhe."""
    return _examples(".mcap", ".csv")


def bundled_models() -> dict[str, Path]:
    """Names and files of the models that come with logs of their own, to try `amhe init` on."""
    return _examples(".xml")


def example(path: str | Path) -> Path:
    """The file of a bundled log, `example:NAME`; any other path as it is.

    Raises:
        ConfigError: There is no such log; the text lists all.
    """
    text = str(path)
    if not text.startswith(EXAMPLE):
        return Path(path)
    name, logs = text.removeprefix(EXAMPLE), bundled_logs()
    if name not in logs:
        raise ConfigError(one_of("example", name, logs))
    return logs[name]


def _examples(*suffixes: str) -> dict[str, Path]:
    files = sorted((bundled_root() / "examples" / "logs").iterdir())
    return {path.stem: path for path in files if path.suffix in suffixes}
