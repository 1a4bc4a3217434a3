"""Does a log contradict a number of a file? The test, and which numbers are not believed.

The test of a number compares what the file says, with the sd of its data sheet, with what the log says with
all other numbers at their own data sheets: the number's own prior is taken out of the estimate, or it would
speak for itself (Marshall and Spiegelhalter 2007, "Identifying outliers in Bayesian hierarchical models").
With the posterior N(m, V) of phi under the prior N(n, p) the log says

    precision  q = 1 / V - 1 / p,   mean  c = (m / V - n / p) / q,

and further errors e of m, of the ledger, are errors e / (V q) of c. The statistic is

    t = (c - f) / sqrt(1 / q + e / (V q)^2 + s^2),

which noise and the data sheets make a standard normal number. One wrong number pulls at all others. So the
one whose data sheet is wrong with the largest Bayes factor is not believed any more: its prior becomes wide;
and so on, until no other stands out (Baarda's data snooping, by groups of numbers on one data sheet). Of a
group whose sheet has the width W if it is wrong, and S if it is right, the factor is that of two densities of
q (c - f): normal, with covariances q + q W q and q + q S q. What the log does not show adds nothing, and what
W leaves open without need counts against it.

Numbers that stood out at the same time may explain the same. One is only contradicted if it is so with the
others left open, too.

Of many numbers some differ by chance: Holm's steps (1979) keep the chance that a table calls any right number
contradicted at 5 %, and so the share of such verdicts that are wrong.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from math import erfc, sqrt
from typing import TypeVar

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.core.statistics import positive

#: Name of a group of numbers.
K = TypeVar("K", bound=Hashable)
#: Share of tables that may call a right number contradicted.
RATE = 0.05
#: Logarithm of a Bayes factor that is strong evidence (Kass and Raftery 1995, "Bayes factors").
_STRONG = 3.0
#: The least of anything that is divided by.
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What logs say of d parameters, all on their own scales phi.

    Args:
        mean: The estimate, shape (d,).
        prior: Mean and sd of the priors that it was made with, shape (2, d).
        information: Of the logs, shape (d, d).
        covariance: Of the estimate, with all terms of its ledger, shape (d, d).
    """

    mean: FloatArray
    prior: FloatArray
    information: FloatArray
    covariance: FloatArray

    def known(self) -> FloatArray:
        """Covariance that noise and priors leave, shape (d, d)."""
        return sealed(np.linalg.inv(self.information + np.diag(self.prior[1] ** -2.0)))

    def with_priors(self, sd: FloatArray) -> Findings:
        """The same logs under priors of other sd (d,), as far as they are linear."""
        precision = self.prior[1] ** -2.0
        score = self.information @ self.mean + precision * (self.mean - self.prior[0])
        matrix = self.information + np.diag(sd**-2.0)
        mean = np.linalg.solve(matrix, score + sd**-2.0 * self.prior[0])
        return Findings(mean, np.array([self.prior[0], sd]), self.information, sealed(np.linalg.inv(matrix)))


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What the logs say of each of some numbers, whatever the file says of it, shape (k,) each.

    Args:
        mean, sd: On the parameters' scales; an infinite sd where they say nothing.
        t: How far from what the file says, in sd of both.
    """

    mean: FloatArray
    sd: FloatArray
    t: FloatArray


def said(evidence: Findings, rows: Sequence[int], file: FloatArray, sheet: FloatArray) -> Said:
    """What the logs say of single numbers.

    Args:
        evidence: The estimate.
        rows: The numbers' parameters.
        file, sheet: What the file says of them, and the sd of its data sheet, shape (k,).
    """
    known, at = evidence.known().diagonal()[list(rows)], list(rows)
    more = np.maximum(evidence.covariance.diagonal()[at] - known, 0.0)
    (n, p), m = evidence.prior[:, at], evidence.mean[at]
    q = np.maximum(1.0 / known - p**-2.0, _TINY * p**-2.0)
    mean = (m / known - n / p**2) / q
    sd = np.sqrt(1.0 / q + more / (known * q) ** 2)
    return Said(mean, sd, (mean - file) / np.sqrt(sd**2 + sheet**2))


def outstanding(
    evidence: Findings,
    groups: Mapping[K, Sequence[int]],
    file: FloatArray,
    sheet: FloatArray,
    wide: FloatArray,
) -> list[K]:
    """The groups of numbers whose data sheet is wrong by strong evidence, each alone; the strongest first.

    Args:
        evidence: The estimate, every number with its data sheet's sd as its prior, or a wide one.
        groups: Numbers on one data sheet, as parameters.
        file, sheet, wide: Of all parameters: what the file says, the sd of a data sheet that is right, and of
            one that is wrong, shape (d,).
    """
    known, factors = evidence.known(), dict[K, float]()
    for name, rows in groups.items():
        at, n, p = list(rows), evidence.prior[0, rows], evidence.prior[1, rows]
        inverse = np.linalg.inv(known[np.ix_(at, at)])
        q = positive(inverse - np.diag(p**-2.0))
        u = inverse @ evidence.mean[at] - n / p**2 - q @ file[at]
        factors[name] = _log_density(u, q, wide[at]) - _log_density(u, q, sheet[at])
    strong = [name for name, factor in factors.items() if factor > _STRONG]
    return sorted(strong, key=lambda name: -factors[name])


def _log_density(u: FloatArray, q: FloatArray, sd: FloatArray) -> float:
    """Of the score u = q (c - f), where f is known to sd (k,), but for what does not depend on sd."""
    spread = np.eye(len(u)) + sd[:, None] * q * sd
    return -0.5 * float(
        u @ np.linalg.pinv(q + q @ np.diag(sd**2) @ q, rcond=1e-9, hermitian=True) @ u
        + np.linalg.slogdet(spread)[1]
    )


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
