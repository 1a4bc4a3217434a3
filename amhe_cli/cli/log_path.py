"""LOG on the command line: a path, a bundled example, or episodes of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem


class _LogPath(click.Path):
    """An existing path, or `example:NAME`; of a LeRobot dataset also some episodes: `dataset#3:10`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Find a bundled example, or the dataset where the path has the form of its episodes."""
        kind, colon, name = str(value).partition(":")
        if colon and kind == "example":
            return self._example(name, param, ctx)
        folder, mark, _ = str(value).rpartition("#")
        if mark and (Path(folder) / "meta" / "info.json").exists():
            return Path(value)
        return super().convert(value, param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete the names of examples; any other path is completed by the shell."""
        if incomplete and "example:".startswith(incomplete[:8]):
            from amhe_cli.core.bundled import bundled_logs

            names = (f"example:{name}" for name in bundled_logs())
            return [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return super().shell_complete(ctx, param, incomplete)

    def _example(self, name: str, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        from amhe_cli.core.bundled import bundled_logs

        return example(self, name, bundled_logs(), param, ctx)


def example(
    kind: click.ParamType,
    name: str,
    found: Mapping[str, Path],
    param: click.Parameter | None,
    ctx: click.Context | None,
) -> Path:
    """The bundled file of a name; a usage error where there is none."""
    from amhe_cli.core.errors import one_of

    if name not in found:
        kind.fail(one_of("example", name, found), param, ctx)
    return found[name]


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


#: A log that must exist (exit code 2 if not); whether it can be read is the reader's word (4).
LOG = _LogPath(exists=True, readable=False, path_type=Path)
