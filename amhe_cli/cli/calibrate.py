"""`amhe calibrate`: where the rigid bodies of motion capture are on the robot and on the box."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import at_the_robot, options, parsing
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.robots.go1.link.calibration import Offsets

#: The file of settings that is written.
SETTINGS = "offsets.yaml"


@click.command(cls=parsing.Command, short_help="Offsets of the rigid bodies on a real robot and its box.")
@options.task("Whose box it is, and where it is put down.")
@at_the_robot.reach_options
@options.seconds("How long each body is looked at [s].", 2.0, min=0.5, max=60)
@click.option("--yes", is_flag=True, help="Robot and box are in place: ask nothing.")
@options.tuning
@options.out
@options.common
@click.pass_obj
def calibrate(
    session: Session,
    task: str,
    seconds: float,
    wire: dict[str, Any],
    yes: bool,
    overrides: Overrides,
    out: options.Output,
) -> None:
    """Find go1.trunk_offset and go1.box_offset from robot and box that you put where it says.

    Writes offsets.yaml, for --config of `amhe run` and `amhe probe`, and result.json. The robot must be in
    low-level mode (docs/go1.md); its joints and its IMU tell how it lies. Nothing moves.
    """
    import json

    from amhe_cli.core.files import filling
    from amhe_cli.robots.go1.link.open import open_calibration
    from amhe_cli.robots.go1.run import RunOptions

    session.hush_mujoco()
    reached = at_the_robot.wire_of("go1", wire)
    assert reached is not None
    chosen = RunOptions(task, target="go1", settings=overrides.all)
    calibration = open_calibration(chosen, reached)
    folder = out.reserve()
    with calibration:
        found = calibration.offsets(_asking(session, yes), seconds)
    text = _settings(found)
    record = session.record(
        task=task, trunk_offset=found.trunk, box_offset=found.box, trunk_height_m=found.height,
        trunk_tilt_rad=found.tilt, out=str(folder),
    )  # fmt: skip
    with filling(folder) as scratch:
        (scratch / SETTINGS).write_text(text, encoding="utf-8")
        (scratch / "result.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    if session.json:
        return session.print_json(record)
    print(text, end="")
    print(f"next: amhe run --task {task} --target go1 --dry-run --config {folder / SETTINGS}")


def _asking(session: Session, ready: bool) -> Callable[[str], None]:
    """Tell the operator what to do, and wait for Enter; where everything is ready, only tell."""
    from amhe_cli.core.errors import ConfigError

    def ask(text: str) -> None:
        session.say("", text if ready else f"{text}; then press Enter")
        if not ready:
            try:
                input()
            except EOFError:
                raise ConfigError("nobody is there to press Enter; give --yes once all is in place") from None

    return ask


def _settings(found: Offsets) -> str:
    """As YAML, to 0.1 mm and 0.01 degrees."""
    rows = [
        f"  {name}: [{', '.join(f'{value:.4f}' for value in offset)}]\n"
        for name, offset in (("trunk_offset", found.trunk), ("box_offset", found.box))
    ]
    return "# place [m] and rotation vector [rad] in the rigid body's frame\ngo1:\n" + "".join(rows)
