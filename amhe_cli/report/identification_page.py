"""`report.html` of an identification, and what it states in sentences."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from amhe_cli.estimation.core.result import (
    VERDICTS,
    Combination,
    Fit,
    HeldOut,
    Identification,
    ParameterResult,
    known_together,
)
from amhe_cli.report import figures, numbers
from amhe_cli.report.check import before_section
from amhe_cli.report.held_out import better_text, held_out_section, held_out_statement
from amhe_cli.report.missing import missing_section, repairs_section
from amhe_cli.report.page import Section, Statement, Tone, diverged_statement, fixed_statement, result_page
from amhe_cli.report.parameters import budget_section, parameter_sections
from amhe_cli.report.tables import NUMBER, STRONG, Table

#: Clips whose fit is drawn.
MAX_CLIPS = 3
#: Sentences about what is taken as known.
_GIVEN = 3
#: Residuals of more than so many times the declared noise are worth a look, and mean that the model is wrong.
LARGE_RESIDUAL, LARGEST_RESIDUAL = 2.0, 5.0

#: Pairs with a correlation beyond this one have an ellipse.
CORRELATED = 0.6
#: What residuals over noise mean.
THUMB = "about 1 is good; from 2 on, look at what is left; from 5 on, the model is wrong"

#: The note on a short log.
_REFITTED = "The log is short: held-out clips judged a fit without them, and the values here fit them too."
#: Combinations that are named outside their own table.
MAX_COMBINATIONS = 3

_TONES: Mapping[str, Tone] = {"weak": "mixed", "prior": "mixed", "model-sensitive": "bad"}


@dataclass(frozen=True, slots=True)
class Beside:
    """What a view of the same result adds to its page.

    Args:
        strip: Pictures of the robot with its ghosts.
        whole: The log as a whole.
        link: Address of the view, at the clip that is shown.
        clip: Name of that clip.
        page: The view itself.
    """

    strip: Markup = field(default_factory=Markup)
    whole: Markup = field(default_factory=Markup)
    link: str = ""
    clip: str = ""
    page: str = field(default="", repr=False)


ALONE = Beside()


def identification_page(
    result: Identification, record: Mapping[str, Any], provenance: Mapping[str, Any], seen: Beside = ALONE
) -> str:
    """The page as HTML; for the arguments see `write_identification`."""
    clips, logs = result.clips, len(result.logs)
    named = ", ".join(Path(log).name for log in result.logs[:3]) + ", ..." * (logs > 3)
    return result_page(
        record,
        provenance,
        title=named if result.system == "system" else result.system,  # that of `identify --model` has no name
        facts=(
            f"{logs} log{'s' * (logs != 1)} fitted",
            f"{clips.fitted} clip{'s' * (clips.fitted != 1)} fitted, "
            f"{clips.held_out} held out{' of a first fit' * clips.refitted}",
            f"{result.rollouts:,} rollouts in {record['seconds']:.1f} s",
        ),
        headline=headline(result),
        statements=[
            *statements(result),
            *(
                [Statement("good", "See it move: the clip that was missed most", seen.link)]
                if seen.link
                else []
            ),
        ],
        sections=list(_sections(result, record, seen)),
    )


def headline(result: Identification) -> str:
    """The result in one line, with the misfit over the noise."""
    if result.unexplained:  # what to do is the first sentence below it
        return f"No parameter is identified: {result.unexplained[0].text.partition(': ')[0]}."
    told = _verdict_text(result)
    return f"{told}; {misfit_text(result)}." if misfit_text(result) else f"{told}."


def misfit_text(result: Identification) -> str:
    """'misfit 1.3 times the noise'; '' where nothing was compared."""
    worst = max(result.noise_scale.values(), default=math.nan)
    return f"misfit {worst:.2g} times the noise" if math.isfinite(worst) else ""


def _verdict_text(result: Identification) -> str:
    total = len(result.lines)
    identified, conditional = (
        sum(p.verdict == verdict for p in result.parameters) for verdict in ("identified", "conditional")
    )
    if identified == total:
        return "All parameters are identified" if total > 1 else "The parameter is identified"
    if conditional:
        counts = ((identified, "identified"), (conditional, "determined if a number that was given is right"))
        (first, what), *more = [one for one in counts if one[0]]
        also = "".join(f", and {count} {_are(count)} {says}" for count, says in more)
        return f"{first} of {total} parameters {_are(first)} {what}{also}"
    if not identified:
        return "No parameter is identified by these logs"
    return f"{identified} of {total} parameters {_are(identified)} identified"


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def statements(result: Identification) -> list[Statement]:
    """What a reader should know before using a number, most important first."""
    stopped = "The search was interrupted: the values are the best that it had found."
    return [
        *([Statement("bad", stopped)] if result.interrupted else []),
        *(Statement("bad", f"{one.text[0].upper()}{one.text[1:]}.") for one in result.unexplained),
        *held_out_statement(result.held_out),
        *_better(result.held_out),
        *([Statement("mixed", _REFITTED)] if result.clips.refitted else []),
        *(Statement("good", f"{text[0].upper()}{text[1:]}.") for text in result.determined[:1]),
        *_verdicts(result.lines),
        *(Statement("good", together_text(result, c)) for c in known_together(result)[:MAX_COMBINATIONS]),
        *fixed_statement(result.belief.fixed, result.exact),
        *_residuals(result),
        *diverged_statement(result.diverged, result.rollouts),
    ]


def _better(held_out: HeldOut | None) -> Iterator[Statement]:
    if held_out and (text := better_text(held_out.horizons)):
        worse = any(one.identified > one.initial for one in held_out.horizons)
        yield Statement("mixed" if worse else "good", f"{text}.", "held-out")


def _verdicts(parameters: Sequence[ParameterResult]) -> Iterator[Statement]:
    """One sentence for each verdict other than 'identified'; the table has the rest."""
    given: dict[str, list[str]] = {}
    for p in parameters:
        if p.verdict == "conditional":
            given.setdefault(p.given, []).append(p.name)
    if len(given) > _GIVEN:
        given = {"what the table names with each": [name for names in given.values() for name in names]}
    for what, names in given.items():
        yield Statement("mixed", f"{numbers.some(names)}: determined by the logs, given {what}.")
    for verdict, tone in _TONES.items():
        names = [p.name for p in parameters if p.verdict == verdict]
        if names:
            yield Statement(tone, f"{numbers.some(names)}: {VERDICTS[verdict]}.")


def _residuals(result: Identification) -> Iterator[Statement]:
    """The misfit, and that of each channel, the largest first."""
    if not misfit_text(result):
        return
    sizes = sorted(result.noise_scale.items(), key=lambda one: -one[1])
    worst, each = sizes[0][1], numbers.some([f"{channel} {size:.2g}" for channel, size in sizes])
    why = " The model misses something there, or the noise is larger than declared."
    tone: Tone = "good" if worst <= LARGE_RESIDUAL else "bad" if worst > LARGEST_RESIDUAL else "mixed"
    told = f"{misfit_text(result).capitalize()}" + f" ({each})" * (len(sizes) > 1)
    yield Statement(tone, f"{told}: {THUMB}.{why * (worst > LARGE_RESIDUAL and not result.unexplained)}")


def _sections(result: Identification, record: Mapping[str, Any], seen: Beside) -> Iterator[Section]:
    yield from parameter_sections(result, record["truth"])
    if joints := result.determined[1:]:
        yield Section("Each joint", items=joints)
    if result.fits:
        yield overlay_section(result.fits, seen, result.clips.refitted)
    if doubts := record.get("findings"):
        yield before_section(doubts)
    if result.held_out:
        yield held_out_section(result.held_out)
    if result.missing:
        yield missing_section(result.missing)
    if result.repairs:
        yield repairs_section(result.repairs)
    yield budget_section(result.lines)
    if len(result.parameters) > 1:
        yield _together_section(result)
    if result.runs:
        yield Section(
            "Repeatability: each run alone",
            text="What each log says by itself, from the same linearisation; a log that hardly knows a "
            "parameter has no value. Runs that disagree beyond chance are named with the parameter, and "
            "widen its interval.",
            table=_run_table(result),
            folded=False,
        )
    if seen.whole:
        yield Section(
            "Whole log",
            text="What was measured, and what is predicted from the first state of each clip, where lines "
            "begin anew.",
            figure=seen.whole,
            folded=True,
        )
    yield _data_section(result)
    if folder := record.get("out"):
        yield Section("Next", items=next_steps(result, folder, bool(seen.page)), files=True, folded=False)


def next_steps(result: Identification, folder: str | Path, view: bool) -> list[str]:
    """What to do next: look at it (if it has a view), then use it, or mend a model that misses its logs."""
    quoted = shlex.quote(str(folder))
    without = f"{quoted}/report.html (there is no view: no motion is predicted)"
    look = f"look: {f'amhe view {quoted}' if view else without}"
    rows = result.missing.rows if result.missing and not result.repairs else ()
    names = [] if any(row.in_log for row in rows) else [row.name for row in rows if row.repair]
    mend = [f"mend: amhe identify with --repair tries {numbers.some(names)}"] if names else []
    if result.missing is None and any(one.kind == "misfit" for one in result.unexplained):
        mend.append(f"why: amhe explain {quoted}")
    if stuck := [p.name for p in result.parameters if any(one.kind == "bound" for one in p.reasons)]:
        own = Path(folder) / "system"
        system = shlex.quote(str(own)) if own.exists() else "FOLDER"
        wide = f"widen the bounds of {numbers.some(stuck)} in {system}/system.yaml, if they may be wrong"
        mend.append(f"mend: {wide}, then: " + f"amhe identify LOG --system {system}")
    if result.unexplained or not any(p.verdict in ("identified", "conditional") for p in result.lines):
        return [look, *mend]
    use = f"use: {quoted}/identified.xml", f"randomise: amhe export --to mjlab {quoted}/belief.yaml"
    return [look, *mend, *use]


def overlay_section(fits: Sequence[Fit], seen: Beside = ALONE, refitted: bool = False) -> Section:
    """Measured against predicted: the clip that the values before miss most, in large; the others below."""

    def named(own: Sequence[Fit]) -> str:
        held = "curves of a first fit, without this clip" if refitted else "not fitted"
        return f"{own[0].clip}, {held if own[0].held_out else 'fitted'}."

    clips: dict[str, list[Fit]] = {}
    for fit in fits:
        clips.setdefault(fit.clip, []).append(fit)
    first = max(
        clips.values(), key=lambda own: (own[0].clip == seen.clip, own[0].held_out, figures.widest_gap(own))
    )
    others = [own for own in clips.values() if own is not first][: MAX_CLIPS - 1]
    return Section(
        "Measured against predicted",
        text=named(first),
        figure=seen.strip
        + figures.fit_figure(first, large=True)
        + Markup("").join(Markup("<p>{}</p>").format(named(own)) + figures.fit_figure(own) for own in others),
    )


def _together_section(result: Identification) -> Section:
    """Pairs that are known better together than apart, as sentences and as ellipses."""
    rows = [(c.text, numbers.percent(c.sd), numbers.shrinkage(c.shrinkage)) for c in result.combinations]
    known = known_together(result)[:MAX_COMBINATIONS]
    return Section(
        "Known together",
        text="Where two parameters explain the same motion, the logs know a product or quotient of them "
        "better than either. Each ellipse holds 90 %: the narrower it is, the more one value says of the "
        "other." + ("" if known else " Here no combination is known better than its parts."),
        items=[together_text(result, c) for c in known],
        figure=figures.ellipse_figure(result, _pairs(result)),
        table=Table(("combination", "sd", "shrinkage"), ("name", STRONG, NUMBER), rows) if rows else None,
        folded=not known,
    )


def together_text(result: Identification, c: Combination) -> str:
    """'mass is known to 4 % and friction to 4 %, mass * friction to 1 %: ...'."""
    parts = [p for p in result.parameters if p.name in c.names and p.estimate]
    apart = [f"{p.name} to {numbers.percent(p.sd / abs(p.estimate))}" for p in parts] or ["no part alone"]
    follows = "the other follows" if len(c.names) == 2 else "the others follow"
    return f"{numbers.joined(apart)}, but {c.text} to {numbers.percent(c.sd)}: know one better and {follows}."


def _pairs(result: Identification) -> list[tuple[str, str]]:
    """The pairs whose errors go together most, at most six of those beyond `CORRELATED`."""
    names, size = result.belief.names, np.abs(np.triu(result.correlations, 1))
    order = np.argsort(-size, axis=None, kind="stable")[:6]
    places = zip(*np.unravel_index(order, size.shape), strict=True)
    return [(names[i], names[j]) for i, j in places if size[i, j] > CORRELATED]


def _run_table(result: Identification) -> Table:
    """The estimate from each log alone, and from all together."""
    rows = [
        (
            p.name,
            *(
                numbers.with_sd(*run.values[p.name]) if p.name in run.values else numbers.MISSING
                for run in result.runs
            ),
            numbers.with_sd(p.estimate, p.sd),
            numbers.unit_of(p.unit),
        )
        for p in result.parameters
    ]
    head = ("parameter", *(run.log for run in result.runs), "all together", "unit")
    return Table(head, ("name", *(NUMBER for _ in result.runs), STRONG, "unit"), rows)


def _data_section(result: Identification) -> Section:
    clips = result.clips
    dropped = [
        f"{count} {reason}"
        for count, reason in (
            (clips.motionless, "because nothing moves in them"),
            (clips.across_gaps, "because they contain a gap"),
        )
        if count
    ]
    held = f" and {clips.held_out} held out" + " of a first fit" * clips.refitted
    were = "was" if clips.fitted == 1 else "were"
    parts = [f"{clips.fitted_of} {were} fitted" + held * (clips.held_out > 0)]
    parts += [f"{numbers.joined(dropped)} were dropped"] if dropped else []
    parts += [f"{result.diverged:,} of {result.rollouts:,} rollouts diverged"] if result.diverged else []
    text = "".join(f"{part}. " for part in parts)
    return Section("Data", text=text, items=result.logs, files=True, folded=True)
