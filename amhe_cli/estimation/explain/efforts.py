"""What measured efforts leave unexplained along a measured motion, in the terms of `unexplained`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from amhe_cli.core.arrays import FloatArray, to_host
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Window
from amhe_cli.engine.inverse import Forces
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.explain.motion import MOST, DrivenMotion
from amhe_cli.estimation.explain.unexplained import Unexplained, scale_of
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.matching.efforts import path_of
from amhe_cli.system.system import System

#: A parameter's step for its slope, in its prior sd.
_STEP = 1e-3
#: Instants to either side whose changes say how large the noise is.
_NEAR = 4


class FollowedMotion(DrivenMotion):
    """A motion at the instants at which efforts are compared: both were filtered there."""

    __slots__ = ()

    @property
    def reach(self) -> int:
        """Efforts of one instant are of that instant."""
        return 0

    def filtered(self, values: FloatArray) -> FloatArray:
        """Forces as they are."""
        return values


def unexplained_efforts(system: System, parts: Sequence[Window], z: FloatArray) -> Unexplained | None:
    """What a system does not explain of the efforts in some parts of logs; None: none were compared.

    It is a force: the mass matrix is one. Where an effort was not compared, it counts nothing.

    Args:
        parts: Parts of its logs.
        z: Values of the unknowns, shape (d,).
    """
    space, made = system.space, []
    theta, scale = space.theta_of(z), scale_of(system)
    steps = np.tile(theta, (len(space) + 1, 1))
    steps[1:] += _STEP * np.diag(scale)
    for part in parts:
        try:
            made.append((part, MatchingCost(system, [part], open_engine(system), system.settings.cost)))
        except LogError:
            continue
    made = [(part, cost) for part, cost in made if cost.clips.observed]
    if not made:
        return None
    dofs = sorted({one.channel.columns[0] for _, cost in made for one in cost.clips.observed})
    every = -(-sum(cost.clips.observed[0].rows.shape[1] for _, cost in made) // MOST)
    columns = [_of_part(cost, part, space.z_of(steps), dofs, every) for part, cost in made]
    states, times, compared, tau, sds, predicted = (list(each) for each in zip(*columns, strict=True))
    moved = [np.concatenate(each) for each in zip(*states, strict=True)]
    counts = np.concatenate(compared)
    left = np.concatenate(predicted, axis=1) - np.concatenate(tau)
    residual = left[0] * counts
    slopes = (left[1:] * counts - residual) / _STEP
    sd = np.ma.array(np.concatenate(sds), mask=counts == 0.0)
    weights = np.ma.filled(np.ma.median(sd, axis=0) / sd, 0.0)
    motion = _motion(system, moved, times, made, dofs, every)
    needed = np.zeros_like(moved[1])
    needed[:, dofs] = np.concatenate(predicted, axis=1)[0]
    n, nv = needed.shape
    idle = np.zeros((n, system.model.nactuator, nv))
    friction = np.tile(system.model.dof_frictionloss, (n, 1))
    # no column has what was measured: a model that weighs nothing would explain a torque that is nothing
    forces = Forces(needed, needed, idle, friction, np.tile(np.eye(nv), (n, 1, 1)))
    rows, toward = np.any(counts, axis=1), (theta - np.array(space.nominal)) / scale
    return Unexplained(motion, rows, residual, slopes, toward, forces, idle, weights)


def _of_part(  # type: ignore[no-untyped-def]
    cost: MatchingCost, part: Window, z: FloatArray, dofs: Sequence[int], every: int
):
    """Motion, times, which efforts count (s, k), the measured ones, their sd, the predicted ones (p, s, k).

    Of the instants only each of so many is taken.
    """
    along, observed = cost.clips.starts.along, cost.clips.observed
    assert along is not None, "efforts are matched"
    rows = observed[0].rows[0]
    compared, tau, sd = np.zeros((3, rows.size, len(dofs)))  # of a joint that is not compared here: nothing
    predicted = np.zeros((len(z), rows.size, len(dofs)))
    for one, values in zip(observed, cost.predict(z).values, strict=True):
        k = dofs.index(one.channel.columns[0])
        compared[:, k], tau[:, k], sd[:, k] = one.mask[0], one.measured[0, :, 0], np.ravel(one.noise)
        predicted[..., k] = to_host(values)[:, 0, :, 0]
    some, times = slice(None, None, every), (part.start + 1 + rows) * part.log.dt
    moved = tuple(one[some] for one in along.flat)
    return moved, times[some], compared[some], tau[some], sd[some], predicted[:, some]


def _near_sums(changes: FloatArray) -> FloatArray:
    """Sums (r, k) over the changes (r - 1, k) near each of r instants."""
    padded = np.pad(changes, ((_NEAR, _NEAR), (0, 0)))
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEAR, axis=0).sum(axis=2)


def evened(found: Unexplained, left: FloatArray) -> Unexplained:
    """The same with weights by the noise near each instant: a jerk excites what the smoothed motion has not.

    Args:
        found: What efforts leave unexplained.
        left: What all causes that were found leave of it at the rows that count, weighted, shape (r, k).
    """
    assert found.weights is not None, "efforts have weights"
    weights = found.weights[found.rows]
    both = (weights[1:] * weights[:-1] > 0.0).astype(float)
    # a difference of white noise has its variance twice
    count, squares = map(_near_sums, (both, 0.5 * both * np.diff(left, axis=0) ** 2))
    variance = np.ma.array(squares / np.maximum(count, 1.0), mask=count == 0.0)
    ratio = variance / np.maximum(np.ma.median(variance, axis=0), 1e-300)
    even = np.zeros_like(found.weights)
    # no instant is known better than twice the usual: a variance of so few changes may be small by chance
    even[found.rows] = weights * np.sqrt(2.0 / (1.0 + np.ma.filled(ratio, 1.0)))
    return replace(found, weights=even)


def _motion(  # type: ignore[no-untyped-def]
    system: System,
    moved: Sequence[FloatArray],
    times: Sequence[FloatArray],
    made,
    dofs: Sequence[int],
    every: int,
) -> FollowedMotion:
    """The motion of all parts, one after the other."""
    path = path_of(system, made[0][0].log)
    period, logs = every * path.every * made[0][0].log.dt, list(dict.fromkeys(part.log for part, _ in made))
    qpos, qvel, qacc = moved
    stretches, at = [], 0
    for time in times:
        edges = np.flatnonzero(np.diff(time) > 1.5 * period) + 1
        stretches += [slice(at + int(a), at + int(b)) for a, b in pairwise((0, *edges, time.size))]
        at += time.size
    log = np.repeat([logs.index(part.log) for part, _ in made], [time.size for time in times])
    speed, acceleration = (one[:, list(dofs)].std(axis=0) for one in (qvel, qacc))
    usual = float(np.median(acceleration / np.maximum(speed, 1e-12)))
    n, time = len(qpos), np.concatenate(times)
    nothing = np.zeros((n, 0))
    band = float(path.motion.band.max())
    return FollowedMotion(
        qpos, qvel, qacc, nothing, nothing, time, log, tuple(stretches), tuple(dofs), period, band, usual
    )
