"""`amhe calibrate`: where the rigid bodies of motion capture are on the robot and on the box."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from amhe_cli.cli import at_the_robot, options
from amhe_cli.cli.command import Given, command, flag
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.robots.go1.link.calibration import Offsets

#: The file of settings that is written.
SETTINGS = "offsets.yaml"


@command(
    "Offsets of the rigid bodies on a real robot and its box.",
    options.task("Whose box it is, and where it is put down."),
    at_the_robot.REACH,
    options.seconds("How long each body is looked at.", 2.0, min=0.5, max=60, min_open=False),
    flag("--yes", "Robot and box are in place: ask nothing."),
    options.tuning,
    options.output,
)
def calibrate(session: Session, given: Given) -> None:
    """Find go1.trunk_offset and go1.box_offset from robot and box that you put where it says.

    Writes offsets.yaml, for --config of `amhe run` and `amhe probe`, and result.json. The robot must be in
    low-level mode (docs/go1.md); its joints and its IMU tell how it lies. Nothing moves.
    """
    from amhe_cli.core.files import filling, json_text
    from amhe_cli.robots.go1.link.open import open_calibration
    from amhe_cli.robots.go1.run import RunOptions

    reached = at_the_robot.wire_of("go1", given)
    assert reached is not None
    chosen = RunOptions(given.task, target="go1", settings=given.overrides.all)
    calibration = open_calibration(chosen, reached)
    folder = given.reserve()
    with calibration:
        found = calibration.offsets(_asking(session, given.yes), given.seconds)
    text = _settings(found)
    record = session.record(
        task=given.task, trunk_offset=found.trunk, box_offset=found.box, trunk_height_m=found.height,
        trunk_tilt_rad=found.tilt, out=str(folder),
    )  # fmt: skip
    with filling(folder) as scratch:
        (scratch / SETTINGS).write_text(text, encoding="utf-8")
        (scratch / "result.json").write_text(json_text(record), encoding="utf-8")
    if not session.gave(record):
        print(text, end="")
        print(f"next: amhe run --task {given.task} --target go1 --dry-run --config {folder / SETTINGS}")


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
