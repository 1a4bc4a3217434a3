"""`report.html` of an identification, and what it states in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from amhe_cli.core.statistics import Z90
from amhe_cli.estimation.offline.result import (
    VERDICTS,
    Fit,
    Identification,
    ParameterResult,
    known_together,
)
from amhe_cli.report import figures, numbers
from amhe_cli.report.bodies import body_table
from amhe_cli.report.held_out import held_out_sections, held_out_statement
from amhe_cli.report.page import Fold, Key, Section, Statement, Tone, cell, fixed_statement, result_page
from amhe_cli.report.sampled import sampled_sections, sampled_statements
from amhe_cli.report.tables import NUMBER, STRONG, Table

#: Clips whose fit is drawn, and how many of them are open at once.
MAX_CLIPS, OPEN_CLIPS = 3, 2

#: Half-width of the strip that shows prior and posterior side by side, in prior sd.
STRIP = 2.5

#: Residuals of more than this many times the declared noise are pointed out, and the bars' right end.
LARGE_RESIDUAL, LARGEST_RESIDUAL = 2.0, 5.0

#: Combinations that are named outside their own table.
MAX_COMBINATIONS = 3

_TONES: Mapping[str, Tone] = {"weak": "mixed", "prior": "mixed", "model-sensitive": "bad"}


def identification_page(
    result: Identification,
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
    pictures: Iterable[tuple[str, str]] = (),
) -> str:
    """The page as HTML.

    Args:
        result: The identification.
        record: Content of result.json.
        provenance: Versions, hashes, seed and command.
        pictures: Names and SVG elements of clips, measured and predicted.
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
        sections=list(_sections(result, record["truth"], list(pictures))),
    )


def headline(result: Identification) -> str:
    """The result in one line."""
    count = sum(p.verdict == "identified" for p in result.parameters)
    total = len(result.parameters)
    if count == total:
        return "All parameters are identified." if total > 1 else "The parameter is identified."
    if result.unexplained:
        return f"No parameter is identified: {result.unexplained[0]}."
    if count == 0:
        return "No parameter is identified by these logs."
    return f"{count} of {total} parameters {'is' if count == 1 else 'are'} identified."


def statements(result: Identification) -> list[Statement]:
    """What a reader should know before using a number, most important first."""
    return [
        *_stopped(result),
        *_unexplained(result),
        *held_out_statement(result.held_out),
        *_verdicts(result.parameters),
        *_combinations(result),
        *sampled_statements(result),
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


def _sections(
    result: Identification, truth: Mapping[str, float], pictures: Sequence[tuple[str, str]]
) -> Iterator[Section]:
    yield Section("Parameters", table=_parameter_table(result, truth), note=_legend_of_verdicts())
    yield from sampled_sections(result)
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
    if result.fits:
        yield fit_section(result.fits)
    if pictures:
        yield Section(
            "At three instants",
            text="A clip after one third and after two thirds of its time, and at its end. Where a colour "
            "cannot be seen, that prediction lies on the measured body.",
            legend=(
                Key("predicted with the nominal parameters", figures.INITIAL, "patch"),
                Key("predicted with the identified parameters", figures.IDENTIFIED, "patch"),
            ),
            folds=[Fold(name, Markup(svg)) for name, svg in pictures],
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
            "dashed: prior. A flat line means that the logs hardly narrow the parameter down.",
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
            text=f"{len(result.iterations)} iterations of the method {result.method}.",
            figure=figures.convergence_figure(result.iterations, result.belief),
        )
    yield _data_section(result)


def _parameter_table(result: Identification, truth: Mapping[str, float]) -> Table:
    rows = [
        (
            p.name,
            numbers.with_sd(p.estimate, p.sd),
            numbers.unit_of(p.unit),
            numbers.interval(p.lower, p.upper),
            numbers.with_sd(p.prior, p.prior_sd),
            _strip(p, log),
            cell("bar", p.shrinkage, numbers.shrinkage(p.shrinkage)),
            cell("verdict", p.verdict),
        )
        for p, log in zip(result.parameters, result.belief.log, strict=True)
    ]
    return Table(
        (
            "parameter", "estimate ± sd", "unit", "90 % interval", "prior", "prior and posterior",
            "shrinkage", "verdict",
        ),
        ("name", STRONG, "unit", NUMBER, f"{NUMBER} soft", "spare", NUMBER, ""),
        rows,
        [_remark(p, truth) for p in result.parameters],
    )  # fmt: skip


def _strip(p: ParameterResult, log: bool) -> Markup:
    """Prior, posterior and estimate between -STRIP and STRIP prior sd, on the parameter's own scale."""

    def place(value: float) -> float:
        """Percent of the strip's width."""
        if log:
            away = (np.log(max(value, 1e-300)) - np.log(p.prior)) / (p.prior_sd / p.prior)
        else:
            away = (value - p.prior) / p.prior_sd
        return float(np.clip(50.0 + 50.0 * away / STRIP, 0.0, 100.0))

    left, right, half = place(p.lower), place(p.upper), 50.0 * Z90 / STRIP
    return cell("strip", (50.0 - half, 50.0 + half), (left, max(right, left + 0.8)), place(p.estimate))


def _remark(p: ParameterResult, truth: Mapping[str, float]) -> str:
    """Why the verdict is what it is, and other numbers of the parameter."""
    parts = ["; ".join(p.reasons) or VERDICTS[p.verdict]]
    if p.bootstrap_sd > 0.0:
        spread = numbers.quantity(numbers.rounded(p.bootstrap_sd, p.bootstrap_sd), p.unit)
        parts.append(f"sd over resampled clips {spread}")
    if p.name in truth:
        parts.append(f"true value in the log {numbers.quantity(f'{truth[p.name]:g}', p.unit)}")
    if math.isfinite(p.step_ratio):
        parts.append(f"step-doubling ratio {p.step_ratio:.2f}")
    return " · ".join(parts)


def _legend_of_verdicts() -> Markup:
    meanings = Markup(" ").join(
        Markup("{} {}.").format(cell("verdict", name), text) for name, text in VERDICTS.items()
    )
    return meanings + Markup(
        " Shrinkage is how much narrower the posterior is than the prior; at 0 % the logs added nothing. "
        "A step-doubling ratio far from 1 means that the sd itself is rough."
    )


def _combination_section(result: Identification) -> Section:
    known = known_together(result)
    rows = [
        (
            c.text,
            numbers.percent(c.sd),
            numbers.shrinkage(c.shrinkage),
            "well known" if c in known else "poorly known",
        )
        for c in result.combinations
    ]
    return Section(
        "Combinations",
        text="Where two parameters explain the same motion, one combination of them is known more precisely "
        "than either, and another stays poorly known.",
        table=Table(("combination", "sd", "shrinkage", ""), ("name", STRONG, NUMBER, "soft"), rows),
    )


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
    return Section(
        "Data",
        text=f"{clips.fitted_of} were fitted and {clips.held_out} held out. {clips.motionless} were "
        f"dropped because nothing moves in them, and {clips.across_gaps} because they contain a gap. "
        f"{result.diverged:,} of {result.rollouts:,} rollouts diverged.",
        items=result.logs,
        files=True,
    )
