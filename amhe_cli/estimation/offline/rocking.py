"""What a mount that rocks would do to the joints of a robot, from rollouts of the rigid one.

The robot's reaction, which is the rate of change of its momentum and the moment of its weight, drives a
spring; the acceleration of the spring's end drives the joints. How they follow is in the tangents of the
rollouts' steps, with all that acts in the model: servos, damping, friction that holds a joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Window
from amhe_cli.engine.reaction import Tangents, momentum, tangents
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.matching.cost import RolledOut

#: Time before a clip in which the mount has been driven, of a mean over measured positions, within which they
#: pass into the rollout's, and between two tangents [s].
BEFORE, SMOOTH, PASSING, EVERY = 1.0, 0.06, 0.05, 0.02
#: Directions of the reaction at most, and its share that they hold.
DIRECTIONS, HELD = 3, 0.98


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """What drives a mount on c clips, along k directions of the reaction, and what it would do to the joints.

    Args:
        momentum, weight: Momentum, and the moment of the weight, shape (c, n, k); the last H + 1 of
            the n instants are those of the clips.
        tangents: Of c clips, at some of their steps, each of shape (c, m, ...).
        tangent: Number of the tangent that holds at each step, shape (H,).
        dt: Time step [s].
    """

    momentum: FloatArray
    weight: FloatArray
    tangents: Tangents
    tangent: IntArray
    dt: float

    def responses(self, hertz: FloatArray, damping: float) -> FloatArray:
        """Motions of the joints under mounts of some frequencies.

        Args:
            hertz: The frequencies, shape (f,).
            damping: Damping ratio of the mounts.

        Returns:
            Motions by p pairs of directions, shape (f, c, H, nv, p).
        """
        moved, accelerated = self._rocked(2.0 * np.pi * hertz, damping)
        one, other = np.triu_indices(self.momentum.shape[2])
        twice = (one != other).astype(float)  # a compliance is symmetric
        step, push, lean = self.tangents.step, self.tangents.push, self.tangents.lean
        clips, nv, found = len(step), push.shape[2], []
        state = np.zeros((clips, 2 * nv, len(hertz) * len(one)))
        for k, at in enumerate(self.tangent):
            kick = sum(
                by[:, at][:, :, None, a] * x[:, None, :, k][..., b] * scale
                for by, x in ((push, accelerated), (lean, moved))
                for a, b, scale in ((one, other, 1.0), (other, one, twice))
            )
            kick = np.asarray(kick).reshape(clips, nv, -1)
            state = step[:, at] @ state
            state[:, nv:] += kick
            state[:, :nv] += self.dt * kick
            found.append(state[:, :nv])
        shape = (len(found), clips, nv, len(hertz), len(one))
        return np.array(found).reshape(shape).transpose(3, 1, 0, 2, 4)

    def _rocked(self, omega: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Deflection of the mount over its compliance, and its acceleration, shape (c, f, H, k) each.

        It starts at rest, and is driven by less the rate of change of the momentum, and the weight's moment.
        """
        dt, w, steps = self.dt, omega[:, None], self.momentum.shape[1]
        fast, slow = np.sqrt(1.0 - min(damping, 0.999) ** 2) * w, min(damping, 0.999) * w
        decay = np.exp(-slow * dt)
        cos, sin = decay * np.cos(fast * dt), decay * np.sin(fast * dt) / fast
        x = v = np.zeros((len(self.momentum), len(omega), self.momentum.shape[2]))
        places, speeds = np.empty((2, *x.shape[:2], steps, x.shape[2]))
        h, g = (one - one[:, :1] for one in (self.momentum, self.weight))
        for k in range(steps):
            places[:, :, k], speeds[:, :, k] = x, v
            if k < steps - 1:  # what drives is constant over a step
                force = (h[:, k + 1] - h[:, k]) / dt + 0.5 * (g[:, k + 1] + g[:, k])
                rest = -force[:, None] / w**2
                away = x - rest
                x = rest + (cos + slow * sin) * away + sin * v
                v = (cos - slow * sin) * v - w**2 * sin * away
        accelerated = np.gradient(speeds, dt, axis=2)
        inside = slice(-1 - len(self.tangent), -1)
        scale = (w**2)[:, None]
        return scale * places[:, :, inside], scale * accelerated[:, :, inside]


