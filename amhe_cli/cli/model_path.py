"""MODEL on the command line: a path, a model of the menagerie, or that of a bundled example."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from amhe_cli.cli import log_path

if TYPE_CHECKING:
    from amhe_cli.system.model.urdf import UrdfOptions

#: What the name of a model of the menagerie begins with.
MENAGERIE = "menagerie:"


class ModelPath(click.Path):
    """An existing file, `menagerie:NAME`, or the model of a bundled `example:NAME`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Leave the names of menagerie models as they are; any other value is a path."""
        kind, colon, name = str(value).partition(":")
        if colon and kind == "example":
            from amhe_cli.core.bundled import bundled_models

            return log_path.example(self, name, bundled_models(), param, ctx)
        named = str(value).startswith(MENAGERIE)
        return str(value) if named else super().convert(value, param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Complete the names of menagerie models; any other path is completed by the shell."""
        if incomplete and incomplete.startswith(MENAGERIE[: len(incomplete)]):
            from amhe_cli.init.menagerie import menagerie_names

            names = (MENAGERIE + name for name in menagerie_names())
            return [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return super().shell_complete(ctx, param, incomplete)


def model_file(model: Path | str) -> Path:
    """The file of a model; one of the menagerie is downloaded."""
    from amhe_cli.init.menagerie import menagerie_model

    return menagerie_model(model.removeprefix(MENAGERIE)) if isinstance(model, str) else model


def urdf_options(path: Path, meshes: bool = True) -> UrdfOptions | None:
    """How a URDF is read, with the packages that the environment names; None: the file is none."""
    from amhe_cli.init.ros_packages import packages_in
    from amhe_cli.system.model.urdf import UrdfOptions, is_urdf

    return UrdfOptions(packages_in(os.environ), meshes) if is_urdf(path) else None
