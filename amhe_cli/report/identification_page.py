"""`report.html` of an identification, and what it states in sentences."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from amhe_cli.estimation.core.result import (
    VERDICTS,
    Combination,
    Fit,
    Identification,
    ParameterResult,
    known_together,
)
from amhe_cli.report import figures, numbers
from amhe_cli.report.bodies import body_table
from amhe_cli.report.held_out import held_out_sections, held_out_statement
from amhe_cli.report.missing import missing_section, repairs_section
from amhe_cli.report.page import Fold, Section, Statement, Tone, cell, fixed_statement, result_page
from amhe_cli.report.parameters import parameter_section
from amhe_cli.report.tables import NUMBER, STRONG, Table

#: Clips whose fit is drawn.
MAX_CLIPS = 3
#: How many of them are open at once.
OPEN_CLIPS = 2

#: Residuals of more than this many times the declared noise are pointed out.
LARGE_RESIDUAL = 2.0
#: Right end of the bars of residuals, in times the declared noise.
LARGEST_RESIDUAL = 5.0

#: Combinations that are named outside their own table.
MAX_COMBINATIONS = 3

_TONES: Mapping[str, Tone] = {
    "weak": "mixed",
    "prior": "mixed",
    "model-sensitive": "bad",
}


def identification_page(
    result: Identification,
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
) -> str:
    """The page as HTML.

    Args:
        result: The identification.
        record: Content of result.json.
        provenance: Versions, hashes, seed and command.
    """
    clips, logs = result.clips, len(result.logs)
    return result_page(
        record,
        provenance,
        title=result.system,
        facts=(
            f"{logs} log{'s' * (logs != 1)} fitted",
            f"{clips.fitted} clips fitted, {clips.held_out} held out",
            f"{result.rollouts:,} rollouts in {record['seconds']:.1f} s",
        ),
        headline=headline(result),
        statements=statements(result),
        sections=list(_sections(result, record)),
    )


def headline(result: Identification) -> str:
    """The result in one line."""
    total = len(result.parameters)
    if result.unexplained:
        return f"No parameter is identified: {result.unexplained[0]}."
    identified, conditional = (
        sum(p.verdict == verdict for p in result.parameters) for verdict in ("identified", "conditional")
    )
    if identified == total:
        return "All parameters are identified." if total > 1 else "The parameter is identified."
    if conditional:
        also = f"{identified} identified, and " * (identified > 0)
        return f"Of {total} parameters {also}{conditional} determined if a number that was given is right."
    if not identified:
        return "No parameter is identified by these logs."
    return f"{identified} of {total} parameters {'is' if identified == 1 else 'are'} identified."


def statements(result: Identification) -> list[Statement]:
    """What a reader should know before using a number, most important first."""
    return [
        *_stopped(result),
        *_unexplained(result),
        *held_out_statement(result.held_out),
        *(Statement("good", f"{text[0].upper()}{text[1:]}.") for text in (result.determined,) if text),
        *_verdicts(result.parameters),
        *_combinations(result),
        *fixed_statement(result.belief.fixed, result.exact),
        *_residuals(result),
        *_divergence(result),
    ]


def _stopped(result: Identification) -> Iterator[Statement]:
    if result.interrupted:
        yield Statement("bad", "The search was interrupted: the values are the best that it had found.")


def _unexplained(result: Identification) -> Iterator[Statement]:
    for text in result.unexplained:
        yield Statement("bad", f"{text[0].upper()}{text[1:]}.")


def _verdicts(parameters: Sequence[ParameterResult]) -> Iterator[Statement]:
    """One sentence for each verdict other than 'identified'; the table has the rest."""
    given: dict[str, list[str]] = {}
    for p in parameters:
        if p.verdict == "conditional":
            given.setdefault(p.given, []).append(p.name)
    for what, names in given.items():
        yield Statement("mixed", f"{numbers.joined(names)}: determined by the logs if {what}, is right.")
    for verdict, tone in _TONES.items():
        names = [p.name for p in parameters if p.verdict == verdict]
        if names:
            yield Statement(tone, f"{numbers.joined(names)}: {VERDICTS[verdict]}.")


def _combinations(result: Identification) -> Iterator[Statement]:
    best = known_together(result)[:MAX_COMBINATIONS]
    if best:
        known = numbers.joined([f"{c.text} (sd {numbers.percent(c.sd)})" for c in best])
        yield Statement("good", f"Known more precisely together than apart: {known}.")


def _residuals(result: Identification) -> Iterator[Statement]:
    for channel, scale in result.noise_scale.items():
        if scale > LARGE_RESIDUAL:
            yield Statement(
                "mixed",
                f"The residuals of {channel} are {scale:.2g} times the declared noise: the model misses "
                "something there, or the noise is larger than declared.",
            )


def _divergence(result: Identification) -> Iterator[Statement]:
    if result.diverged:
        share = numbers.percent(result.diverged / max(result.rollouts, 1))
        yield Statement(
            "mixed" if result.diverged > 0.05 * result.rollouts else "good",
            f"{result.diverged:,} of {result.rollouts:,} rollouts ({share}) diverged and were left out.",
        )


def _sections(result: Identification, record: Mapping[str, Any]) -> Iterator[Section]:
    yield parameter_section(result, record["truth"])
    if result.bodies:
        yield Section("Inertias in the axes of their bodies", table=body_table(result.bodies))
    if result.combinations:
        yield _combination_section(result)
    if result.runs:
        yield Section(
            "Repeatability: each run alone",
            text="What each log says by itself, from the same linearisation; a log that hardly knows a "
            "parameter has no value. Runs that disagree beyond chance are named with the parameter, and "
            "widen its interval.",
            table=_run_table(result),
        )
    if result.held_out:
        yield from held_out_sections(result.held_out)
    if result.missing:
        yield missing_section(result.missing)
    if result.repairs:
        yield repairs_section(result.repairs)
    if result.fits:
        yield fit_section(result.fits)
    if folder := record.get("out"):
        yield Section(
            "In three dimensions",
            text="A page with the logs, and with what the model predicts under the nominal and under the "
            "identified parameters:",
            items=[f"amhe view {shlex.quote(folder)}"],
            files=True,
        )
    if result.noise_scale:
        yield Section(
            "Residuals against declared noise",
            table=_residual_table(result.noise_scale),
            note="The mark stands at 1: there residuals are as large as the noise declared in system.yaml.",
        )
    if profiles := figures.profile_figure(result.parameters):
        yield Section(
            "Cost along each parameter",
            text="The other parameters are held at the estimate. Band: 90 % interval; blue: estimate; "
            "dashed: prior. A flat line means that the logs hardly narrow the parameter down; of many "
            "parameters, those are left out.",
            figure=profiles,
        )
    if len(result.parameters) > 1:
        yield Section(
            "Correlations",
            text="Two parameters with a correlation near +1 or -1 explain the same motion: only a "
            "combination of them is known.",
            figure=figures.correlation_figure(result.belief.names, result.correlations),
            natural=True,
        )
    if result.iterations:
        yield Section(
            "Convergence",
            text=f"{len(result.iterations)} iterations of the method {result.method}. To the right: how far "
            "each parameter was from its final value, in sd of its prior.",
            legend=figures.convergence_legend(result.belief.names),
            figure=figures.convergence_figure(result.iterations, result.parameters, result.belief.log),
        )
    yield _data_section(result)


def _combination_section(result: Identification) -> Section:
    """Combinations that are known better than their parameters; the others are folded away."""
    known = known_together(result)
    others = [c for c in result.combinations if c not in known]
    count = f"{len(others)} combination{'s' * (len(others) > 1)}"
    hidden = Fold(f"{count} known no better", cell("table", _combination_table(others)), open=False)
    return Section(
        "Combinations",
        text="Where two parameters explain the same motion, the logs may know a product or quotient of them "
        "better than either: predictions of such motion are good although each value is uncertain, and "
        "whoever measures one of the two knows the other as well."
        + ("" if known else " None is known better here."),
        table=_combination_table(known) if known else None,
        folds=[hidden] if others else [],
    )


def _combination_table(combinations: Sequence[Combination]) -> Table:
    rows = [(c.text, numbers.percent(c.sd), numbers.shrinkage(c.shrinkage)) for c in combinations]
    return Table(("combination", "sd", "shrinkage"), ("name", STRONG, NUMBER), rows)


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


def _residual_table(noise_scale: Mapping[str, float]) -> Table:
    rows = [
        (
            channel,
            f"{scale:.2f}",
            cell(
                "bar", scale / LARGEST_RESIDUAL, mark=1.0 / LARGEST_RESIDUAL,
                over=scale > LARGE_RESIDUAL, long=True,
            ),
        )
        for channel, scale in sorted(noise_scale.items())
    ]  # fmt: skip
    return Table(("channel", "residual sd / noise sd", ""), ("name", STRONG, ""), rows)


def fit_section(fits: Sequence[Fit]) -> Section:
    """The fit of a few clips, those that were not fitted first."""
    clips: dict[str, list[Fit]] = {}
    for fit in sorted(fits, key=lambda fit: not fit.held_out):
        clips.setdefault(fit.clip, []).append(fit)
    folds = [
        Fold(
            clip,
            figures.fit_figure(group),
            "not fitted" if group[0].held_out else "fitted",
            open=number < OPEN_CLIPS,
        )
        for number, (clip, group) in enumerate(list(clips.items())[:MAX_CLIPS])
    ]
    legend = figures.fit_legend("the initial parameters", "the identified parameters")
    return Section("Measured against predicted", legend=legend, folds=folds)


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
    parts = [f"{clips.fitted_of} were fitted" + f" and {clips.held_out} held out" * (clips.held_out > 0)]
    parts += [f"{numbers.joined(dropped)} were dropped"] if dropped else []
    parts += [f"{result.diverged:,} of {result.rollouts:,} rollouts diverged"] if result.diverged else []
    return Section("Data", text="".join(f"{part}. " for part in parts), items=result.logs, files=True)