def mode_of(problem: Problem, windows: tuple[Window, ...], done: RolledOut) -> Mode:
    """What drives a mount on some clips, and what it would do."""
    system, dt = problem.system, problem.system.dt
    model = system.edits.apply(system.model, done.theta)
    qpos, qvel = done.rollouts.qpos, done.rollouts.qvel
    clips, steps, nv = qvel.shape
    driven = [_driven(problem, window, qpos[i], qvel[i]) for i, window in enumerate(windows)]
    found = [momentum(model, *one) for one in driven]
    drives, weight = (np.array([one[i] for one in found]) for i in (0, 1))
    force = (np.gradient(drives, dt, axis=1) + weight)[:, -steps:]
    inside = force[np.arange(steps) < done.lengths[:, None]]
    scale = np.repeat([max(float(inside[:, half].std()), 1e-9) for half in (slice(3), slice(3, 6))], 3)
    _, sizes, axes = np.linalg.svd((inside - inside.mean(axis=0)) / scale, full_matrices=False)
    held = np.cumsum(sizes**2) / max(float((sizes**2).sum()), 1e-300)
    along = (axes[: min(DIRECTIONS, int(np.searchsorted(held, HELD)) + 1)] / scale).T  # (6, k)
    rows = np.arange(0, steps, max(1, round(EVERY / dt)))
    states = (one[:, rows].reshape(clips * len(rows), -1) for one in (qpos, qvel, done.inputs))
    at = tangents(model, system.input_spec, *states)
    shaped = Tangents(
        at.step.reshape(clips, len(rows), 2 * nv, 2 * nv),
        *((one @ along).reshape(clips, len(rows), nv, -1) for one in (at.push, at.lean)),
    )
    tangent = np.searchsorted(rows, np.arange(steps), side="right") - 1
    return Mode(drives @ along, weight @ along, shaped, tangent, dt)


def _driven(
    problem: Problem, window: Window, qpos: FloatArray, qvel: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities of a clip's rollout, and those that were measured before it, smooth."""
    dt = problem.system.dt
    before, half = max(1, round(BEFORE / dt)), max(1, round(SMOOTH / dt))
    first = 2.0 * qpos[0] - qpos[1], 2.0 * qvel[0] - qvel[1]
    after = np.pad(qpos[:half], ((0, half - len(qpos[:half])), (0, 0)), "edge")
    joined = np.concatenate((np.tile(first[0], (before + half + 1, 1)), after))
    for channel in problem.system.channels:
        if channel.source != "qpos" or channel.key not in window.log.series:
            continue
        series = window.log[channel.key]
        rows = slice(max(0, window.start - before - half), window.start)
        gaps = np.flatnonzero(~series.valid[rows])
        values = series.values[rows][gaps[-1] + 1 if gaps.size else 0 :]
        if len(values):
            columns = list(channel.columns)
            joined[: before + half, columns] = values[0]
            joined[before + half - len(values) : before + half, columns] = values
    shape = np.hanning(2 * half + 3)[1:-1]
    smooth = np.array([np.convolve(one, shape / shape.sum(), "valid") for one in joined.T]).T
    speed, passing = (
        np.gradient(smooth, dt, axis=0),
        np.exp(-np.arange(before, -1, -1) * dt / PASSING)[:, None],
    )
    places = smooth + passing * (first[0] - smooth[-1])
    speeds = speed + passing * (first[1] - speed[-1])
    return np.concatenate((places, qpos)), np.concatenate((speeds, qvel))
