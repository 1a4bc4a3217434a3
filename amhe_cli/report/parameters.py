"""Tables of an identification: parameters with the reasons of their verdicts, budgets, inertias."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from amhe_cli.core.statistics import Z90
from amhe_cli.estimation.core.result import VERDICTS, Identification, ParameterResult
from amhe_cli.estimation.uncertainty.ledger import KINDS, LEAST
from amhe_cli.report import figures, numbers
from amhe_cli.report.page import Section, cell
from amhe_cli.report.tables import NUMBER, STRONG, VERDICT, Table

#: Half-width of the strip that shows prior and posterior side by side, in prior sd.
STRIP = 2.5
#: Of more parameters than this, those that rest on their priors stand apart.
_LINES = 24
#: Colour of each kind of term of the ledger.
_HUES = "after", "prior", "violet", "red", "mixed", "teal", "brown", "amber", "measured", "green"
_COLORS = dict(zip(KINDS, _HUES, strict=True))


def parameter_sections(result: Identification, truth: Mapping[str, float]) -> Iterator[Section]:
    """Each parameter with its verdict, and below them the reasons that many share.

    Of many parameters, those that the logs hardly narrow down have a part of their own, which is closed.

    Args:
        result: The identification.
        truth: True values that the logs contain, by name.
    """
    common = common_reasons(result.lines)
    meanings = Markup(" ").join(
        Markup("{} {}.").format(cell("verdict", name), text) for name, text in VERDICTS.items()
    )
    log = dict(zip((p.name for p in result.parameters), result.belief.log, strict=True))
    rows, apart = ([(p, log.get(p.name, False)) for p in some] for some in parted(result.lines))
    yield Section(
        "Parameters",
        table=_parameter_table(rows, truth, common),
        items=[f"{place}: {one.text}: {', '.join(one.owners)}" for place, one in enumerate(common, 1)],
        note=meanings
        + " Shrinkage is how much narrower the posterior is than the prior; at 0 % the logs added nothing.",
    )
    if apart:
        title = f"{len(apart)} parameters that the logs hardly narrow down"
        yield Section(title, table=_parameter_table(apart, truth, common), folded=True)


def parted(parameters: Sequence[ParameterResult]) -> tuple[list[ParameterResult], list[ParameterResult]]:
    """Parameters with a line of their own and, of many, apart from them those that rest on their priors."""
    many = len(parameters) > _LINES
    found: tuple[list[ParameterResult], list[ParameterResult]] = [], []
    for p in parameters:
        found[many and p.verdict == "prior"].append(p)
    return found


def _parameter_table(
    known: Sequence[tuple[ParameterResult, bool]], truth: Mapping[str, float], common: Sequence[Shared]
) -> Table:
    rows = [
        (
            p.name,
            p.verdict,
            cell("measure", numbers.with_sd(p.estimate, p.sd), numbers.unit_of(p.unit)),
            numbers.interval(p.lower, p.upper),
            numbers.with_sd(p.prior, p.prior_sd),
            _strip(p, log),
            cell("bar", p.shrinkage, numbers.shrinkage(p.shrinkage)),
        )
        for p, log in known
    ]
    head = (
        "parameter",
        "verdict",
        "estimate ± sd",
        "90 % interval",
        "prior",
        "prior and posterior",
        "shrinkage",
    )
    looks = ("name", VERDICT, STRONG, NUMBER, f"{NUMBER} soft", "spare", NUMBER)
    return Table(head, looks, rows, [_remark(p, truth, common) for p, _ in known])


def _strip(p: ParameterResult, log: bool) -> Markup:
    """Prior, posterior and estimate between -STRIP and STRIP prior sd, on the parameter's own scale."""

    def place(value: float) -> float:
        """Percent of the strip's width."""
        apart = figures.away(np.array(max(value, 1e-300) if log else value), p.prior, p, log)
        return float(np.clip(50.0 + 50.0 * apart / STRIP, 0.0, 100.0))

    left, right, half = place(p.lower), place(p.upper), 50.0 * Z90 / STRIP
    return cell("strip", (50.0 - half, 50.0 + half), (left, max(right, left + 0.8)), place(p.estimate))


def _remark(p: ParameterResult, truth: Mapping[str, float], common: Sequence[Shared]) -> str:
    """Why the verdict is what it is; where other parameters share the reason, its number below the table."""
    alone, places = own_reasons(p, common)
    parts = ["; ".join(alone)] if alone else []
    if places:
        parts.append(f"reason{'s' * (len(places) > 1)} {numbers.joined([str(n) for n in places])} below")
    if p.name in truth:
        parts.append(f"true value in the log {numbers.quantity(f'{truth[p.name]:g}', p.unit)}")
    return " · ".join(parts)


