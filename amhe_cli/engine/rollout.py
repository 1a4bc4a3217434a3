"""What every rollout engine does, and the arrays that it takes and gives.

Alignment is settled here and nowhere else: row k of every array of `Rollouts` is the instant k + 1, the
state after input k; the initial state is the instant 0. MuJoCo's own rollout records sensors one step
late (they describe the state before the step); the engine shifts them.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import mujoco
import numpy as np

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from amhe_cli.engine.states import integrated
from amhe_cli.system.parameters.model_edits import ModelEdits


@dataclass(frozen=True, slots=True, eq=False)
class Rollouts:
    """Predicted states of n rollouts; rows past a rollout's own length are meaningless.

    Args:
        qpos, qvel: States at the instants 1 .. H, shape (n, H, nq) and (n, H, nv).
        sensordata: Sensors at the same instants, shape (n, H, nsensordata); None if the engine has none.
        completed: False where the simulation diverged, shape (n,). The numbers of such a rollout are
            finite and look tame (MuJoCo stops, or resets, and repeats itself): never use them.
    """

    qpos: FloatArray
    qvel: FloatArray
    sensordata: FloatArray | None
    completed: BoolArray


def joined(parts: Sequence[Rollouts]) -> Rollouts:
    """Rollouts of the same length, one after the other."""
    columns = ([getattr(part, name) for part in parts] for name in Rollouts.__slots__)
    arrays: Any = (None if each[0] is None else np.concatenate(each) for each in columns)
    return Rollouts(*arrays)


@dataclass(frozen=True, slots=True, eq=False)
class Along:
    """The measured motion of c clips, at s instants of each, for an engine that follows it.

    Args:
        qpos, qvel, qacc: The motion, shape (c, s, nq), (c, s, nv) and (c, s, nv).
        dry: Share of each joint's dry friction that its motion has to overcome, shape (c, s, nv).
        inputs: What acts beside the joints' own actuators, shape (c, s, nu); None: nothing.
        keys: Something for each clip that is equal only where all of these are.
    """

    qpos: FloatArray
    qvel: FloatArray
    qacc: FloatArray
    dry: FloatArray
    inputs: FloatArray | None
    keys: tuple[Hashable, ...]

    @property
    def flat(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """qpos, qvel and qacc of all clips, one after the other, shape (c s, nq) and (c s, nv)."""
        qpos, qvel, qacc = (one.reshape(-1, one.shape[2]) for one in (self.qpos, self.qvel, self.qacc))
        return qpos, qvel, qacc

    def of(self, clips: IntArray) -> Along:
        """The motion of some of the clips."""
        return Along(
            qpos=self.qpos[clips],
            qvel=self.qvel[clips],
            qacc=self.qacc[clips],
            dry=self.dry[clips],
            inputs=None if self.inputs is None else self.inputs[clips],
            keys=tuple(self.keys[i] for i in clips),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """First states and inputs of the rollouts of c clips.

    Args:
        qpos, qvel: First states, shape (c, nq) and (c, nv).
        inputs: Input vectors from `history` steps before each start, shape (c, history + H, nu).
        history: Steps that the longest command delay reaches back.
        lengths: Steps of each clip, shape (c,), at most H.
        first_index: Tangent coordinates of the first state (nv of qpos, then nv of qvel) that may be
            wrong, shape (nx,).
        first_sd: Sd of their errors on each clip [SI], shape (c, nx).
        along: The measured motion, where efforts are matched.
    """

    qpos: FloatArray
    qvel: FloatArray
    inputs: FloatArray
    history: int
    lengths: IntArray
    first_index: IntArray
    first_sd: FloatArray
    along: Along | None = None

    @property
    def horizon(self) -> int:
        """Steps of the longest clip, H."""
        return self.inputs.shape[1] - self.history

    def of(self, clips: IntArray) -> Starts:
        """The starts of some of the clips."""
        return replace(
            self,
            qpos=self.qpos[clips],
            qvel=self.qvel[clips],
            inputs=self.inputs[clips],
            lengths=self.lengths[clips],
            first_sd=self.first_sd[clips],
            along=None if self.along is None else self.along.of(clips),
        )

    def at_half_steps(self) -> Starts:
        """The same starts for a model of half the time step: each input is held for two steps."""
        return replace(
            self, inputs=np.repeat(self.inputs, 2, axis=1), history=2 * self.history, lengths=2 * self.lengths
        )

    def states(
        self, model: mujoco.MjModel, count: int, errors: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """First states of p candidates on every clip: qpos (p, c, nq) and qvel (p, c, nv).

        Args:
            model: The model whose states they are.
            count: Number of candidates, p.
            errors: First-state errors in units of their sd, shape (p, c, nx); None for the states as they
                are.
        """
        shape = (count, len(self.lengths))
        if errors is None:
            return (
                np.broadcast_to(self.qpos, (*shape, model.nq)),
                np.broadcast_to(self.qvel, (*shape, model.nv)),
            )
        delta = np.zeros((*shape, 2 * model.nv))
        delta[..., self.first_index] = errors * self.first_sd
        return integrated(model, self.qpos, delta[..., : model.nv]), self.qvel + delta[..., model.nv :]

    def inputs_under(self, delays: FloatArray) -> FloatArray:
        """Inputs of p candidates under delays [steps], shape (p * c, H, nu).

        A fraction of a step is interpolated, so that a cost is continuous in the delay. Beyond its ends the
        history holds its first and last input, so that delays may be negative.

        Args:
            delays: Of each input, shape (p, nu); (p, 1) where all inputs have the same.
        """
        steps, last = self.history + np.arange(self.horizon), self.inputs.shape[1] - 1
        taken = []
        for row in delays:
            late = np.array(self.inputs[:, self.history :])
            for delay in np.unique(row[row != 0.0]):
                of = np.broadcast_to(row == delay, late.shape[-1])
                whole, part = divmod(delay, 1.0)
                rows = steps - int(whole)
                now, before = (self.inputs[:, np.clip(r, 0, last)][..., of] for r in (rows, rows - 1))
                late[..., of] = (1.0 - part) * now + part * before
            taken.append(late)
        return np.concatenate(taken)


def delayed(inputs: FloatArray, delays: FloatArray) -> FloatArray:
    """Inputs (n, nu) at each of n steps under a delay of each [steps], shape (nu,); the ends are held."""
    late, steps = np.array(inputs), np.arange(len(inputs))
    for column in np.flatnonzero(delays):
        late[:, column] = np.interp(steps - delays[column], steps, inputs[:, column])
    return late


@dataclass(frozen=True, slots=True, eq=False)
class Wanted:
    """Numbers to pick from the rollouts of c clips, at most s times on each.

    Args:
        source: The array of `Rollouts`; 'effort' are generalised forces along a motion, at its own instants.
        rows: Row (instant - 1) of each sample in that array, shape (c, s); below the clip's length.
        columns: The k columns to pick from that array.
    """

    source: Literal["qpos", "qvel", "sensordata", "effort"]
    rows: IntArray
    columns: tuple[int, ...]

    def of(self, clips: IntArray) -> Wanted:
        """The wanted numbers of some of the clips."""
        return replace(self, rows=self.rows[clips])

    def at_half_steps(self) -> Wanted:
        """The same instants for a model of half the time step: instant k + 1 becomes 2 k + 2."""
        return replace(self, rows=2 * self.rows + 1)

    def pick(self, rollouts: Rollouts, count: int) -> FloatArray:
        """The numbers of p candidates, shape (p, c, s, k), from rollouts in the order (p, c)."""
        source = getattr(rollouts, self.source)
        return self.picked(source.reshape(count, len(self.rows), *source.shape[1:]))

    def picked(self, source: FloatArray) -> FloatArray:
        """The numbers of p candidates, shape (p, c, s, k), from their array (p, c, H, n)."""
        clips = len(self.rows)
        return source[:, np.arange(clips)[:, None, None], self.rows[..., None], np.array(self.columns)]


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """What p candidates predict on c clips.

    Args:
        values: One array for each `Wanted`, shape (p, c, s, k), numpy's or on the engine's device (see
            `core.arrays.namespace_of`). Finite everywhere, also where a rollout diverged.
        completed: False where a rollout diverged, shape (p, c); a numpy array.
    """

    values: tuple[AnyArray, ...]
    completed: BoolArray


#: Arguments of a prediction: theta, starts, errors, wanted.
Call = tuple[FloatArray, Starts, FloatArray | None, Sequence[Wanted]]


def predicted_in_parts(
    parts: tuple[int, int],
    theta: FloatArray,
    starts: Starts,
    errors: FloatArray | None,
    wanted: Sequence[Wanted],
    run: Callable[[Sequence[Call]], Sequence[Predicted]],
) -> Predicted:
    """A prediction that is computed in parts; the same numbers to the bit.

    Args:
        parts: Into how many parts to cut the candidates, and the clips.
        theta, starts, errors, wanted: See `Engine.predict`.
        run: Computes the parts; candidates are the last axis of their results (`candidates_last`).
    """
    by_candidate, by_clip = cut(len(theta), parts[0]), cut(len(starts.lengths), parts[1])
    results = run(
        [
            (theta[rows], starts.of(some), None if errors is None else errors[rows][:, some],
             [picked.of(some) for picked in wanted])
            for rows in by_candidate
            for some in by_clip
        ]
    )  # fmt: skip
    width = len(by_clip)
    whole = _joined([_joined(results[i : i + width], axis=0) for i in range(0, len(results), width)], axis=-1)
    return Predicted(tuple(np.moveaxis(v, -1, 0) for v in whole.values), whole.completed.T)


def turns_of(count: int, clips: int, at_once: int) -> tuple[int, int]:
    """Into how many parts to cut p candidates and c clips, so that a part has at most so many rollouts."""
    return -(-count // max(1, at_once // clips)), -(-clips // at_once)


def candidates_last(predicted: Predicted) -> Predicted:
    """A prediction with the candidates as the last axis.

    In that order the values lie in memory, and copies keep it: how a sum of them is rounded depends on it.
    """
    return Predicted(tuple(np.moveaxis(v, 0, -1) for v in predicted.values), predicted.completed.T)


def cut(count: int, parts: int) -> list[IntArray]:
    """The numbers below `count`, cut into at most so many parts of equal size."""
    return np.array_split(np.arange(count), max(1, min(count, parts)))


def _joined(parts: Sequence[Predicted], axis: int) -> Predicted:
    columns = zip(*(part.values for part in parts), strict=True)
    completed = np.concatenate([part.completed for part in parts], axis)
    return Predicted(tuple(np.concatenate(values, axis) for values in columns), completed)


class Engine(Protocol):
    """What a rollout engine, on CPU or GPU, must do; tests/engine/test_contract.py checks every engine.

    A rollout does not depend on the other rollouts of the call, nor on earlier calls. Diverged rollouts are
    marked, and their values are finite.
    """

    @property
    def precision(self) -> float:
        """Relative rounding of its numbers: slopes need steps well above it."""
        ...

    @property
    def device_bytes(self) -> int:
        """Memory of the device on which predicted numbers stay [bytes]; 0 where they are numpy's."""
        ...

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """Roll out n candidates and return their whole states.

        Args:
            theta: Parameters in SI units, shape (n, d).
            qpos: Initial positions, shape (n, nq).
            qvel: Initial velocities, shape (n, nv).
            inputs: Input vectors of the system's `input_spec`, each held over one step, shape (n, H, nu).
            lengths: Steps wanted of each rollout, shape (n,), at most H.

        Raises:
            SimulationError: The simulator refused the model or an input.
        """
        ...

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """Roll out p candidates on each of c clips, and return only the wanted numbers.

        Args:
            theta: Parameters in SI units, shape (p, d); their command delay shifts the inputs.
            starts: First states and inputs of the clips.
            errors: First-state errors in units of their sd, shape (p, c, nx); None for the states as they
                are.
            wanted: The numbers to pick.

        Raises:
            SimulationError: The simulator refused the model or an input.
        """
        ...

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> Engine:
        """The same engine, its threads and workers included, on another model of the same layout.

        Args:
            edits: How theta is written into it; None: as before.
        """
        ...
