"""`amhe pool`: results of several runs as one belief."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import estimation_options, options, parsing
from amhe_cli.cli.session import Session


@click.command(cls=parsing.Command, short_help="Do results of several runs agree? One belief of them.")
@click.argument("beliefs", nargs=-1, required=True, type=parsing.EXISTING_FILE, metavar="BELIEF...")
@options.system_or("that of the first belief")
@estimation_options.belief_anyway
@parsing.fresh_file("out", "-o", "--out", use="File for the pooled belief.  [default: none; the table alone]")
@options.common
@click.pass_obj
def pool(
    session: Session, beliefs: tuple[Path, ...], system: str | None, belief_anyway: bool, out: Path | None
) -> None:
    """Compare each BELIEF, a belief.yaml, with the others, and make one of them if they agree.

    The runs are of one system and have logs of their own. Beliefs that contradict each other are refused,
    with the parameter and the pair that differ most. A first BELIEF in the folder that `amhe identify` wrote
    needs no --system.
    """
    from amhe_cli.api.pool import pool as pooled
    from amhe_cli.cli.viewed import system_of_result
    from amhe_cli.report.pool import pool_record, pool_table
    from amhe_cli.report.tables import rich_table

    session.hush_mujoco()
    found = pooled(beliefs, system=system or system_of_result(beliefs[0]), belief_anyway=belief_anyway)
    if out is not None:
        found.belief.save(out)
    if session.json:
        session.print_json(
            session.record(**pool_record(found.sources, found.belief, found.agreement, found.differences))
        )
        return
    console, agreed = session.console(), found.agreement
    console.print(rich_table(pool_table(found.sources, found.beliefs, found.belief, found.differences)))
    console.print(
        f"\nthe runs agree: chi-square {agreed.chi_square:.3g} of {agreed.freedom}, which noise exceeds in "
        f"{agreed.chance:.1%} of cases"
    )
    if out is not None:
        print(f"wrote {out}")
