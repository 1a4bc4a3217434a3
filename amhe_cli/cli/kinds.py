"""What the value of an option may be: numbers, files, logs, models, pairs and lists."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

V = TypeVar("V")
#: What the name of a model of the menagerie begins with.
MENAGERIE = "menagerie:"
#: Suffixes of model files.
MODELS = (".xml", ".urdf", ".mjcf")


class Number(click.FloatRange):
    """A finite number; click would call it a float range, and let nan through.

    Args:
        metavar: What stands for it in the help: its unit, or its symbol.
        bounds: As of `click.FloatRange`.
    """

    name = "number"

    def __init__(self, metavar: str = "S", **bounds: Any) -> None:
        super().__init__(**bounds)
        self.metavar = metavar

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What stands for it in the help."""
        return self.metavar

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse what no comparison refuses."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class WholeNumber(click.IntRange):
    """A whole number; click would call it an integer range."""

    name = "whole number"

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What stands for it in the help."""
        return "N"


SECONDS = Number(min=0, min_open=True)
COUNT = WholeNumber(min=1)
PORT = WholeNumber(0, 65535)


class _Named(click.Path):
    """An existing path, or a name: `example:NAME` of a bundled file, `menagerie:NAME` of a model.

    Args:
        metavar: What stands for it in the help.
        bundled: Gives the bundled files by their names; None: there are none.
        menagerie: Whether it may be a model of the menagerie, whose name stays as it is.
        path: As of `click.Path`.
    """

    def __init__(
        self,
        metavar: str,
        bundled: Callable[[], Mapping[str, Path]] | None = None,
        menagerie: bool = False,
        **path: Any,
    ) -> None:
        super().__init__(**({"exists": True, "readable": False, "path_type": Path} | path))
        self.metavar, self._bundled, self._menagerie = metavar, bundled, menagerie

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What stands for it in the help."""
        return self.metavar

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Find a bundled example, or a LeRobot dataset where the path names its episodes: `dataset#3:10`."""
        kind, colon, name = str(value).partition(":")
        if colon and kind == "example" and self._bundled:
            from amhe_cli.core.errors import one_of

            if name not in (found := self._bundled()):
                self.fail(one_of("example", name, found), param, ctx)
            return found[name]
        if self._menagerie and str(value).startswith(MENAGERIE):
            return str(value)
        folder, mark, _ = str(value).rpartition("#")
        if mark and (Path(folder) / "meta" / "info.json").exists():
            return Path(value)
        return super().convert(value, param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete names; a path is completed by the shell."""
        names: Iterable[str] = ()
        if incomplete and self._bundled and "example:".startswith(incomplete[:8]):
            names = (f"example:{name}" for name in self._bundled())
        elif incomplete and self._menagerie and incomplete.startswith(MENAGERIE[: len(incomplete)]):
            from amhe_cli.init.sources import menagerie_names

            names = (MENAGERIE + name for name in menagerie_names())
        found = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return found or super().shell_complete(ctx, param, incomplete)


def _logs() -> Mapping[str, Path]:
    from amhe_cli.core.bundled import bundled_logs

    return bundled_logs()


def _models() -> Mapping[str, Path]:
    from amhe_cli.core.bundled import bundled_models

    return bundled_models()


FILE = _Named("FILE", dir_okay=False)
FOLDER = _Named("DIR", file_okay=False)
#: A log that must exist (exit code 2 if not); whether it can be read is the reader's word (4).
LOG = _Named("LOG", _logs)
MODEL = _Named("MODEL", _models, menagerie=True, dir_okay=False)
#: A model, or the folder of a result.
MODEL_OR_RESULT = _Named("MODEL", _models, menagerie=True)


class _LogOrModel(_Named):
    """A log, or another model."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """A name of the menagerie and the path of a model stay; any other value is a log."""
        return (MODEL if is_model(value) else LOG).convert(value, param, ctx)


LOG_OR_MODEL = _LogOrModel("LOG")


def is_model(value: object) -> bool:
    """Whether a value is the name or path of a model."""
    return str(value).startswith(MENAGERIE) or str(value).endswith(MODELS)


class NewFile(_Named):
    """A file that will be written, in a folder that exists."""

    def __init__(self, metavar: str = "FILE") -> None:
        super().__init__(metavar, dir_okay=False, exists=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse it now, not after the first minutes of work."""
        path: Path = super().convert(value, param, ctx)
        if not path.absolute().parent.is_dir():
            self.fail(f"there is no folder '{path.parent}'", param, ctx)
        if (self.metavar or "").endswith(".json") and path.suffix != ".json":
            self.fail(f"'{path}' does not end in .json, and there is no page of this", param, ctx)
        return path


def episodes(ctx: click.Context, param: click.Parameter, paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """The logs with each LeRobot dataset replaced by its episodes, unless the line is only parsed."""
    return paths if ctx.resilient_parsing else each_episode(paths)


def each_episode(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The logs with each LeRobot dataset replaced by its episodes."""
    if not any("#" in str(path) or (path / "meta" / "info.json").exists() for path in paths):
        return tuple(paths)
    from amhe_cli.logs import episode_paths

    return tuple(one for path in paths for one in episode_paths(path))


def one_episode(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    """A single log: of a LeRobot dataset, one episode; a data set file of one log."""
    if path is None or ctx.resilient_parsing:
        return path
    first, *more = each_episode([path])
    if more:
        raise click.BadParameter(f"{path} holds several episodes; name one, such as {first}", ctx, param)
    if first.suffix in (".yaml", ".yml"):
        from amhe_cli.logs import only_member

        only_member(first)
    return first


def pairs(
    kind: Callable[[str], V],
) -> Callable[[click.Context, click.Parameter, Sequence[str]], dict[str, V]]:
    """A callback that makes a dictionary of SIGNAL=/name or the like; the option's metavar shows the form.

    Args:
        kind: Makes a value of its text, or raises ValueError.
    """

    def gathered(ctx: click.Context, param: click.Parameter, given: Sequence[str]) -> dict[str, V]:
        form = str(param.metavar)  # pyright: ignore[reportAttributeAccessIssue]
        values: dict[str, V] = {}
        for text in given:
            key, _, value = text.partition("=")
            if (key := key.strip()) in values:
                raise click.BadParameter(f"{key} is given twice; leave one of them out", ctx, param)
            try:
                if not (key and value):
                    raise ValueError
                values[key] = kind(value)
            except ValueError:
                raise click.BadParameter(f"{text!r} is not of the form {form}", ctx, param) from None
        return values

    return gathered


def listed(ctx: click.Context, param: click.Parameter, given: str | Sequence[str] | None) -> tuple[str, ...]:
    """NAME,NAME, perhaps repeated, as a tuple; each once."""
    texts = [given] if isinstance(given, str) else given or ()
    parts = [name.strip() for text in texts for name in text.split(",")]
    return tuple(dict.fromkeys(name for name in parts if name))
