"""A finding: one doubt about a model or a log, with its size and what would cure it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from amhe_cli.core.errors import and_more

#: Findings of one kind that are said each, and names that one finding lists.
_EACH, _NAMED = 3, 6
#: Share of its range by which a joint or its targets may go beyond it: noise and soft stops do.
BEYOND = 0.1
#: Size of what is wrong for certain, or was tested, in a file or a log.
WRONG = 3.0

#: Kind of a doubt, what it is about, the doubt, and its size: a finding is one of a size above 1.
Doubt = tuple[str, str, str, float]
#: Kind -> what would cure it.
_CURES = {
    "light": "weigh it, or take the mass of CAD",
    "dense": "look for a mass in grams, or a wrong scale of the mesh",
    "thin": "look for a mass in tons or a mesh in millimetres",
    "centre": "look for a sign, or for millimetres taken for metres",
    "inertia": "take it from CAD, about the centre of mass and in kg m^2; g mm^2 are 1e-9 of these",
    "twins": "a robot is mostly built alike on both sides: which of the two is right?",
    "drive": "no drive is without: `amhe init --drive` takes them from the library, `identify` from a log",
    "idle": "give it a gain, or delete it",
    "stiff": "is the gain in counts, or measured (`amhe drives`)? Is the armature there?",
    "twice": "delete one of them",
    "weak": "is the limit that of the motor, before the gear? Is a mass too large?",
    "range": "look for degrees taken for radians, or for another zero",
    "overlap": "exclude the pair, or mend the shapes or the home pose",
    "loose": "a placeholder? Give the limit of the motor behind its gear",
    "axes": "take the inertia's axes from CAD, in the frame of the link",
    "unmeasured": "log it: without, each clip starts it at rest where the model has it at home",
    "slow": "record more samples a second: motion faster than half of their rate is lost",
    "still": "move it: `amhe probe` writes an excitation",
    "gaps": "pauses between runs do no harm; else record without silences, or loosen `logs.max_gap`",
    "saturated": "then its gain cannot be determined: command smaller steps, or is the gain wrong?",
    "contact": "record without contact, or exclude the pair if they do not touch on the robot",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One doubt.

    Args:
        kind: What kind of doubt it is, one word for each, for programs.
        where: The body, joint, actuator or log that it is about.
        what: The doubt, in words with numbers.
        size: How far it is beyond what is plausible, a factor of 1 or more.
        cure: What would remove it.
    """

    kind: str
    where: str
    what: str
    size: float
    cure: str

    @classmethod
    def of(cls, doubt: Doubt) -> Finding:
        """A doubt, with the cure of its kind."""
        return cls(*doubt, cure=_CURES[doubt[0]])


def worst_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings by their size, those of one kind together where they are alike."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for one in findings:
        groups.setdefault((one.kind, one.what), []).append(one)
    joined = [_together(alike, lambda one: one.what) for alike in groups.values()]
    kinds: dict[str, list[Finding]] = {}
    for one in sorted(joined, key=lambda one: -one.size):
        kinds.setdefault(one.kind, []).append(one)
    every = [one for alike in kinds.values() for one in alike[:_EACH]]
    rest = [alike[_EACH:] for alike in kinds.values() if alike[_EACH:]]
    every += [_together(alike, lambda one: f"likewise; the worst: {one.what}") for alike in rest]
    return tuple(sorted(every, key=lambda one: -one.size))


def _together(alike: list[Finding], say: Callable[[Finding], str]) -> Finding:
    """Findings of one kind as one, of the size and with the cure of the worst."""
    worst = max(alike, key=lambda one: one.size)
    where = and_more([one.where for one in alike], _NAMED)
    return Finding(worst.kind, where, say(worst), worst.size, worst.cure)
