"""`amhe init`, `amhe drives`: a first system folder from a model and logs, and the library of drives."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, flag, in_panel, option
from amhe_cli.cli.kinds import MODEL, Number, pairs
from amhe_cli.cli.session import Session
from amhe_cli.core.errors import printable

if TYPE_CHECKING:
    from amhe_cli.init.signals import Guess
    from amhe_cli.system.system import System


#: Columns of what is printed.
_HEAD = ("name", "from", "prior", "why")


@command(
    "A model and logs to a first system folder.",
    argument("model", MODEL),
    options.logs,
    option(
        "-o --out --system DIR",
        "The system folder to write.  [default: amhe-out/init-<date>-<time>/]",
        click.Path(path_type=Path),
    ),
    options.force("into an existing DIR that is not empty"),
    *in_panel(
        "Unknowns",
        flag(
            "--actuators",
            "Make the drives the unknowns: armature, viscous and dry friction and the encoder's zero of each "
            "measured joint, and one delay of the commands.",
        ),
        flag(
            "--group",
            "With --actuators: equal drives (left and right, or of one class, with the same numbers) share "
            "their parameters.",
        ),
        flag(
            "--gains",
            "With --actuators: gain, velocity gain, force limit and filter of each servo are unknown, too.",
        ),
        option(
            "--backlash JOINT ...",
            "Put a free gap of unknown width between this joint and its drive: a name or a pattern, '*' for "
            "all; repeat for more.",
        ),
        option(
            "--elastic JOINT ...",
            "Make the drive of this joint elastic, as harmonic drives are, of unknown stiffness.",
        ),
    ),
    *in_panel(
        "Drives of known make",
        option(
            "drives --drive JOINT=MAKER:TYPE ...",
            "Take gain, limit and armature of this joint's drive, or those of a pattern, from the library "
            "(`amhe drives`); repeat for more.",
            callback=pairs(str),
        ),
        option("--volts", "Supply of these drives.  [default: the data sheet's]", Number("V", min=0.1)),
        option(
            "--gain-p",
            "Their position gain, in the drive's own unit.  [default: that in a column of the log]",
            Number("P", min=0, min_open=True),
        ),
    ),
    *in_panel(
        "Files",
        option(
            "packages --package NAME=DIR ...",
            "Folder of a ROS package that a URDF's meshes lie in; repeat for more.  [default: "
            "ROS_PACKAGE_PATH, AMENT_PREFIX_PATH, and the folders above the URDF]",
            callback=pairs(str),
        ),
        flag(
            "--no-meshes",
            "Leave out the meshes of a URDF; boxes of the same mass and inertia take their place.",
        ),
    ),
    options.msg_path,
)
def init(session: Session, given: Given) -> None:
    """Write a system folder for MODEL whose signals are found in LOG...

    MODEL is an MJCF or URDF file, or menagerie:NAME for a model of the package mujoco-menagerie.
    To try it: amhe init example:arm example:arm --actuators -o arm/

    Its system.yaml is commented: the signals matched to joints by name, candidate parameters, and what
    was guessed. Read it, correct it, then: amhe identify LOG --system DIR.
    """
    from amhe_cli.cli.inputs import model_file, urdf_options
    from amhe_cli.cli.logs import looked_at
    from amhe_cli.init.drive_library import Chosen
    from amhe_cli.init.folder import init_system
    from amhe_cli.logs import inspect_log, members
    from amhe_cli.report.folder import reserve
    from amhe_cli.report.tables import TEXT, Table, rich_table
    from amhe_cli.system.system import System

    drives, volts, gain_p, msg_path = given.drives, given.volts, given.gain_p, given.msg_path
    if not drives and (volts is not None or gain_p is not None):
        raise click.UsageError("--volts and --gain-p belong to --drive")
    path = model_file(given.model)
    folder = reserve(given.out, "init", given.force)
    made = init_system(
        path,
        given.logs,
        folder,
        urdf=urdf_options(path, not given.no_meshes, given.packages),
        drives=Chosen(drives, volts, gain_p) if drives else None,
        **given.pick("msg_path", "force", "actuators", "group", "gains", "backlash", "elastic"),
    )
    system = System.load(folder, warn=False)
    for log in (one.path for path in given.logs for one in members(path, system)):
        remarks = looked_at(inspect_log(log, system, msg_path=msg_path), system).remarks
        made.notes += [f"{log}: {remark}" for remark in remarks]
    rows = [[one.name, one.source, _prior(one, system), one.why] for one in (*made.guesses, *made.parameters)]
    record = [dict(zip(_HEAD, row, strict=True)) for row in rows]
    if session.gave(session.record(system=str(folder), guessed=made.sentences, table=record)):
        return
    session.console().print(rich_table(Table(_HEAD, ("", "", "", TEXT), rows), {"guess": "yellow"}))
    for sentence in made.notes:
        print(printable(sentence))
    print(f"wrote {folder}/system.yaml: read it, correct it, then: amhe identify LOG --system {folder}")


def _prior(guess: Guess, system: System) -> str:
    """What is believed before the log is read: of a parameter its range, of a signal its noise."""
    if "targets" not in guess.entry:
        return ", ".join(f"{quantity} ± {sd:.2g}" for quantity, sd in guess.noise.items() if sd is not None)
    if guess.name in system.fixed:
        return f"{system.fixed[guess.name]:.4g}, fixed"
    found = [one for one in system.space.parameters if one.name == guess.name]
    if not found:
        return f"{len([n for n in system.space.names if n.startswith(f'{guess.name}.')])} numbers"
    one = found[0]
    return f"{one.nominal:.4g} {f'×/÷ {math.exp(one.prior_sd):.3g}' if one.log else f'± {one.prior_sd:.2g}'}"


_HEADS = (
    "drive", "gear", "V", "torque, N m", "kp, N m/rad", "kv, N m s/rad", "armature, kg m^2", "gain in",
)  # fmt: skip


@command(
    "The library of drives: data sheets and firmware gains.",
    argument("name", required=False, metavar="[NAME]"),
    option("--volts", "Supply.  [default: that of the data sheet]", Number("V", min=0.1)),
    option("--gain-p", "Position gain, in the drive's own unit.", Number("P", min=0.0, min_open=True)),
    simulates=False,
)
def drives(session: Session, given: Given) -> None:
    """List the drives that `amhe init --drive` knows, or say what one is at a supply and a gain.

    NAME is maker:type. A part of it lists the drives with it. The numbers are public; each drive names their
    sources.
    """
    from amhe_cli.init.drive_library import drive, library
    from amhe_cli.report.tables import NUMBER, Table, rich_table

    name, volts, gain_p = given.name, given.volts, given.gain_p
    some = {key: one for key, one in library().items() if (name or "").lower() in key}
    if name in library() or not some:
        some = {name: drive(str(name), volts)}
    elif volts is not None or gain_p is not None:
        raise click.UsageError("--volts and --gain-p are for one drive: give its whole NAME")
    servos = {key: one.servo(volts, gain_p) for key, one in some.items()}
    listed = [asdict(one) | {"servo": asdict(servos[key])} for key, one in some.items() if key]
    if session.gave(session.record(drives=listed)):
        return
    rows = []
    for key, one in some.items():
        s = servos[key]
        numbers = (one.gear, volts or one.volts, s.limit, s.kp, s.kv, s.armature)
        rows.append((one.name, *("" if n is None else f"{n:.3g}" for n in numbers), one.gains or ""))
    session.console().print(rich_table(Table(_HEADS, ("", *[NUMBER] * 6, ""), rows)))
    if len(some) == 1:
        (one,) = some.values()
        print(f"\n{one.title}: {one.source}")
        print(f"torque known to {100 * one.torque_sd:.0f} %{f'; {one.note}' if one.note else ''}")
