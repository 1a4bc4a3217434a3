"""What a replay means, in words: for the terminal and the page alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from amhe_cli.report import numbers
from amhe_cli.report.words import Statement, joined

#: What became of a window.
MARKS: Mapping[str, str] = {
    "updated": "it moved the belief",
    "jump": "the belief missed it by far: a parameter has jumped, and the belief was widened",
    "still": "it says nothing of the parameters, and was passed over",
    "gap": "a signal was silent in it, and it was passed over",
    "diverged": "its rollouts diverged, and taught nothing",
}
#: Of 90 % intervals, so many hold the truth if they are honest; fewer than this share is worth a word.
_HONEST = 0.8


def headline(record: Mapping[str, Any]) -> str:
    """The outcome in one line."""
    told = [
        f"{p['name']} {numbers.quantity(numbers.with_sd(p['estimate'], p['sd']), p['unit'])}"
        for p in record["parameters"]
    ]
    return f"At {record['end_s']:.1f} s: {', '.join(told)}."


def statements(record: Mapping[str, Any]) -> list[Statement]:
    """What a reader should know before using a number."""
    return [
        *_stopped(record), *_truth(record), *_together(record), *_marks(record), *_speed(record),
        *_diverged(record),
    ]  # fmt: skip


def _stopped(record: Mapping[str, Any]) -> Iterator[Statement]:
    if record["interrupted"]:
        yield Statement("mixed", "The replay was interrupted: these are the estimates up to there.")


def _truth(record: Mapping[str, Any]) -> Iterator[Statement]:
    told = [p for p in record["parameters"] if p["coverage"] is not None]
    if told:
        held = joined([f"of {p['name']} at {numbers.percent(p['coverage'])}" for p in told])
        honest = all(p["coverage"] >= _HONEST for p in told)
        yield Statement(
            "good" if honest else "mixed",
            f"The truth, which the log tells, lay in the 90 % interval {held} of the updates.",
        )


def _together(record: Mapping[str, Any]) -> Iterator[Statement]:
    for c in record["combinations"]:
        yield Statement(
            "good", f"Known together, better than apart: {c['text']} to {numbers.percent(c['sd'])}."
        )


def _marks(record: Mapping[str, Any]) -> Iterator[Statement]:
    yield Statement("good" if record["updated"] else "bad", f"{windows_line(record)}.")


def _speed(record: Mapping[str, Any]) -> Iterator[Statement]:
    ms, period = record["update_ms"], 1e3 * record["settings"]["update_period"]
    if ms["p50"] is not None:
        yield Statement(
            "good" if ms["p99"] <= period else "mixed",
            f"An update took {ms['p50']:.0f} ms (median; 99 %: {ms['p99']:.0f} ms), with a period of "
            f"{period:g} ms.",
        )


def _diverged(record: Mapping[str, Any]) -> Iterator[Statement]:
    count, diverged = record["rollouts"]["count"], record["rollouts"]["diverged"]
    if diverged:
        share = numbers.percent(diverged / max(count, 1))
        yield Statement("mixed", f"{diverged:,} of {count:,} rollouts ({share}) diverged and were ruled out.")


def windows_line(record: Mapping[str, Any]) -> str:
    """'68 windows: 61 moved the belief (2 jumps); 5 say nothing, 2 begin in a gap'."""
    jumps = f" ({record['jumps']} jump{'s' * (record['jumps'] != 1)})" if record["jumps"] else ""
    passed = [
        f"{record[key]} {text}"
        for key, text in (("still", "say nothing"), ("gaps", "begin in a gap"), ("lost", "diverged"))
        if record[key]
    ]
    rest = f"; {', '.join(passed)}" if passed else ""
    count = record["windows"]
    return f"{count} window{'s' * (count != 1)}: {record['updated']} moved the belief{jumps}{rest}"
