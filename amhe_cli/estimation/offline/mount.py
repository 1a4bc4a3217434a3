"""Does the robot hang from a mount that rocks? A matched filter on the residuals at the estimate.

A mount of frequency f is a spring that the robot's own reaction drives, and whose acceleration drives the
joints. Both are known from the rollouts: the rate of change of the momentum, and the tangents of the steps.
For each f this gives the residuals that such a mount would leave, up to a compliance, a symmetric matrix
over the main directions of the reaction. Clips in turn are predicted by the compliance of the others.

What is no mount does not ring after the reaction: the filter at f must beat every mount that hardly rings,
and every other frequency. Slopes by the parameters and the first states are fitted along, so that nothing
counts that they could explain; so is a mount too stiff to ring.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.engine.reaction import fixed_base
from amhe_cli.estimation.core.information import split
from amhe_cli.estimation.offline.checks import WHITE
from amhe_cli.estimation.offline.posterior import FinalFit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.rocking import Mode, mode_of
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.matching.windows import Observed

logger = logging.getLogger(__name__)

#: Clips that are looked at, and the fewest that tell.
MOST, FEWEST = 32, 6
#: Lowest and highest frequency [Hz], cycles in a clip at least, share of the sampling rate at most, and ratio
#: of two neighbours.
LOWEST, HIGHEST, CYCLES, SHARE, RATIO = 2.0, 40.0, 2.0, 0.4, 1.09
#: Damping ratios: of a mount that rings; of one that rings longer, and one that hardly does, which are tried
#: at so many frequencies on either side; and of one that does not.
RINGING, SHARP, DULL, NEAR, DAMPED = 0.12, 0.05, 0.22, 2, 0.7
#: Share of the misfit that ringing explains beyond all else, t of the clips' gains, share of clips that gain,
#: and frequencies that are no neighbours.
EXPLAINS, STUDENT, MOSTLY, APART = 0.15, 3.0, 0.7, 1.35
#: Frequencies whose responses are in memory together.
AT_ONCE = 8
#: Folds in which clips are predicted, and the ridge of that regression.
FOLDS, RIDGE = 5, 1e-3


def report_mount(problem: Problem, fit: FinalFit) -> None:
    """Warn of a mount that rocks."""
    found = rocking(problem, fit)
    if found is not None:
        frequency, keys = found
        logger.warning(
            f"the logs speak of a mount that rocks at about {frequency:.2g} Hz: residuals of {keys} ring "
            f"there after the robot's own accelerations; stiffen the mount, or leave out what excites it"
        )


def rocking(problem: Problem, fit: FinalFit) -> tuple[float, str] | None:
    """Frequency of the mount [Hz] and the channels that ring; None where nothing speaks of one."""
    cost, model, times = fit.slopes.cost, problem.system.model, fit.times
    channels = [
        k
        for k, observed in enumerate(cost.clips.observed)
        if observed.channel.source == "qpos" and times[k] >= WHITE
    ]
    clips = np.flatnonzero((fit.weight > 0.0) & fit.slopes.completed)
    clips = clips[np.linspace(0, len(clips) - 1, min(MOST, len(clips))).round().astype(np.int64)]
    if not channels or len(clips) < FEWEST or not fixed_base(model) or problem.touches:
        return None
    cost, first = cost.of(clips), fit.found.nuisance[clips]
    parts = list(cost.rolled_out(fit.z, first if first.shape[1] else None))
    if len(parts) != 1 or not parts[0].rollouts.completed.all():  # logs with values of their own
        return None
    apart = [
        np.concatenate([np.diff(rows[mask]) for rows, mask in zip(one.rows, one.mask, strict=True)])
        for one in (cost.clips.observed[k] for k in channels)
    ]
    if not all(gaps.size for gaps in apart):
        return None
    spacing = max(float(np.median(gaps)) for gaps in apart) * problem.system.dt
    low = max(LOWEST, CYCLES / (float(np.median(parts[0].lengths)) * problem.system.dt))
    high = min(HIGHEST, SHARE / spacing)
    if high < 2.0 * low:
        return None
    hertz = np.asarray(
        low * RATIO ** np.arange(int(np.log(high / low) / np.log(RATIO)) + 1), dtype=np.float64
    )
    measured = _measured(fit, cost, clips, channels)
    frequency = _named(mode_of(problem, cost.clips.windows, parts[0]), measured, hertz)
    return None if frequency is None else (frequency, ", ".join(o.channel.key for o in measured.observed))


def _named(mode: Mode, measured: _Measured, hertz: FloatArray) -> float | None:
    """The frequency that explains the residuals as no other one and nothing else does."""
    stiff = mode.responses(np.array([1.5 * hertz[-1]]), 1.0)[0]
    plain = measured.misfit([]), measured.misfit([stiff])
    others = np.concatenate((_misfits(mode, measured, hertz, DAMPED, stiff), plain, measured.squares[None]))
    other = others[others.sum(axis=1).argmin()]
    ringing = _misfits(mode, measured, hertz, RINGING, stiff)
    profile = ringing.sum(axis=1)
    at = int(profile.argmin())
    if profile[at] > (1.0 - 0.5 * EXPLAINS) * other.sum():
        return None
    some = np.arange(max(0, at - NEAR), min(len(hertz), at + NEAR + 1))
    sharper, duller = (_misfits(mode, measured, hertz[some], z, stiff) for z in (SHARP, DULL))
    sharp = sharper.sum(axis=1) < profile[some]
    ringing[some[sharp]] = sharper[sharp]
    profile = ringing.sum(axis=1)
    at = int(profile.argmin())
    apart = np.abs(np.log(hertz / hertz[at])) > np.log(APART)
    if at in (0, len(hertz) - 1) or not apart.any() or duller.sum(axis=1).min() < profile[at]:
        return None
    gains = np.log(np.maximum(other, 1e-12) / np.maximum(ringing[at], 1e-12))
    explained = 1.0 - profile[at] / min(other.sum(), profile[apart].min())
    chance = gains.std(ddof=1) / np.sqrt(len(gains))
    if explained < EXPLAINS or gains.mean() < STUDENT * chance or (gains > 0.0).mean() < MOSTLY:
        return None
    before, here, after = np.log(profile[at - 1 : at + 2])
    return float(hertz[at] * RATIO ** (0.5 * (before - after) / (before - 2.0 * here + after)))


def _misfits(
    mode: Mode, measured: _Measured, hertz: FloatArray, damping: float, stiff: FloatArray
) -> FloatArray:
    """Misfit of each clip with a mount of each frequency, and a stiff one, shape (f, c)."""
    turns = np.array_split(hertz, -(-len(hertz) // AT_ONCE))
    return np.array(
        [measured.misfit([one, stiff]) for some in turns for one in mode.responses(some, damping)]
    )


# -- what was measured ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Residuals of some channels on c clips, without what first states can do to them.

    Args:
        observed: The channels.
        known: Of each clip: residuals, and their slopes by the parameters, shape (R, 1 + d).
        free: Of each clip: slopes by the first state, shape (R, nx).
    """

    observed: list[Observed]
    known: list[FloatArray]
    free: list[FloatArray]

    @property
    def squares(self) -> FloatArray:
        """Squared residuals of each clip, shape (c,)."""
        return np.array([one[:, 0] @ one[:, 0] for one in self.known])

    def misfit(self, responses: list[FloatArray]) -> FloatArray:
        """Squared residuals of each clip, shape (c,), as predicted from the others.

        Args:
            responses: Motions of the joints, shape (c, H, nv, p) each; their sizes are fitted.
        """
        products = np.array([self._product(i, responses) for i in range(len(self.known))])
        size = np.sqrt(np.einsum("cii->i", products)) + 1e-12
        size[0] = 1.0
        products /= size[:, None] * size
        squares = products[:, 0, 0].copy()
        for fold in range(FOLDS):
            own = np.arange(len(products)) % FOLDS == fold
            of_others = products[~own].sum(axis=0)
            by = np.linalg.solve(of_others[1:, 1:] + RIDGE * np.eye(len(size) - 1), of_others[1:, 0])
            moved = np.concatenate(([1.0], -by))
            squares[own] = np.einsum("i,cij,j->c", moved, products[own], moved)
        return squares

    def _product(self, clip: int, responses: list[FloatArray]) -> FloatArray:
        """Products of residuals and slopes of a clip with each other, first states fitted to each."""
        columns = self.known[clip]
        if responses:
            moved = [
                np.concatenate([_shown(observed, clip, one) for observed in self.observed])
                for one in responses
            ]
            columns = np.concatenate((columns, *moved), axis=1)
        free = self.free[clip]
        if not free.shape[1]:
            return columns.T @ columns
        fitted = np.linalg.solve(free.T @ free + np.eye(free.shape[1]), free.T @ columns)
        left = columns - free @ fitted
        return left.T @ left


