"""`amhe export`: a belief in a form that another tool takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from amhe_cli.cli import estimation_options, options, parsing
from amhe_cli.cli.session import Session

#: Files that are named; those beyond are models of samples.
_SHOWN = 2


@click.command(
    cls=parsing.Command, short_help="A belief for other tools: MJCF, URDF, samples, mjlab, Isaac Lab."
)
@click.argument("belief", type=parsing.EXISTING_FILE, metavar="BELIEF")
@click.option(
    "--to",
    type=click.Choice(("mjcf", "urdf", "samples", "mjlab", "isaaclab")),
    required=True,
    help="What to write; mjlab and isaaclab: randomisation ranges as a Python file, and the model.",
)
@options.system_or("that of the belief")
@estimation_options.belief_anyway
@click.option(
    "--urdf",
    type=parsing.EXISTING_FILE,
    metavar="FILE",
    help="For urdf and isaaclab: this URDF of the robot, with the values in it.",
)
@click.option(
    "--count",
    type=parsing.WholeNumber(min=1),
    metavar="N",
    default=100,
    show_default=True,
    help="Number of samples.",
)
@click.option("--models", is_flag=True, help="With samples: an MJCF of each, too.")
@options.seed
@options.out
@options.common
@click.pass_obj
def export(
    session: Session,
    belief: Path,
    to: str,
    system: str | None,
    out: options.Output,
    **how: Any,
) -> None:
    """Write what BELIEF says of a system in a form that another tool takes.

    BELIEF is a belief.yaml; in the folder that `amhe identify` wrote it needs no --system. Ranges of mjlab
    and Isaac Lab lose correlations; samples keep them.
    """
    from amhe_cli.api.export import export as write
    from amhe_cli.cli.viewed import system_of_result

    files = write(
        belief, to, out.reserve(), system=system or system_of_result(belief), force=out.force, **how
    )
    if session.json:
        session.print_json(session.record(files=[str(file) for file in files]))
        return
    for file in files[:_SHOWN]:
        print(f"wrote {file}")
    if len(files) > _SHOWN:
        print(f"and {len(files) - _SHOWN} models beside them")
