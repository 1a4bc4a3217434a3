"""`amhe drives`: the library of drives, with sources."""

from __future__ import annotations

from dataclasses import asdict

import click

from amhe_cli.cli import options, parsing
from amhe_cli.cli.session import Session


@click.command(cls=parsing.Command, short_help="The library of drives: data sheets and firmware gains.")
@click.argument("name", required=False, metavar="[NAME]")
@click.option("--volts", type=click.FloatRange(min=0.1), help="Supply.  [default: that of the data sheet]")
@click.option(
    "--gain-p", type=click.FloatRange(min=0.0, min_open=True), help="Position gain, in the drive's own unit."
)
@options.common
@click.pass_obj
def drives(session: Session, name: str | None, volts: float | None, gain_p: float | None) -> None:
    """List the drives that `amhe init --drive` knows, or say what one is at a supply and a gain.

    NAME is maker:type. A part of it lists the drives with it. The numbers are public; each drive names their
    sources.
    """
    from amhe_cli.init.drive_library import drive, library
    from amhe_cli.report.tables import NUMBER, Table, rich_table

    some = {key: one for key, one in library().items() if (name or "").lower() in key}
    if name in library() or not some:
        some = {name: drive(str(name), volts)}
    elif volts is not None or gain_p is not None:
        raise click.UsageError("--volts and --gain-p are for one drive: give its whole NAME")
    servos = {key: one.servo(volts, gain_p) for key, one in some.items()}
    if session.json:
        listed = [asdict(one) | {"servo": asdict(servos[key])} for key, one in some.items() if key]
        session.print_json(session.record(drives=listed))
        return
    heads = (
        "drive",
        "gear",
        "V",
        "torque, N m",
        "kp, N m/rad",
        "kv, N m s/rad",
        "armature, kg m^2",
        "gain in",
    )
    rows = [
        (
            one.name,
            *map(
                lambda value: "" if value is None else f"{value:.3g}",
                (one.gear, volts or one.volts, s.limit, s.kp, s.kv, s.armature),
            ),
            one.gains or "",
        )
        for one, s in ((one, servos[key]) for key, one in some.items())
    ]
    session.console().print(rich_table(Table(heads, ("", *[NUMBER] * 6, ""), rows)))
    if len(some) == 1:
        (one,) = some.values()
        print(f"\n{one.title}: {one.source}")
        print(f"torque known to {100 * one.torque_sd:.0f} %{f'; {one.note}' if one.note else ''}")
