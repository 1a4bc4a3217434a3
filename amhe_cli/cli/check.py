"""`amhe check`: what is wrong with a model's numbers, before anything is fitted."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from amhe_cli.cli import options, parsing
from amhe_cli.cli.init import MENAGERIE, ModelPath
from amhe_cli.cli.session import Session

#: Findings that are listed; `--json` has all of them.
_SHOWN = 20


@click.command(cls=parsing.Command, short_help="What is wrong with the numbers of a model?")
@click.argument("model", type=ModelPath(exists=True, dir_okay=False, readable=False, path_type=Path))
@click.option("--no-meshes", is_flag=True, help="Read a URDF without its meshes.")
@options.common
@click.pass_obj
def check(session: Session, model: Path | str, no_meshes: bool) -> None:
    """Look through MODEL for numbers that no robot has: the worst first, each with what would cure it.

    MODEL is an MJCF or URDF file, or menagerie:NAME. Masses and inertias are held against shapes, left
    against right, gains against the time step, limits against gravity. Nothing is simulated or fitted. With
    --strict, any finding is exit code 3.
    """
    import os

    from amhe_cli.check.model import check_model, total_mass
    from amhe_cli.init.menagerie import menagerie_model
    from amhe_cli.init.ros_packages import packages_in
    from amhe_cli.system.model.files import compiled, read_spec
    from amhe_cli.system.model.urdf import UrdfOptions

    session.hush_mujoco()
    path = menagerie_model(model.removeprefix(MENAGERIE)) if isinstance(model, str) else model
    spec = read_spec(path, UrdfOptions(packages_in(os.environ), not no_meshes))
    compiled_model = compiled(spec, path.name)
    found = check_model(compiled_model)
    session.warnings += [f"{one.where}: {one.what}" for one in found]
    if session.json:
        listed = [asdict(one) for one in found]
        session.print_json(session.record(model=str(path), mass=total_mass(compiled_model), findings=listed))
        return
    console = session.console()
    joints, actuators = compiled_model.njnt, compiled_model.nu
    console.print(f"{path.name}: {total_mass(compiled_model):.4g} kg, {joints} joints, {actuators} actuators")
    for one in found[:_SHOWN]:
        console.print(f"  {one.where}: {one.what}", style="yellow", soft_wrap=True)
        console.print(f"    {one.cure}", style="dim", soft_wrap=True)
    if len(found) > _SHOWN:
        console.print(f"  and {len(found) - _SHOWN} more: --json lists all")
    if not found:
        console.print("  nothing that a robot could not have", style="green")
