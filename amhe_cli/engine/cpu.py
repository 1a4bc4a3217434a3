"""The engine on CPU threads: `mujoco.batch.Batch` runs all rollouts, each with its own parameters."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import mujoco.batch
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.rollout import (
    Predicted,
    Rollouts,
    Starts,
    Wanted,
    candidates_last,
    predicted_in_parts,
    turns_of,
)
from amhe_cli.engine.states import controls, first_activations, in_state, without_contacts
from amhe_cli.system.parameters.gear_friction import OF_GEARS, UPDATE, GearFriction, ahead, beyond
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.parameters.servos import BIAS, Servos

#: The records of one batch of rollouts stay below this many bytes; more of them are run in turns.
RECORD_BYTES = 64 * 2**20
#: What the friction of gears depends on.
_FORCES = ("qfrc_actuator", "qfrc_damper", "qfrc_smooth", "qfrc_constraint", "qvel")
#: Rollouts of different lengths are run in at most this many groups of similar length, so that a short
#: one does not pay for the longest.
LENGTH_GROUPS = 6


class CpuEngine:
    """An engine on CPU threads, with a pool of simulations that is kept between calls.

    Results are bit-identical at any number of threads.

    Args:
        model: The model to roll out.
        edits: How parameters are written into it.
        input_spec: mjtState bits of the input vector.
        threads: Number of CPU threads.
        sensors: Whether rollouts record sensors; they cost one more step per rollout.
    """

    def __init__(
        self, model: mujoco.MjModel, edits: ModelEdits, input_spec: int, threads: int, sensors: bool
    ) -> None:
        self._servos, self._gear = edits.servos, edits.gear_friction
        free = model if self._servos is None else self._servos.unlimited(model)
        self._model, self._edits, self._input_spec = without_contacts(free), edits, input_spec
        self._threads, self._sensors = threads, sensors
        self._batch: mujoco.batch.Batch | None = None
        self._qpos = self._qvel = np.empty((0, 0))  # views of its states
        self._fields: dict[str, np.ndarray] = {}
        self._written, self._first = np.empty((0, len(edits.space))), np.empty((0, 0))
        self._clean = np.empty(0, dtype=bool)  # without warnings since their last reset
        self._controls, self._inputs = controls(model, input_spec), in_state(model, input_spec)

    precision, device_bytes = float(np.finfo(np.float64).eps), 0

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `Engine.rollout`."""
        count, horizon = inputs.shape[:2]
        batch = self._ready(count)
        self._begin(batch, theta)
        self._qpos[:count], self._qvel[:count] = qpos, qvel
        if self._model.na and self._controls is not None:
            first = first_activations(self._model, qpos, inputs[:, 0, self._controls])
            batch.bind("act")[:count] = first
        if not self._sensors and (lengths == horizon).all():  # as of a planner, whose time counts: no copies
            out = self._run(batch, np.arange(count), inputs)
            result = Rollouts(out["qpos"], out["qvel"], None, np.empty(count, dtype=bool))
        else:
            result = Rollouts(
                np.empty((count, horizon, self._model.nq)),
                np.empty((count, horizon, self._model.nv)),
                np.empty((count, horizon, self._model.nsensordata)) if self._sensors else None,
                np.empty(count, dtype=bool),
            )
            for ids, steps in _groups(lengths):
                out = self._run(batch, ids, inputs[ids, :steps])
                result.qpos[ids, :steps] = out["qpos"][:, :steps]
                result.qvel[ids, :steps] = out["qvel"][:, :steps]
                if result.sensordata is not None:
                    result.sensordata[ids, :steps] = out["sensordata"][:, 1:]
        np.logical_not(batch.warning[:count].any(axis=(1, 2)), out=result.completed)
        self._clean[:count] = result.completed
        _make_finite(result)
        return result

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`."""
        model, count, clips = self._model, len(theta), len(starts.lengths)
        row = model.nq + model.nv + model.nsensordata + starts.inputs.shape[2]
        at_once = max(1, RECORD_BYTES // (8 * row * starts.horizon))
        if (turns := turns_of(count, clips, at_once)) == (1, 1):
            return self._predict(theta, starts, errors, wanted)
        return predicted_in_parts(
            turns, theta, starts, errors, wanted,
            lambda parts: [candidates_last(self._predict(*part)) for part in parts],
        )  # fmt: skip

    def _predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """Predict with one batch of rollouts, in the order (candidates, clips)."""
        model, count, clips = self._model, len(theta), len(starts.lengths)
        qpos, qvel = starts.states(model, count, errors)
        rollouts = self.rollout(
            np.repeat(theta, clips, axis=0),
            qpos.reshape(-1, model.nq),
            qvel.reshape(-1, model.nv),
            starts.inputs_under(self._edits.delays(theta) / model.opt.timestep),
            np.tile(starts.lengths, count),
        )
        values = tuple(picked.pick(rollouts, count) for picked in wanted)
        return Predicted(values, rollouts.completed.reshape(count, clips))

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> CpuEngine:
        """See `Engine.upon`."""
        edits = edits or self._edits.upon(model)
        return CpuEngine(model, edits, self._input_spec, self._threads, self._sensors)

    def _ready(self, count: int) -> mujoco.batch.Batch:
        """The pool, grown to at least `count` simulations."""
        if self._batch is None or self._batch.nsim < count:
            batch = self._batch = mujoco.batch.Batch(self._model, count, self._threads)
            self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
            self._fields = {name: batch.expand(name) for name in self._edits.fields}
            if self._gear is not None:  # each update overwrites the batch's own dry friction
                for name in _FORCES:
                    batch.bind(name)  # kept by the batch from here on
                self._fields |= {n: np.repeat(getattr(self._model, n)[None], count, 0) for n in OF_GEARS}
            if self._servos is not None:
                self._fields |= {BIAS: batch.expand(BIAS)}
                self._fields.setdefault("numeric_data", np.repeat(self._model.numeric_data[None], count, 0))
            self._written = np.full((count, len(self._edits.space)), np.nan)
            self._first, self._clean = np.empty_like(batch.state), np.zeros(count, dtype=bool)
        return self._batch

    def _begin(self, batch: mujoco.batch.Batch, theta: FloatArray) -> None:
        """Write candidates into their simulations, and clear warm starts and warnings: reproducible.

        Simulations that hold theirs already, as a planner's do, and had no warning, get the state that the
        last reset gave them: a reset takes fifty times as long.
        """
        count = len(theta)
        kept, self._clean[:count] = self._clean[:count].all(), False
        if kept and (theta == self._written[:count]).all():
            batch.state[:count] = self._first[:count]
            return
        self._edits.write({name: field[:count] for name, field in self._fields.items()}, theta)
        if self._edits.needs_set_const:
            batch.set_const()  # mass and its like have derived constants, stale until now
        ids = None if count == batch.nsim else np.arange(count)
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._written[:count], self._first[:count] = theta, batch.state[:count]

    def _run(self, batch: mujoco.batch.Batch, ids: IntArray, control: FloatArray) -> dict[str, FloatArray]:
        """Records of some rollouts; the last input is held for the sensors' extra step."""
        record = ["qpos", "qvel"]
        if self._sensors:
            control = np.concatenate((control, control[:, -1:]), axis=1)
            record.append("sensordata")
        try:
            return self._rolled_out(batch, ids, control, record)
        except (mujoco.FatalError, ValueError, RuntimeError) as error:
            raise SimulationError(f"MuJoCo refused a rollout: {error}") from error

    def _rolled_out(
        self, batch: mujoco.batch.Batch, ids: IntArray, control: FloatArray, record: list[str]
    ) -> dict[str, FloatArray]:
        """Records of some rollouts: in one piece, or in pieces between which friction changes."""
        every_one = len(ids) == batch.nsim
        some = slice(None) if every_one else ids  # a view of all is quicker than a copy
        rows = None if every_one else ids.astype(np.int32)

        def run(inputs: FloatArray) -> dict[Any, FloatArray]:
            return batch.rollout(
                inputs.shape[1],
                control=inputs if inputs.shape[2] else None,
                control_spec=self._input_spec,
                record=record,
                ids=rows,
            )

        if self._gear is None and self._servos is None:
            return run(control)
        every = max(1, round(UPDATE / self._model.opt.timestep))
        drive = None if self._servos is None else self._driver(self._servos, batch, some)
        hold = None if self._gear is None else self._holder(self._gear, batch, some, every)
        place = (some, self._inputs) if every_one else (ids[:, None], self._inputs)
        if hold is not None:
            batch.state[place] = control[:, 0]
            if drive is not None:
                drive(control[:, 0])
            batch.forward(rows)  # for the forces at the start, upon which friction depends
        steps, at_once = control.shape[1], every if drive is None else 1
        now = {name: batch.bind(name) for name in record}
        made = {name: np.empty((len(ids), steps, view.shape[1])) for name, view in now.items()}
        for first in range(0, steps, at_once):
            if hold is not None and first % every == 0:
                hold()
            if drive is not None:
                drive(control[:, first])
            if at_once == 1:  # quicker than a rollout of one step
                batch.state[place] = control[:, first]
                batch.step(rows, stage=mujoco.mjtStage.mjSTAGE_NONE)
                for name, view in now.items():
                    made[name][:, first] = view[some]
            else:
                piece = slice(first, first + at_once)
                for name, values in run(control[:, piece]).items():
                    made[name][:, piece] = values
        return made

    def _driver(
        self, servos: Servos, batch: mujoco.batch.Batch, some: slice | IntArray
    ) -> Callable[[FloatArray], None]:
        """What gives the servos of some simulations their torques under inputs (n, nu)."""
        fields, into = self._fields, self._fields[BIAS]
        law = servos.law(
            lambda name: fields[name][some] if name in fields else getattr(self._model, name)[None]
        )
        place = (some, servos.rows, 0) if isinstance(some, slice) else (some[:, None], servos.rows, 0)
        states = [batch.bind(name) for name in ("qpos", "qvel", "act")]

        def drive(inputs: FloatArray) -> None:
            into[place] = law(
                *(state[some] for state in states[:2]), inputs[:, self._controls], states[2][some]
            )

        return drive

    def _holder(
        self, gear: GearFriction, batch: mujoco.batch.Batch, some: slice | IntArray, every: int
    ) -> Callable[[], None]:
        """What sets how much friction can hold in some simulations, by the newest forces."""
        own, holds = self._fields["dof_frictionloss"][some], batch.expand("dof_frictionloss")
        bound = gear.law(self._fields["numeric_data"][some][:, gear.at], own[:, gear.dofs])
        place: Any = (some, gear.dofs) if isinstance(some, slice) else (some[:, None], gear.dofs)
        if len(gear.dofs) == self._model.nv and isinstance(some, slice):
            place = some  # a view of all is quicker than a copy
        forces, now = [batch.bind(name) for name in _FORCES], None
        alike = isinstance(place, slice)
        views = [force[place] for force in forces]
        holds[some] = own

        def hold() -> None:
            nonlocal now
            motor, damper, smooth, constraint, speed = views if alike else (force[place] for force in forces)
            external = smooth - damper - motor + beyond(constraint, holds[place])
            before, now = now, bound(motor, external, speed)
            holds[place] = now if before is None else ahead(now, before, every)

        return hold


def _groups(lengths: IntArray) -> list[tuple[IntArray, int]]:
    """Split rollouts into groups of similar length: (ascending ids, steps to run)."""
    longest = int(lengths.max())
    edges = np.unique(np.ceil(np.arange(1, LENGTH_GROUPS + 1) * longest / LENGTH_GROUPS).astype(int))
    group = np.searchsorted(edges, lengths)
    return [
        (np.flatnonzero(group == g), int(lengths[group == g].max()))
        for g in range(edges.size)
        if (group == g).any()
    ]


def _make_finite(rollouts: Rollouts) -> None:
    """Replace NaN and inf of diverged rollouts by 0, in place: a model without MuJoCo's reset keeps them."""
    if rollouts.completed.all():
        return
    failed = np.flatnonzero(~rollouts.completed)
    for values in (rollouts.qpos, rollouts.qvel, rollouts.sensordata):
        if values is not None:
            values[failed] = np.nan_to_num(values[failed], posinf=0.0, neginf=0.0)


def hush_mujoco() -> None:
    """Send this process's MuJoCo warnings to the log; by default it writes MUJOCO_LOG.TXT."""
    mujoco.set_mju_user_warning(logging.getLogger("amhe_cli.mujoco").debug)