def _measured(fit: FinalFit, cost: MatchingCost, clips: IntArray, channels: list[int]) -> _Measured:
    """Residuals of some channels on some clips, with the cost on these clips."""
    d = len(fit.z)
    observed = [cost.clips.observed[k] for k in channels]
    rows = [fit.found.residual[clips], *fit.slopes.gain[clips].swapaxes(0, 1)]
    parts = [split(cost, np.asarray(row, dtype=np.float64)) for row in rows]
    known, free = [], []
    for i in range(len(clips)):
        columns = [
            np.concatenate(
                [part[k][i][one.mask[i]].ravel() for k, one in zip(channels, observed, strict=True)]
            )
            for part in parts
        ]
        known.append(np.array(columns[: 1 + d]).T)
        free.append(np.array(columns[1 + d :]).reshape(len(columns) - 1 - d, len(columns[0])).T)
    return _Measured(observed, known, free)


def _shown(observed: Observed, clip: int, moved: FloatArray) -> FloatArray:
    """Residuals (R, p) that motions of the joints (c, H, nv, p) leave in a channel of a clip."""
    rows = observed.rows[clip, observed.mask[clip]]
    picked = moved[clip][rows][:, list(observed.channel.columns)]
    return picked.reshape(-1, moved.shape[-1]) / observed.noise
