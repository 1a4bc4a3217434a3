"""`report.html`: everything about an identification on one page that opens without a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from amhe_cli.estimation.offline.result import VERDICTS, Fit, Identification, ParameterResult
from amhe_cli.report import figures, numbers, words

#: Clips whose fit is drawn, and how many of them are open at once.
MAX_CLIPS, OPEN_CLIPS = 3, 2

#: Half-width of the strip that sets prior and posterior side by side, in prior sd.
STRIP = 2.5


@dataclass(frozen=True, slots=True)
class Strip:
    """Where things stand on a line from -STRIP to STRIP prior sd about the prior, in percent of it."""

    left: float
    width: float
    mark: float
    prior_left: float
    prior_width: float


def identification_page(
    result: Identification, record: Mapping[str, Any], origin: Mapping[str, object]
) -> str:
    """The page.

    Args:
        result: What was found.
        record: Content of result.json: seconds, warnings, version.
        origin: Provenance: versions, hashes, seed, command.
    """
    return template("identification.html.j2").render(
        result=result,
        record=record,
        origin=origin,
        sharp=words.known_together(result),
        headline=words.headline(result),
        statements=words.statements(result),
        verdicts=VERDICTS,
        strips=_strips(result),
        fits=_fit_figures(result.fits),
        convergence=_figure(figures.convergence_figure, result.iterations, result.belief),
        correlations=_correlations(result),
        profiles=_figure(figures.profile_figure, result.parameters),
        residuals=sorted(result.noise_scale.items()),
    )


@cache
def template(name: str):
    """A template of this room; in it `n` is how numbers are written."""
    environment = Environment(
        loader=PackageLoader("amhe_cli.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["n"] = numbers
    return environment.get_template(name)


def _figure(draw: Any, *content: Any) -> Markup | None:
    """An SVG for the page; None where there is nothing to draw."""
    if not content[0]:
        return None
    svg = draw(*content)
    return Markup(svg) if svg else None


def _correlations(result: Identification) -> Markup | None:
    if len(result.parameters) < 2:
        return None
    return Markup(figures.correlation_figure(result.belief.names, result.correlations))


def _fit_figures(fits: Sequence[Fit]) -> list[dict[str, Any]]:
    """Clips to show, those that were not fitted first."""
    clips: dict[str, list[Fit]] = {}
    for fit in sorted(fits, key=lambda fit: not fit.held_out):
        clips.setdefault(fit.clip, []).append(fit)
    return [
        {
            "clip": clip,
            "held_out": group[0].held_out,
            "open": number < OPEN_CLIPS,
            "svg": Markup(figures.fit_figure(group)),
        }
        for number, (clip, group) in enumerate(list(clips.items())[:MAX_CLIPS])
    ]


def _strips(result: Identification) -> dict[str, Strip]:
    return {p.name: _strip(p, log) for p, log in zip(result.parameters, result.belief.log, strict=True)}


def _strip(p: ParameterResult, log: bool) -> Strip:
    def place(value: float) -> float:
        """Percent of the strip's width, on the parameter's own scale."""
        if log:
            away = (np.log(max(value, 1e-300)) - np.log(p.prior)) / (p.prior_sd / p.prior)
        else:
            away = (value - p.prior) / p.prior_sd
        return float(np.clip(50.0 + 50.0 * away / STRIP, 0.0, 100.0))

    left, right = place(p.lower), place(p.upper)
    half = 50.0 * 1.645 / STRIP
    return Strip(left, max(right - left, 0.8), place(p.estimate), 50.0 - half, 2.0 * half)
