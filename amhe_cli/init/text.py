"""The text of a first `system.yaml`: every guess with its reason as a comment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from amhe_cli.core.text import printable
from amhe_cli.core.yaml_file import flow
from amhe_cli.init.signals import Guess

#: Line of a system whose efforts are matched.
MATCH = "match: effort  # motion: the torques drive the model, and its motion is compared"
#: Comment above a signal that is to be completed by hand.
_SKELETON = "this type is not built in: correct the paths of its numbers to use it"

#: Comment above the joints that have a gear.
_GEARED = (
    "",
    "# Servos have gears, whose friction grows with load: intervals allow for it. Name no direct drives;",
    "# with known loads, `amhe compare --friction` says what it is.",
)


def system_text(
    model: str,
    original: str,
    logs: Sequence[str],
    guesses: Sequence[Guess],
    parameters: Sequence[Guess],
    notes: Sequence[str],
    skeletons: Sequence[Sequence[str]] = (),
    spare: Sequence[Guess] = (),
    geared: Sequence[str] = (),
    match: str = "motion",
) -> str:
    """Text of a `system.yaml`.

    Args:
        model: Model file, in the same folder.
        original: Name of the model file that the user gave.
        logs: Logs that the guesses come from.
        guesses: Guessed signals.
        parameters: Guessed parameters, and
        notes: Sentences for the user.
        skeletons: Signals to complete by hand, as lines; written as comments.
        spare: Parameters that are not free; written as comments.
        geared: Joints with a gear.
        match: What is compared with the logs.
    """
    names = ", ".join(Path(log).name for log in logs)
    lines = [
        f"# A first system, guessed by `amhe init` from {printable(original)} and {printable(names)}.",
        "# Read it, correct it, then: amhe identify LOG --system THIS_FOLDER",
        *(f"#   {printable(note)}" for note in notes),
        f"model: {flow(model)}",
        *([MATCH] if match == "effort" else []),
        "",
        "# The unknowns. nominal and prior_sd are the prior, before a log is read; prior_sd is the",
        "# standard deviation of log(value) with scale: log (0.5 is a factor of 1.65), else of the value.",
        "parameters:",
        *(line for guess in parameters for line in _parameter(guess)),
        *("  # To make a mass unknown, too, uncomment it:" for _ in spare[:1]),
        *(f"  # {line[2:]}" for guess in spare for line in _parameter(guess)),
        "",
        "# noise: standard deviation of the measurement [SI]; null: it sets the state and is not compared.",
        "signals:",
        *(line for guess in guesses for line in _signal(guess)),
        *(f"  # {printable(line)}" for skeleton in skeletons for line in (_SKELETON, *skeleton)),
        *(_GEARED if geared else ()),
        *(line for line in ("settings:", "  identify:", f"    geared: {flow(list(geared))}") if geared),
    ]
    return "\n".join(lines) + "\n"


def _parameter(guess: Guess) -> Iterator[str]:
    yield f"  {flow(guess.name)}:  # {printable(guess.why)}"
    for key, value in guess.entry.items():
        if key != "targets":
            yield f"    {key}: {flow(value)}"
    yield "    targets:"
    yield from (f"      - {flow(target)}" for target in guess.entry["targets"])


def _signal(guess: Guess) -> Iterator[str]:
    yield f"  {flow(guess.name)}:  # {printable(guess.why)}"
    yield from (f"    {key}: {flow(value)}" for key, value in guess.entry.items())
    if guess.noise:
        yield f"    noise: {flow(guess.noise)}"
