"""`amhe drives`: the library of drives, with sources."""

from __future__ import annotations

from dataclasses import asdict

import click

from amhe_cli.cli.command import Given, argument, command, option
from amhe_cli.cli.kinds import Number
from amhe_cli.cli.session import Session

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