def budget_section(parameters: Sequence[ParameterResult]) -> Section:
    """Where the variance of each parameter comes from, and how far it owes to its prior."""
    shown = [
        [(kind, p.budget[kind]) for kind in KINDS if p.budget.get(kind, 0.0) >= LEAST] for p in parameters
    ]
    rows = [
        (
            p.name,
            numbers.quantity(numbers.rounded(p.sd, p.sd, max(abs(p.estimate), p.sd)), p.unit),
            cell("shares", [(kind, share, _COLORS[kind]) for kind, share in shares]),
            ", ".join(f"{kind} {100.0 * share:.0f} %" for kind, share in sorted(shares, key=lambda s: -s[1])),
            _share_of_sd(p),
        )
        for p, shares in zip(parameters, shown, strict=True)
    ]
    head = ("parameter", "sd", "variance", "", "with twice the prior's sd")
    kinds = [kind for kind in KINDS if any(kind == name for shares in shown for name, _ in shares)]
    meanings = Markup("; ").join(cell("key", kind, KINDS[kind], _COLORS[kind]) for kind in kinds)
    return Section(
        "Where each interval comes from",
        text=meanings + ". The last column says by how much of its sd the estimate would move.",
        table=Table(head, ("name", STRONG, "", "soft text", NUMBER), rows),
        folded=True,
    )


def _share_of_sd(p: ParameterResult) -> str:
    """How far the estimate would move with twice the prior's sd: '12 %' of its own."""
    share = abs(p.doubled_prior) / p.sd if p.sd else math.nan
    return f"{100.0 * share:.0f} %" if math.isfinite(share) else numbers.MISSING


#: A reason of so many parameters is said below their table, not in each row.
MANY = 3

_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?(?: %)?")


@dataclass(frozen=True, slots=True)
class Shared:
    """A reason of several parameters, which may differ in numbers.

    Args:
        pattern: The reason without its numbers.
        text: The reason; a number that differs is a range.
        names: The parameters.
        owners: The parameters, each with the numbers of its own in brackets.
    """

    pattern: str
    text: str
    names: tuple[str, ...]
    owners: tuple[str, ...]


def merged(reasons: Iterable[tuple[str, str]]) -> list[Shared]:
    """Names and reasons of parameters, those together that differ in numbers alone."""
    groups: dict[str, list[tuple[str, str]]] = {}
    for name, reason in reasons:
        groups.setdefault(_pattern(reason), []).append((name, reason))
    return [_shared(pattern, group) for pattern, group in groups.items()]


def common_reasons(parameters: Sequence[ParameterResult]) -> list[Shared]:
    """The reasons that `MANY` parameters have, the most frequent first."""
    found = merged((p.name, reason) for p in parameters for reason in reason_texts(p))
    return sorted((one for one in found if len(one.names) >= MANY), key=lambda one: -len(one.names))


def own_reasons(parameter: ParameterResult, common: Sequence[Shared]) -> tuple[list[str], list[int]]:
    """The reasons that only a parameter has, and the places, from 1, of those that it shares."""
    places = {one.pattern: place for place, one in enumerate(common, 1)}
    texts = reason_texts(parameter)
    alone = [text for text in texts if _pattern(text) not in places]
    return alone, sorted(places[_pattern(text)] for text in texts if text not in alone)


def reason_texts(parameter: ParameterResult) -> list[str]:
    """The reasons in words; what a conditional value rests on comes first, however small its share."""
    texts, given = [reason.text for reason in parameter.reasons], parameter.given
    if given and not any(given in text for text in texts):
        texts.append(f"given {given}")
    return sorted(texts, key=lambda text: given not in text)


def _pattern(reason: str) -> str:
    """A reason without its numbers."""
    return _NUMBER.sub(lambda number: "# %" if number[0].endswith("%") else "#", reason)


def _shared(pattern: str, group: Sequence[tuple[str, str]]) -> Shared:
    columns = list(zip(*(_NUMBER.findall(reason) for _, reason in group), strict=True))
    ranges = iter(map(_range, columns))
    text = _NUMBER.sub(lambda _: next(ranges), group[0][1])
    own = list(zip(*(column for column in columns if len(set(column)) > 1), strict=True))
    names = tuple(name for name, _ in group)
    owners = (
        (f"{name} ({', '.join(numbers)})" for name, numbers in zip(names, own, strict=True)) if own else names
    )
    return Shared(pattern, text, names, tuple(owners))


def _range(column: Sequence[str]) -> str:
    """'2.9 to 7.9' of numbers that differ."""
    least, *_, most = sorted((*column, column[0]), key=lambda number: float(number.rstrip(" %")))
    return most if least == most else f"{least.removesuffix(' %')} to {most}"
