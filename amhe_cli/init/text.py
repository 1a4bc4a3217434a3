"""The text of a first `system.yaml`: every guess with its reason as a comment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from amhe_cli.core.errors import printable
from amhe_cli.core.yaml_file import flow
from amhe_cli.init.signals import Guess

#: Line of a system whose efforts are matched.
MATCH = "match: effort  # motion: the torques drive the model, and its motion is compared"
#: What marks a line whose numbers are a guess.
GUESS = "GUESS"
#: Comment above a signal that is to be completed by hand.
_SKELETON = "this type is not built in: correct the paths of its numbers to use it"

#: Settings of joints that have a gear, before the names of these.
_GEARED = (
    "",
    "# Servos have gears, whose friction grows with load: intervals allow for it. Name no direct drives;",
    "# with known loads, `amhe compare --friction` says what it is. Lifting and lowering separate load and",
    "# friction: once what is held out has judged a fit, a log of a few seconds is fitted to its end.",
    "settings:",
    "  clips: {held_out_least: 2}",
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
        f"# Neither model, log nor data sheet gives the lines with {GUESS}: look at these first.",
        "parameters:",
        *(f"  {_line(guess)}" for guess in parameters),
        *("  # To make a mass unknown, too, uncomment it:" for _ in spare[:1]),
        *(f"  # {_line(guess)}" for guess in spare),
        "",
        "# noise: standard deviation of the measurement [SI]; null: it sets the state and is not compared.",
        "signals:",
        *(line for guess in guesses for line in _signal(guess)),
        *(f"  # {printable(line)}" for skeleton in skeletons for line in (_SKELETON, *skeleton)),
        *([*_GEARED, "  identify:", f"    geared: {flow(list(geared))}"] if geared else ()),
    ]
    return "\n".join(lines) + "\n"


def _line(guess: Guess) -> str:
    """A parameter on one line, with its source and reason."""
    return f"{flow({guess.name: guess.entry})[1:-1]}  # {_why(guess)}"


def _signal(guess: Guess) -> Iterator[str]:
    """A signal, a line for each key: these are completed by hand."""
    yield f"  {flow(guess.name)}:  # {_why(guess)}"
    entry = guess.entry | ({"noise": guess.noise} if guess.noise else {})
    yield from (f"    {key}: {flow(value)}" for key, value in entry.items())


def _why(guess: Guess) -> str:
    return f"{GUESS if guess.source == 'guess' else guess.source}: {printable(guess.why)}"
