"""What a result means, in sentences: what may be trusted, and what may not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from amhe_cli.estimation.offline.result import VERDICTS, Combination, HeldOut, Identification, ParameterResult
from amhe_cli.report import numbers

#: Residuals this many times the declared noise are worth a word.
LARGE_RESIDUAL = 2.0

#: Combinations that are named outside their own table.
MAX_COMBINATIONS = 3


@dataclass(frozen=True, slots=True)
class Statement:
    """A sentence, and whether it is good news."""

    tone: Literal["good", "mixed", "bad"]
    text: str


def headline(result: Identification) -> str:
    """The result in one line."""
    count = sum(p.verdict == "identified" for p in result.parameters)
    total = len(result.parameters)
    if count == total:
        return "All parameters are identified." if total > 1 else "The parameter is identified."
    if count == 0:
        return "No parameter is identified by these logs."
    return f"{count} of {total} parameters {'is' if count == 1 else 'are'} identified."


def statements(result: Identification) -> list[Statement]:
    """What a reader should know before using a number, most important first."""
    return [
        *_stopped(result),
        *_validation(result.held_out),
        *_verdicts(result.parameters),
        *_combinations(result),
        *_residuals(result),
        *_divergence(result),
    ]


def _stopped(result: Identification) -> Iterator[Statement]:
    if result.interrupted:
        yield Statement("bad", "The search was interrupted; the values are the best it had, not its end.")


def _validation(held_out: HeldOut | None) -> Iterator[Statement]:
    if held_out is None or held_out.clips == 0:
        yield Statement("bad", "Nothing was held out, so nothing shows that the values predict unseen data.")
        return
    clips = (
        f"{held_out.clips} clips that were not fitted" if held_out.clips > 1 else "a clip that was not fitted"
    )
    costs = f"from {held_out.initial_cost:.3g} to {held_out.cost:.3g}"
    if held_out.cost < held_out.initial_cost:
        yield Statement("good", f"On {clips} the cost falls {costs}{_errors(held_out)}.")
    else:
        yield Statement(
            "bad",
            f"On {clips} the cost does not fall ({costs}): the values do not predict unseen data better "
            "than the initial ones. Do not use them before you know why.",
        )


def _errors(held_out: HeldOut) -> str:
    parts = []
    if math.isfinite(held_out.position_error_m):
        before, after = held_out.initial_position_error_m, held_out.position_error_m
        parts.append(f"the mean position error from {numbers.length(before)} to {numbers.length(after)}")
    if math.isfinite(held_out.orientation_error_rad):
        before, after = held_out.initial_orientation_error_rad, held_out.orientation_error_rad
        parts.append(f"the mean orientation error from {numbers.angle(before)} to {numbers.angle(after)}")
    return "".join(f", {part}" for part in parts)


def _verdicts(parameters: Sequence[ParameterResult]) -> Iterator[Statement]:
    """One sentence per verdict that is not 'identified'; the table has the rest."""
    tones: dict[str, Literal["good", "mixed", "bad"]] = {
        "weak": "mixed",
        "prior": "mixed",
        "model-sensitive": "bad",
    }
    for verdict, tone in tones.items():
        names = [p.name for p in parameters if p.verdict == verdict]
        if names:
            yield Statement(tone, f"{joined(names)}: {VERDICTS[verdict]}.")


def known_together(result: Identification) -> list[Combination]:
    """Combinations that are known better than any of their parts, best first."""
    relative = {p.name: p.sd / abs(p.estimate) for p in result.parameters if p.estimate}
    return sharper(result.combinations, relative)


def sharper(combinations: Sequence[Combination], relative: Mapping[str, float]) -> list[Combination]:
    """Those that are known better than any of their factors, whose relative sd are given, best first."""

    def parts(combination: Combination) -> Iterator[float]:
        for factor in combination.text.replace(" / ", " * ").split(" * "):
            yield relative.get(factor.partition("^")[0], math.inf)

    return sorted((c for c in combinations if c.sd < min(parts(c))), key=lambda c: c.sd)


def _combinations(result: Identification) -> Iterator[Statement]:
    best = known_together(result)[:MAX_COMBINATIONS]
    if best:
        known = ", ".join(f"{c.text} to {numbers.percent(c.sd)}" for c in best)
        yield Statement("good", f"Known together, better than apart: {known}.")


def _residuals(result: Identification) -> Iterator[Statement]:
    for channel, scale in result.noise_scale.items():
        if scale > LARGE_RESIDUAL:
            yield Statement(
                "mixed",
                f"Residuals of {channel} are {scale:.2g} times the declared noise: the model misses "
                "something there, or the noise is larger than declared.",
            )


def _divergence(result: Identification) -> Iterator[Statement]:
    if result.diverged:
        share = numbers.percent(result.diverged / max(result.rollouts, 1))
        yield Statement(
            "mixed" if result.diverged > 0.05 * result.rollouts else "good",
            f"{result.diverged:,} of {result.rollouts:,} rollouts ({share}) diverged and were ruled out.",
        )


def joined(names: Sequence[str]) -> str:
    """'a, b and c'."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
