"""`amhe init`: a first system folder from a model and logs."""

from __future__ import annotations

import os
from pathlib import Path

import click

from amhe_cli.cli import log_path, options, parsing
from amhe_cli.cli.model_path import ModelPath, model_file
from amhe_cli.cli.session import Session
from amhe_cli.core.text import printable


@click.command(cls=parsing.Command, short_help="A model and logs to a first system folder.")
@click.argument("model", type=ModelPath(exists=True, dir_okay=False, readable=False, path_type=Path))
@click.argument(
    "logs", nargs=-1, required=True, type=log_path.LOG, callback=log_path.episodes, metavar="LOG..."
)
@click.option(
    "-o",
    "--out",
    "--system",
    "out",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="The system folder to write.  [default: amhe-out/init-<date>-<time>/]",
)
@click.option(
    "--actuators",
    is_flag=True,
    help="Make the drives the unknowns: armature, viscous and dry friction and the encoder's zero of every "
    "measured joint, and one delay of the commands.",
)
@click.option(
    "--group",
    is_flag=True,
    help="With --actuators: equal drives (left and right, or of one class, with the same numbers) share "
    "their parameters.",
)
@click.option(
    "--gains",
    is_flag=True,
    help="With --actuators: gain, velocity gain, force limit and filter of each servo are unknown, too.",
)
@click.option(
    "--backlash",
    metavar="JOINT",
    multiple=True,
    help="Put a free gap of unknown width between this joint and its drive: a name or a pattern, '*' for "
    "all; repeat for more.",
)
@click.option(
    "--drive",
    "drives",
    metavar="JOINT=MAKER:TYPE",
    multiple=True,
    callback=parsing.pairs(str),
    help="Take gain, limit and armature of this joint's drive, or those of a pattern, from the library "
    "(`amhe drives`); repeat for more.",
)
@click.option(
    "--volts", type=click.FloatRange(min=0.1), help="Supply of these drives.  [default: the data sheet's]"
)
@click.option(
    "--gain-p",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Their position gain, in the drive's own unit.  [default: that in a column of the log]",
)
@options.force
@options.msg_path
@click.option(
    "--package",
    "packages",
    metavar="NAME=DIR",
    multiple=True,
    callback=parsing.pairs(str),
    help="Folder of a ROS package that a URDF's meshes lie in; repeat for more.  "
    "[default: ROS_PACKAGE_PATH, AMENT_PREFIX_PATH, and the folders above the URDF]",
)
@click.option(
    "--no-meshes",
    is_flag=True,
    help="Leave out the meshes of a URDF; boxes of the same mass and inertia take their place.",
)
@options.common
@click.pass_obj
def init(
    session: Session,
    model: Path | str,
    logs: tuple[Path, ...],
    out: Path | None,
    actuators: bool,
    group: bool,
    gains: bool,
    backlash: tuple[str, ...],
    drives: dict[str, str],
    volts: float | None,
    gain_p: float | None,
    force: bool,
    msg_path: Path | None,
    packages: dict[str, str],
    no_meshes: bool,
) -> None:
    """Write a system folder for MODEL whose signals are found in LOG...

    MODEL is an MJCF or URDF file, or menagerie:NAME for a model of the package mujoco-menagerie.
    To try it: amhe init example:arm example:arm --actuators -o arm/

    Its system.yaml is commented: the signals matched to joints by name, candidate parameters, and what
    was guessed. Read it, correct it, then: amhe identify LOG --system DIR.
    """
    from amhe_cli.cli.inspect import looked_at
    from amhe_cli.init.folder import init_system
    from amhe_cli.init.from_library import Chosen
    from amhe_cli.init.ros_packages import packages_in
    from amhe_cli.logs import inspect_log, members
    from amhe_cli.report.folder import reserve
    from amhe_cli.system.model.urdf import UrdfOptions, is_urdf
    from amhe_cli.system.system import System

    if not drives and (volts is not None or gain_p is not None):
        raise click.UsageError("--volts and --gain-p belong to --drive")
    session.hush_mujoco()
    path = model_file(model)
    known = packages_in(os.environ) if is_urdf(path) else {}
    urdf = UrdfOptions({**known, **{name: Path(dir_) for name, dir_ in packages.items()}}, not no_meshes)
    folder = reserve(out, "init", force)
    guessed = init_system(
        path,
        logs,
        folder,
        msg_path=msg_path,
        force=force,
        urdf=urdf,
        actuators=actuators,
        group=group,
        gains=gains,
        backlash=backlash,
        drives=Chosen(drives, volts, gain_p) if drives else None,
    )
    system = System.load(folder, warn=False)
    for log in (one.path for path in logs for one in members(path, system)):
        remarks = looked_at(inspect_log(log, system, msg_path=msg_path), system).remarks
        guessed += [f"{log}: {remark}" for remark in remarks]
    if session.json:
        session.print_json(session.record(system=str(folder), guessed=guessed))
        return
    for sentence in guessed:
        print(printable(sentence))
    print(f"wrote {folder}/system.yaml: read it, correct it, then: amhe identify LOG --system {folder}")
