"""`amhe pool`, `amhe export`: several beliefs as one, and a belief in a form that another tool takes."""

from __future__ import annotations

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, flag, option
from amhe_cli.cli.kinds import COUNT, FILE
from amhe_cli.cli.session import Session


@command(
    "Do results of several runs agree? One belief of them.",
    argument("beliefs", FILE, nargs=-1, required=True, metavar="BELIEF..."),
    options.system_or("that of the first belief"),
    options.belief_anyway,
    options.written("FILE", "File for the pooled belief.  [default: none; the table alone]"),
)
def pool(session: Session, given: Given) -> None:
    """Compare each BELIEF, a belief.yaml, with the others, and make one of them if they agree.

    The runs are of one system and have logs of their own. Beliefs that contradict each other are refused,
    with the parameter and the pair that differ most. A first BELIEF in the folder that `amhe identify` wrote
    needs no --system.
    """
    from amhe_cli.api.pool import pool as pooled
    from amhe_cli.cli.viewed import system_of_result
    from amhe_cli.report.comparison import pool_record, pool_table
    from amhe_cli.report.tables import rich_table

    given.refuse_existing()
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
        f"{100.0 * agreed.chance:.1f} % of cases"
    )
    if given.out is not None:
        print(f"wrote {given.out}")


#: Files that are named; those beyond are models of samples.
_SHOWN = 2


@command(
    "A belief for other tools: MJCF, URDF, trainings, arms' loads.",
    argument("belief", FILE, metavar="BELIEF"),
    option(
        "--to",
        "What to write; mjlab and isaaclab: randomisation ranges as a Python file, and the model; ur, franka "
        "and kuka: the load at --flange, as these arms take it.",
        ("mjcf", "urdf", "samples", "mjlab", "isaaclab", "xacro", "ur", "franka", "kuka"),
        required=True,
    ),
    options.system_or("that of the belief"),
    options.belief_anyway,
    option("--urdf", "For urdf and isaaclab: this URDF of the robot, with the values in it.", FILE),
    option("--flange BODY", "For ur, franka and kuka: this body and what hangs on it, in its axes."),
    option("--count", "Number of samples.", COUNT, default=100),
    flag("--models", "With samples: an MJCF of each, too."),
    options.seed,
    options.output,
)
def export(session: Session, given: Given) -> None:
    """Write what BELIEF says of a system in a form that another tool takes.

    BELIEF is a belief.yaml; in the folder that `amhe identify` wrote it needs no --system. Ranges of mjlab
    and Isaac Lab lose correlations; samples keep them.
    """
    from amhe_cli.api.export import export as write
    from amhe_cli.cli.viewed import system_of_result

    how = given.pick("belief_anyway", "urdf", "flange", "count", "models", "seed", "force")
    system = given.system or system_of_result(given.belief)
    files = write(given.belief, given.to, given.reserve(), system=system, **how)
    if session.gave(session.record(files=[str(file) for file in files])):
        return
    for file in files[:_SHOWN]:
        print(f"wrote {file}")
    if len(files) > _SHOWN:
        print(f"and {len(files) - _SHOWN} models beside them")
