"""`amhe pool`: results of several runs as one belief."""

from __future__ import annotations

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, option
from amhe_cli.cli.kinds import FILE, NewFile
from amhe_cli.cli.session import Session


@command(
    "Do results of several runs agree? One belief of them.",
    argument("beliefs", FILE, nargs=-1, required=True, metavar="BELIEF..."),
    options.system_or("that of the first belief"),
    options.belief_anyway,
    option("-o --out", "File for the pooled belief.  [default: none; the table alone]", NewFile()),
    options.force("over FILE where it exists"),
)
def pool(session: Session, given: Given) -> None:
    """Compare each BELIEF, a belief.yaml, with the others, and make one of them if they agree.

    The runs are of one system and have logs of their own. Beliefs that contradict each other are refused,
    with the parameter and the pair that differ most. A first BELIEF in the folder that `amhe identify` wrote
    needs no --system.
    """
    from amhe_cli.api.pool import pool as pooled
    from amhe_cli.cli.viewed import system_of_result
    from amhe_cli.report.pool import pool_record, pool_table
    from amhe_cli.report.tables import rich_table

    given.refuse_existing(given.out)
    system = given.system or system_of_result(given.beliefs[0])
    found = pooled(given.beliefs, system=system, belief_anyway=given.belief_anyway)
    if given.out is not None:
        found.belief.save(given.out)
    agreed = found.agreement
    if session.gave(session.record(**pool_record(found.sources, found.belief, agreed, found.differences))):
        return
    console = session.console()
    console.print(rich_table(pool_table(found.sources, found.beliefs, found.belief, found.differences)))
    console.print(
        f"\nthe runs agree: chi-square {agreed.chi_square:.3g} of {agreed.freedom}, which noise exceeds in "
        f"{agreed.chance:.1%} of cases"
    )
    if given.out is not None:
        print(f"wrote {given.out}")
