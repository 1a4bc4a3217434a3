"""`amhe export`: a belief in a form that another tool takes."""

from __future__ import annotations

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, flag, option
from amhe_cli.cli.kinds import COUNT, FILE
from amhe_cli.cli.session import Session

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
