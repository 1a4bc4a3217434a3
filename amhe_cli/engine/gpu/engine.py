"""The engine on graphics cards: thousands of worlds step at once, each with its own parameters."""

from __future__ import annotations

import hashlib
import logging
import pickle
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import AnyArray, FloatArray, IntArray, to_host
from amhe_cli.core.errors import NOTE
from amhe_cli.engine.auto import apart, step_cost
from amhe_cli.engine.gpu.blueprint import Blueprint
from amhe_cli.engine.gpu.job import Job, NoRoomError, queues
from amhe_cli.engine.rollout import (
    Call,
    Predicted,
    Rollouts,
    Starts,
    Wanted,
    candidates_last,
    predicted_in_parts,
    turns_of,
)
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.provenance import versions

logger = logging.getLogger(__name__)

#: A card gets at least so many rollouts of a call that several cards share.
LEAST = 512
#: Part of the usual share of a card's memory below which turns are not made smaller: a card that is full
#: again and again is left in a state that no later call can trust.
SMALLEST = 0.1


class GpuEngine:
    """An engine on one or several cards; states are float32, wanted numbers float64.

    Args:
        model: The model to roll out.
        edits: How parameters are written into it.
        input_spec: mjtState bits of the input vector.
        sensors: Whether rollouts record sensors.
        devices: Warp's names of the devices, of which 'cpu' is for tests.

    Raises:
        SimulationError: mujoco-warp cannot simulate the model.
    """

    precision = float(np.finfo(np.float32).eps)

    def __init__(
        self, model: mujoco.MjModel, edits: ModelEdits, input_spec: int, sensors: bool, devices: Sequence[str]
    ) -> None:
        from amhe_cli.engine.gpu.card import Card, keep_current_cards  # which takes seconds to load

        self._model, self._edits, self._devices = model, edits, tuple(devices)
        self._blueprint = Blueprint.of(model, edits, input_spec, sensors)
        if len(self._devices) > 1:
            keep_current_cards()
        self.cards = [Card(self._blueprint, device) for device in self._devices]

    @property
    def device_bytes(self) -> int:
        """See `Engine.device_bytes`; numbers come together on the first card."""
        return self.cards[0].memory

    def load(self, count: int, compilers: int) -> None:
        """Get ready for calls of so many rollouts; kernels compile in so many threads."""
        model, card, count = self._model, self.cards[0], min(count, self.cards[0].at_once(0))
        card.compilers = compilers
        inputs = np.zeros((count, 1, mujoco.mj_stateSize(model, self._blueprint.input_spec)))
        theta = np.asarray(self._edits.space.nominal)[None]
        self.rollout(theta, model.qpos0, np.zeros(model.nv), inputs, np.ones(count, dtype=np.int64))

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `Engine.rollout`."""
        model, (count, horizon, _) = self._model, inputs.shape
        theta = np.broadcast_to(theta, (count, theta.shape[-1]))
        qpos, qvel = np.broadcast_to(qpos, (count, model.nq)), np.broadcast_to(qvel, (count, model.nv))
        each, rows = np.arange(count), np.tile(np.arange(horizon), (count, 1))
        wanted = [Wanted("qpos", rows, tuple(range(model.nq))), Wanted("qvel", rows, tuple(range(model.nv)))]
        if self._blueprint.sensors:
            wanted.append(Wanted("sensordata", rows, tuple(range(model.nsensordata))))
        job = self._job(
            theta,
            delays=np.zeros((count, 1)),
            inputs=inputs,
            history=0,
            lengths=lengths,
            candidate=each,
            clip=each,
            queue=each[:, None],
            qpos=qpos,
            qvel=qvel,
            wanted=wanted,
        )
        predicted = self.cards[0].run(job)
        values = [to_host(part) for part in predicted.values]
        return Rollouts(
            values[0], values[1], values[2] if self._blueprint.sensors else None, predicted.completed
        )

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`; where a card's memory is full, in turns of half as many rollouts."""
        while True:
            try:
                return self._predict(theta, starts, errors, wanted)
            except NoRoomError:
                if self.cards[0].part < SMALLEST:
                    raise
                for card in self.cards:
                    card.narrow()

    def _predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        count, clips, cards = len(theta), len(starts.lengths), len(self.cards)
        record = sum(8 * picked.rows.shape[1] * len(picked.columns) for picked in wanted)
        at_once = self.cards[0].at_once(record)
        shared = cards if count * clips >= cards * LEAST else 1
        by_candidate, by_clip = turns_of(count, clips, at_once)
        turns = -(-by_candidate // shared) * shared, by_clip  # as many for each card
        if turns == (1, 1):
            return _in_order(self.cards[0].run(self.job(theta, starts, errors, wanted)), count)
        return predicted_in_parts(turns, theta, starts, errors, wanted, self._dealt)

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> GpuEngine:
        """See `Engine.upon`."""
        about = self._blueprint
        edits = edits or self._edits.upon(model)
        engine = GpuEngine(model, edits, about.input_spec, about.sensors, self._devices)
        for card, before in zip(engine.cards, self.cards, strict=True):
            card.follow(before)  # of one layout: what was too small once need not be tried again
        return engine

    def _dealt(self, calls: Sequence[Call]) -> list[Predicted]:
        """The parts of a prediction, dealt to the cards; their numbers come together on the first."""
        cards = self.cards

        def in_turn(first: int) -> list[Predicted]:
            mine = calls[first :: len(cards)]
            return [_in_order(cards[first].run(self.job(*call)), len(call[0])) for call in mine]

        with ThreadPoolExecutor(len(cards)) as threads:
            by_card = list(threads.map(in_turn, range(len(cards))))
        results = [by_card[i % len(cards)][i // len(cards)] for i in range(len(calls))]
        return [candidates_last(Predicted(tuple(map(_gathered, p.values)), p.completed)) for p in results]

    def job(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Job:
        """All rollouts of a prediction, in the order (candidates, clips)."""
        model, count, clips = self._model, len(theta), len(starts.lengths)
        qpos, qvel = starts.states(model, count, errors)
        each = queues(starts.lengths, count, step_cost(model))
        queue = np.where(each < 0, -1, clips * np.arange(count)[:, None, None] + each)
        return self._job(
            theta,
            delays=self._edits.delays(theta) / model.opt.timestep,
            inputs=starts.inputs,
            history=starts.history,
            lengths=starts.lengths,
            candidate=np.repeat(np.arange(count), clips),
            clip=np.tile(np.arange(clips), count),
            queue=queue.reshape(-1, each.shape[1]),
            qpos=qpos.reshape(-1, model.nq),
            qvel=qvel.reshape(-1, model.nv),
            wanted=wanted,
        )

    def _job(self, theta: FloatArray, *, inputs: FloatArray, **about: Any) -> Job:
        """A job with the fields of the model under candidates (p, d)."""
        names = self._blueprint.set_by_jobs
        arrays = {name: np.repeat(getattr(self._model, name)[None], len(theta), axis=0) for name in names}
        self._edits.write(arrays, theta)
        return Job(fields=arrays, inputs=inputs.astype(np.float32), **about)


def compile_apart(about: tuple[Any, ...], count: int, compilers: int) -> None:
    """Compile the kernels that an engine needs in a process of the lowest priority, and wait for it.

    Which ones are missing only mujoco-warp's launches show, and these take Python's lock from rollouts for
    seconds. So a file in warp's cache says of a model that all of its kernels are there.

    Args:
        about: Arguments of the engine.
        count: Rollouts of a call.
        compilers: Threads.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    model, edits, input_spec, sensors, devices = about
    cards = [wp.get_device(device).arch for device in devices]
    fields = Blueprint.of(model, edits, input_spec, sensors).own  # values and priors are in no kernel
    needs = versions(), version("mujoco-warp"), model, fields, input_spec, sensors, cards
    key = hashlib.sha256(pickle.dumps(needs))
    mark = Path(str(wp.config.kernel_cache_dir), f"amhe-{key.hexdigest()[:16]}")
    if not mark.exists():
        logger.log(
            NOTE, "kernels of the graphics card compile with what cores have left, once for each model; "
            "the engine 'gpu' compiles them at once",
        )  # fmt: skip
        apart(partial(_compile, about, count, compilers, mark))


def _compile(about: tuple[Any, ...], count: int, compilers: int, mark: Path) -> None:
    GpuEngine(*about).load(count, compilers)
    mark.touch()


def _in_order(results: Predicted, count: int) -> Predicted:
    """The numbers of all rollouts of p candidates as (p, c, ...)."""
    values = tuple(part.reshape(count, -1, *part.shape[1:]) for part in results.values)
    return Predicted(values, results.completed.reshape(count, -1))


def _gathered(values: AnyArray) -> AnyArray:
    """An array on the first card; numpy's stay where they are."""
    if isinstance(values, np.ndarray):
        return values
    import cupy  # pyright: ignore[reportMissingImports]

    with cupy.cuda.Device(0):
        if values.device.id == 0:
            return values
        copied = cupy.array(values)
        cupy.cuda.get_current_stream().synchronize()  # their own card may use the memory again from here on
        return copied
