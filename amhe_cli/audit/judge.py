"""Does a log contradict a number of a file? Which data sheets are wrong, and the test of each number.

**Data sheets.** Numbers of a group stand on one data sheet. If it is right, the truth is within its sd S of
what the file says, else within a wide W. For each set of wrong sheets, the evidence of the logs is that of a
linear model with normal errors: with the logs' information A, and their score r at the file's values,

    log Z = 1/2 r' (A + P^-1)^-1 r - 1/2 log det(1 + A P),   P = diag(S^2 or W^2).

Sets are searched from one that is known, sheets added, taken back or put in another's place (Bayesian
variable selection: George and McCulloch 1993); and once more without each sheet of the best set. So one wrong
number is distinguished from two that could make up for it.

**Numbers.** What the file says, with the sd of its data sheet, is compared with what the log says with all
other numbers at their own sheets, but for those that are wrong: the number's own prior is taken out of the
estimate, or it would speak for itself (Marshall and Spiegelhalter 2007, "Identifying outliers in Bayesian
hierarchical models"). With the posterior N(m, V) of phi under the prior N(n, p) the log says

    precision  q = 1 / V - 1 / p,   mean  c = (m / V - n / p) / q,

and further errors e of m, of the ledger, are errors e / (V q) of c. The statistic is

    t = (c - f) / sqrt(1 / q + e / (V q)^2 + s^2),

which noise and the data sheets make a standard normal number. Where c is less than a number may be, such as
a negative friction, t^2 is by how much worse the file explains the log than the best that may be. A data
sheet errs by a share, its logarithm phi by a length; a log shows the number itself, for a force is
proportional to a mass. So t is the lesser of the two: where the log's error is normal in phi, and where it is
in exp(phi) (`_proportional`).

A number's chance is that its sheet is right and a right one differs more: the mean over the sets, by how
likely these are, of the chances of t, where a set without its sheet has none (Meng 1994, "Posterior
predictive p-values"); or that of t with the sheets of the best set left open, if that is larger. What other
wrong numbers explain as well is so not contradicted, nor is what stands on a wrong sheet and is right.

Of many numbers some differ by chance: Holm's steps (1979) keep the chance that a table calls any right number
contradicted at 5 %, and so the share of such verdicts that are wrong.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from math import erfc, sqrt
from typing import Generic, TypeVar

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed

#: Name of a group of numbers.
K = TypeVar("K", bound=Hashable)
#: Share of tables that may call a right number contradicted.
RATE = 0.05
#: Logarithm of the odds that a data sheet is right: one of twenty is wrong.
ODDS = 3.0
#: Sets of other wrong sheets under which a number is tested.
_SETS = 4
#: The least of a logarithm of odds that is worth a step: rounding leads nowhere.
_LEAST = 1e-3
#: The least of anything that is divided by.
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What logs say of d parameters, all on their own scales phi.

    Args:
        mean: The estimate, shape (d,), as without bounds: the minimum of the linearised cost.
        prior: Mean and sd of the priors that it was made with, shape (2, d).
        information: Of the logs, shape (d, d).
        covariance: Of the estimate, with all terms of its ledger, shape (d, d).
        at: Where the logs were linearised, shape (d,).
    """

    mean: FloatArray
    prior: FloatArray
    information: FloatArray
    covariance: FloatArray
    at: FloatArray

    def known(self) -> FloatArray:
        """Covariance that noise and priors leave, shape (d, d)."""
        return sealed(np.linalg.inv(self.information + np.diag(self.prior[1] ** -2.0)))

    def with_priors(self, sd: FloatArray) -> Findings:
        """The same logs under priors of other sd (d,), as far as they are linear."""
        known = np.linalg.inv(self.information + np.diag(sd**-2.0))
        mean = known @ (self.score() + sd**-2.0 * self.prior[0])
        covariance = known + self.covariance - self.known()
        return Findings(mean, np.array([self.prior[0], sd]), self.information, covariance, self.at)

    def under_noise(self, scale: float) -> Findings:
        """The same logs, as far as they are linear, if the sd of what they leave is larger by a factor."""
        score, precision = self.score() / scale**2, np.diag(self.prior[1] ** -2.0)
        information = self.information / scale**2
        known = np.linalg.inv(information + precision)
        covariance = known + scale**2 * (self.covariance - self.known())
        return Findings(
            known @ (score + precision @ self.prior[0]), self.prior, information, covariance, self.at
        )

    def unsure(self, way: FloatArray) -> Findings:
        """The same, where the estimate may be off by a way (d,), too."""
        return replace(self, covariance=self.covariance + np.outer(way, way))

    def score(self) -> FloatArray:
        """Information times what the logs alone would say, shape (d,)."""
        return self.information @ self.mean + self.prior[1] ** -2.0 * (self.mean - self.prior[0])


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What the logs say of each of some numbers, whatever the file says of it, shape (k,) each.

    Args:
        mean, sd: On the parameters' scales, no less than may be; an infinite sd where they say nothing.
        t: How far from what the file says, in sd of both.
    """

    mean: FloatArray
    sd: FloatArray
    t: FloatArray


def said(
    evidence: Findings,
    rows: Sequence[int],
    file: FloatArray,
    sheet: FloatArray,
    log: BoolArray,
    least: FloatArray | float = -np.inf,
) -> Said:
    """What the logs say of single numbers.

    Args:
        evidence: The estimate.
        rows: The numbers' parameters.
        file, sheet: What the file says of them, and the sd of its data sheet, shape (k,).
        log: Which of them are logarithms, shape (k,).
        least: The least that each may be, shape (k,).
    """
    known, at = evidence.known().diagonal()[list(rows)], list(rows)
    more = np.maximum(evidence.covariance.diagonal()[at] - known, 0.0)
    (n, p), m = evidence.prior[:, at], evidence.mean[at]
    q = np.maximum(1.0 / known - p**-2.0, _TINY * p**-2.0)
    mean = (m / known - n / p**2) / q
    sd = np.sqrt(1.0 / q + more / (known * q) ** 2)
    return compared(mean, sd, file, sheet, log, least, evidence.at[at])


def compared(
    mean: FloatArray, sd: FloatArray, file: FloatArray, sheet: FloatArray, log: BoolArray,
    least: FloatArray | float, at: FloatArray,
) -> Said:  # fmt: skip
    """What the logs say of numbers, `at` whose values (k,) they were linearised, against the file."""
    best = np.maximum(mean, least)
    true = np.maximum((mean * sheet**2 + file * sd**2) / (sd**2 + sheet**2), least)  # if the sheet is right
    worse = ((mean - true) / sd) ** 2 + ((true - file) / sheet) ** 2 - ((mean - best) / sd) ** 2
    t = np.sign(best - file) * np.sqrt(np.maximum(worse, 0.0))
    other = np.sign(t) * _proportional(mean - at, sd, file - at, sheet)
    return Said(best, sd, np.where(log & (np.abs(other) < np.abs(t)), other, t))


def averaged(
    several: Sequence[Said], share: Sequence[float], file: FloatArray, sheet: FloatArray, log: BoolArray,
    least: FloatArray | float, at: FloatArray,
) -> Said:  # fmt: skip
    """What the logs say of k numbers by several explanations, each with its share: the mixture's mean and sd.

    Other arguments as of `said`; `at`: where the logs were linearised, shape (k,).
    """
    weight = np.array(share)[:, None] / sum(share)
    phi, sds = np.array([one.mean for one in several]), np.array([one.sd for one in several])
    top = phi.max(axis=0)  # logarithms are averaged as numbers: those of almost nothing differ by much
    size = np.where(log, np.exp(phi - top), 1.0)
    means, sds = np.where(log, size, phi), size * sds
    mean = (weight * means).sum(axis=0)
    sd = np.sqrt((weight * (sds**2 + (means - mean) ** 2)).sum(axis=0))
    number = np.where(log, mean, 1.0)
    mean, sd = np.where(log, top + np.log(number), mean), sd / number
    return compared(mean, sd, file, sheet, log, least, at)


def _proportional(said: FloatArray, sd: FloatArray, file: FloatArray, sheet: FloatArray) -> FloatArray:
    """How far apart a log and a file are, where the log's error is normal in exp(phi), shape (k,).

    It is the root of the least sum of squares that a value leaves, in sd of both.

    Args:
        said, sd: What the log says of phi, from where it was linearised.
        file, sheet: What the file says of it.
    """
    shares = np.linspace(0.0, 1.0, 2001)[:, None]  # of the way from the file's value to the log's
    there = np.log(np.maximum(1.0 + said, _TINY))
    phi = file + shares * (there - file)
    off = np.expm1(np.minimum(phi, 50.0)) - said
    return np.sqrt(((off / sd) ** 2 + ((phi - file) / sheet) ** 2).min(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Sheets(Generic[K]):
    """Data sheets: what the file says of all parameters, and how far they may be off, shape (d,) each.

    Args:
        groups: The numbers on each, as parameters.
        file: What the file says.
        right, wide: Sd of a sheet that is right, and of one that is wrong.
        least: The least that a number may be, minus infinity where it may be anything.
    """

    groups: Mapping[K, Sequence[int]]
    file: FloatArray
    right: FloatArray
    wide: FloatArray
    least: FloatArray | float = -np.inf

    def sd(self, wrong: Collection[K]) -> FloatArray:
        """Sd of all parameters where some sheets are wrong, shape (d,)."""
        rows = [row for name in wrong for row in self.groups[name]]
        return np.where(np.isin(np.arange(len(self.right)), rows), self.wide, self.right)


def wrong_sheets(
    evidence: Findings,
    sheets: Sheets[K],
    begin: frozenset[K] = frozenset(),
    right: frozenset[K] = frozenset(),
) -> dict[frozenset[K], float]:
    """Sets of data sheets that may be wrong -> logarithm of how likely each is, the likeliest first.

    Args:
        evidence: What the logs say.
        sheets: The data sheets.
        begin: The set from which the search begins.
        right: Sheets that are believed.
    """
    found = {begin: 0.0}
    best = _climbed(evidence, sheets, found, begin, right)
    for name in best:  # what explains the logs if this one is right
        _climbed(evidence, sheets, found, best - {name}, right | {name})
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _climbed(
    evidence: Findings, sheets: Sheets[K], found: dict[frozenset[K], float], at: frozenset[K], barred: Set[K]
) -> frozenset[K]:
    """The set from which no step leads to a likelier one; what is seen on the way comes to those `found`."""
    information = evidence.information
    score = evidence.score() - information @ sheets.file
    while True:
        near = _changed(information, score, sheets, at)
        for less in at:  # another in its place
            fewer = at - {less}
            swapped = _changed(information, score, sheets, fewer)
            near |= {other: near[fewer] + more for other, more in swapped.items()}
        near = {other: found[at] + more for other, more in near.items() if not other & barred}
        for other, value in near.items():
            found.setdefault(other, value)
        best = max(near, key=found.__getitem__, default=at)
        if not near or found[best] <= found[at] + _LEAST:
            return at
        at = best


def judged(
    evidence: Findings,
    sheets: Sheets[K],
    likely: Mapping[frozenset[K], float],
    rows: Sequence[int],
    log: BoolArray,
) -> tuple[Said, FloatArray]:
    """Tests of single numbers, by the sets of wrong sheets that are likely.

    Args:
        evidence: The estimate.
        sheets: The data sheets.
        likely: Sets, the likeliest first, of `wrong_sheets`.
        rows: The numbers' parameters, each on a sheet.
        log: Which of them are logarithms, shape (k,).

    Returns:
        What the logs say with the priors of the estimate, and the chance of each number (k,).
    """
    sheet, at = {row: name for name, group in sheets.groups.items() for row in group}, list(rows)
    names, least = [sheet[row] for row in rows], np.broadcast_to(sheets.least, sheets.file.shape)[at]
    of = sheets.file[at], sheets.right[at], log, least
    chance, weight, seen, right = np.zeros((4, len(rows)))
    weights = np.exp(np.array(list(likely.values())) - max(likely.values()))
    several = list[Said]()
    for one, share in zip(likely, weights / weights.sum(), strict=True):
        believed = np.array([name not in one for name in names])
        right += believed * share
        tested = believed & (seen < _SETS)
        if tested.any() or len(several) < _SETS:
            under = said(evidence.with_priors(sheets.sd(one)), rows, *of)
            several += [under] if len(several) < _SETS else []
            far = chances(under.t)
            chance, weight, seen = chance + tested * share * far, weight + tested * share, seen + tested
    here = averaged(several, weights[: len(several)].tolist(), *of, evidence.at[at])
    return here, np.maximum(chances(here.t), right * chance / np.maximum(weight, 1e-300))


def _changed(
    information: FloatArray, score: FloatArray, sheets: Sheets[K], wrong: frozenset[K]
) -> dict[frozenset[K], float]:
    """Sets that differ from one by one sheet -> logarithm of by how much likelier they are."""
    sd = sheets.sd(wrong)
    known = np.linalg.inv(information + np.diag(sd**-2.0))
    # information - information @ known @ information, and likewise of the score: much may be known of little
    open_to = np.diag(sd**-2.0) - known / np.outer(sd, sd) ** 2
    left, found = known @ score / sd**2, dict[frozenset[K], float]()
    for name, rows in sheets.groups.items():
        at, back = list(rows), name in wrong
        more = (sheets.wide[at] ** 2 - sheets.right[at] ** 2) * (-1.0 if back else 1.0)
        spread = np.eye(len(at)) + more[:, None] * open_to[np.ix_(at, at)]
        u = left[at]
        gain = 0.5 * float(u @ np.linalg.solve(spread, more * u) - np.linalg.slogdet(spread)[1])
        found[wrong ^ {name}] = gain + (ODDS if back else -ODDS)
    return found


def chances(t: FloatArray) -> FloatArray:
    """Probabilities that a normal number is farther from zero than each of t (k,)."""
    return np.array([erfc(abs(one) / sqrt(2.0)) for one in t])


def contradicted(chance: FloatArray) -> BoolArray:
    """Which numbers of a table are contradicted, where RATE of all tables may say so of a right one.

    Args:
        chance: Each number's chance to differ so much from its file, shape (k,).
    """
    order = np.argsort(chance)
    below = chance[order] <= RATE / np.arange(len(chance), 0, -1)
    found = np.zeros(len(chance), dtype=bool)
    found[order[np.logical_and.accumulate(below)]] = True
    return found
