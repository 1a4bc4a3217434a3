"""A fixed number of worlds on one card: their models, states, and the graph of one step."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from amhe_cli.core.errors import NOTE
from amhe_cli.engine.auto import OPENING
from amhe_cli.engine.gpu import kernels
from amhe_cli.engine.gpu.blueprint import Blueprint, Room
from amhe_cli.engine.gpu.job import Job
from amhe_cli.system.parameters.gear_friction import UPDATE

logger = logging.getLogger(__name__)

#: Blocks of the input vector, in the order of mjtState: bit, array of mjw.Data.
INPUTS = (
    (mujoco.mjtState.mjSTATE_CTRL, "ctrl"),
    (mujoco.mjtState.mjSTATE_QFRC_APPLIED, "qfrc_applied"),
    (mujoco.mjtState.mjSTATE_XFRC_APPLIED, "xfrc_applied"),
    (mujoco.mjtState.mjSTATE_MOCAP_POS, "mocap_pos"),
    (mujoco.mjtState.mjSTATE_MOCAP_QUAT, "mocap_quat"),
)
#: Held while a job is prepared: graphs are captured, and warp's default device is one for all threads.
PREPARING = Lock()


def captured(device: Any, launches: Callable[[], object]) -> Callable[[], None]:
    """A function that runs the launches as one CUDA graph; without a card it makes them one by one."""
    if device.is_cuda:
        with wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            launches()
        graph: Any = capture.graph
        return partial(wp.capture_launch, graph, stream=device.stream)

    def again() -> None:
        with wp.ScopedDevice(device):
            launches()

    return again


def load_together(device: Any, launches: Callable[[], object], compilers: int) -> None:
    """Load the modules of all kernels that launches need, and compile those that never were, side by side.

    Warp loads a module when a kernel of it is first launched, one after the other, which takes a minute where
    all must be compiled. So the launches are made once without effect, to see what they need: warp launches
    nothing from a module that it could not load. What this leaves out, or cannot load, loads at its launch.

    Args:
        launches: What is to be launched there.
        compilers: Number of threads.
    """
    kind: Any = type(wp.get_module(__name__))
    load, needed = kind.load, {}

    def note(module: Any, device: Any, block_dim: int | None = None) -> Any:
        if block_dim is None:  # it is asked how many threads suit a kernel, which takes the kernel itself
            return load(module, device)
        needed[module, block_dim] = None
        return None

    kind.load = note
    try:
        with wp.ScopedDevice(device), wp.ScopedCapture():
            launches()
    except Exception as error:
        logger.debug("not all kernels can be loaded side by side: %s", error)
    finally:
        kind.load = load
    said = []

    def load_or_compile(module: Any, block_dim: int) -> None:
        if not _compiled(module, block_dim) and not said:
            said.append(module)
            logger.log(
                NOTE, "kernels of the graphics card compile, once for each kind of model: a minute or less"
            )
        load(module, device, block_dim)

    left = iter(list(needed))

    def load_some() -> None:
        for module, block_dim in left:
            try:
                load_or_compile(module, block_dim)
            except Exception as error:
                logger.debug("%s: %s", module.name, error)

    # not at a lower priority than rollouts: they would wait for a core with Python's lock in hand;
    # and no executor's, for which the end of the process would wait until all are compiled
    threads = [Thread(target=load_some, daemon=True, name=OPENING) for _ in range(compilers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _compiled(module: Any, block_dim: int) -> bool:
    """Whether warp keeps a module's code on disk."""
    return Path(str(wp.config.kernel_cache_dir), module.get_module_identifier(block_dim)).is_dir()


@dataclass(frozen=True, eq=False)
class Work:
    """The launches of a job, recorded once for all steps.

    Args:
        ends: Steps after which each rollout of a queue is over, shape (w, l).
        begin: Launches before the first step of rollouts.
        step: Launches of every step.
        record: Launches after it that pick the wanted numbers.
        watch: The launch after it that counts it, and finds what diverged or had no room.
        completed, full: 1 for a rollout that did not diverge, and for one without room; warp arrays (n,).
    """

    ends: IntArray
    begin: Sequence[Callable[[], None]]
    step: Sequence[Callable[[], None]]
    record: Sequence[Callable[[], None]]
    watch: Callable[[], None]
    completed: Any
    full: Any

    def run(self) -> None:
        """Launch everything; the device may still be at work afterwards."""
        begins, each = {0, *np.unique(self.ends)}, (*self.step, *self.record, self.watch)
        for step in range(int(self.ends.max())):
            for launch in (*self.begin, *each) if step in begins else each:
                launch()


class Worlds:
    """Worlds on one device, kept from call to call.

    Args:
        blueprint: What the worlds share.
        count: Number of worlds.
        room: Buffers of each.
        device: Warp's name of the device.
        compilers: Threads that load the kernels of such worlds; 0: they have been loaded.
    """

    def __init__(
        self, blueprint: Blueprint, count: int, room: Room, device: str, *, compilers: int = 0
    ) -> None:
        self.count, self.room = count, room
        self._blueprint, self._device = blueprint, wp.get_device(device)
        self._xp = _namespace(self._device)
        with PREPARING, wp.ScopedDevice(self._device):
            model = mjw.put_model(blueprint.model, batch_sizes=dict.fromkeys(blueprint.own, count))
            data = mjw.make_data(blueprint.model, nworld=count, nconmax=room.contacts, njmax=room.rows)
            model.opt.warn_overflow = 0
            # contacts in a fixed order cost nothing; sums in a fixed order cost forty times the step
            model.opt.deterministic = mjw.DeterminismType.CONTACTS | mjw.DeterminismType.CONSTRAINT
            self._place, self.clock = (wp.zeros(count, dtype=int) for _ in range(2))
            self._begins = wp.zeros(count, dtype=bool)
            step, reset = (lambda: mjw.step(model, data)), (lambda: mjw.reset_data(model, data, self._begins))
            derive = (lambda: mjw.set_const(model, data, restore=False)) if blueprint.derives else reset
            if self._device.is_cuda and compilers:
                load_together(self._device, lambda: [each() for each in (step, reset, derive)], compilers)
            self.step, self._reset, self._derive = (captured(self._device, e) for e in (step, reset, derive))
            if blueprint.gear is not None:
                self._dry = wp.zeros_like(model.dof_frictionloss)
                self._of_gears = wp.zeros((count, *blueprint.gear.at.shape), dtype=float)
                self._before = wp.zeros((count, len(blueprint.gear.dofs)), dtype=float)
                self._forces = captured(self._device, lambda: _forces(model, data))
            if blueprint.servos is not None:
                self._of_servos = wp.zeros((count, *blueprint.servos.at.shape), dtype=float)
        self._model, self._data = model, data
        self._written: tuple[Mapping[str, FloatArray], IntArray] = ({}, np.empty(0, dtype=np.int64))

    def run(self, job: Job) -> tuple[list[AnyArray], BoolArray, bool]:
        """Roll out a job of at most `count` queues.

        Returns:
            The wanted numbers, each of shape (n, s, k), where the device has them; False where a rollout
            diverged, shape (n,); and whether a buffer was too small.
        """
        n = len(job.clip)
        with self.stream():
            with PREPARING:
                into = [self._xp.zeros((n, w.rows.shape[1], len(w.columns))) for w in job.wanted]
                work = self.prepare(job, into)
            work.run()
            wp.synchronize_device(self._device)
            full = work.full.numpy() != 0
            completed = work.completed.numpy().astype(bool) & ~full
        return into, completed, bool(full.any())

    def prepare(self, job: Job, into: list[AnyArray]) -> Work:
        """Write the parameters; the launches of a job."""
        queue = job.queue[np.minimum(np.arange(self.count), len(job.queue) - 1)]  # the last fills the rest
        candidate = job.candidate[queue[:, 0]]
        self._write(job.fields, candidate)
        self._place.fill_(-1)
        good = np.all(np.abs(np.hstack((job.qpos, job.qvel))) < 1e10, axis=1)
        completed, full = (self._array(flags, np.int32) for flags in (good, np.zeros(len(good))))
        progress = self._array(queue, np.int32), self._place, self.clock, self._array(job.clip, np.int32)
        first = (
            self._array(np.where(good[:, None], values, home), np.float32)
            for values, home in ((job.qpos, self._blueprint.model.qpos0), (job.qvel, 0.0))
        )
        lengths, data = job.lengths, self._data
        begin = [
            self._recorded(
                kernels.take_next,
                self.count,
                (*progress, self._array(lengths + job.lag, np.int32), self._begins),
            ),
            self._reset,
            self._recorded(
                kernels.begin, self.count, (*progress[:2], self._begins, *first, data.qpos, data.qvel)
            ),
        ]
        inputs = [*self._inputs(job, candidate, progress), *self._driven()]
        first_friction, friction = self._friction(inputs)
        state = (data.qpos, data.qvel, data.act, data.qacc_warmstart)
        watched = (*progress, self._array(lengths, np.int32), data.overflow, self._model.qpos0, *state)
        watch = self._recorded(kernels.watch, self.count, (*watched, completed, full))
        return Work(
            ends=job.ends,
            begin=[*begin, *first_friction],
            step=[*inputs, self.step, *friction],
            record=self._records(job, into, progress),
            watch=watch,
            completed=completed,
            full=full,
        )

    def _inputs(self, job: Job, candidate: IntArray, progress: Sequence[Any]) -> list[Callable[[], None]]:
        """Launches that write the inputs of a step."""
        if not job.inputs.shape[2]:
            return []
        whole, fraction = np.divmod(np.broadcast_to(job.delays, (len(job.delays), job.inputs.shape[2])), 1.0)
        shared = (
            *progress,
            self._array(job.inputs[:, : job.history + job.lengths.max()], np.float32),
            self._array(candidate, np.int32),
            self._array(whole, np.int32),
            self._array(fraction, np.float32),
            job.history,
        )
        launches, first = [], 0
        for bit, name in INPUTS:
            width = mujoco.mj_stateSize(self._blueprint.model, int(bit))
            if self._blueprint.input_spec & int(bit) and width:
                flat = _flat(getattr(self._data, name), (self.count, width))
                launches.append(self._recorded(kernels.write_inputs, flat.shape, (*shared, first, flat)))
                first += width
        return launches

    def _driven(self) -> list[Callable[[], None]]:
        """The launch that gives servos their torques before a step."""
        servos, model, data = self._blueprint.servos, self._model, self._data
        if servos is None:
            return []
        arguments = (
            self._array(servos.places, np.int32),
            self._of_servos,
            model.actuator_ctrllimited,
            model.actuator_ctrlrange,
            self._array(servos.ratio, np.float32),
            *(model.actuator_gainprm, model.actuator_forcerange, data.qpos, data.qvel, data.ctrl),
            model.actuator_biasprm,
        )
        return [self._recorded(kernels.drive, self._of_servos.shape[:2], arguments)]

    def _friction(
        self, inputs: Sequence[Callable[[], None]]
    ) -> tuple[list[Callable[[], None]], list[Callable[[], None]]]:
        """Launches that set what friction can hold: of worlds that begin a rollout, and after a step."""
        gear, data = self._blueprint.gear, self._data
        if gear is None:
            return [], []
        every = max(1, round(UPDATE / self._blueprint.model.opt.timestep))
        holds, dofs = self._model.dof_frictionloss, self._array(gear.dofs, np.int32)
        forces = (data.qfrc_actuator, data.qfrc_damper, data.qfrc_smooth, data.qfrc_constraint, data.qvel)
        begins = self._recorded(kernels.hold_dry, self._dry.shape, (self._begins, self._dry, holds))
        first, later = (
            self._recorded(
                kernels.hold,
                (self.count, len(gear.dofs)),
                (
                    self.clock,
                    each,
                    self._begins,
                    dofs,
                    self._of_gears,
                    self._dry,
                    *forces,
                    self._before,
                    holds,
                ),
            )
            for each in (0, every)
        )
        return [*inputs, begins, self._forces, first], [later]

    def _records(self, job: Job, into: list[AnyArray], progress: Sequence[Any]) -> list[Callable[[], None]]:
        """Launches that pick the wanted numbers after a step, of the worlds that have a queue."""
        steps = int(job.lengths.max())
        return [
            self._recorded(
                kernels.record,
                (len(job.queue), len(wanted.columns)),
                (
                    *progress,
                    int(wanted.source == "sensordata"),
                    getattr(self._data, wanted.source),
                    self._array(np.array(wanted.columns), np.int32),
                    *(self._array(part, np.int32) for part in _by_row(wanted.rows, steps)),
                    self._warp(values, wp.float64),
                ),
            )
            for wanted, values in zip(job.wanted, into, strict=True)
            if values.size
        ]

    def _write(self, fields: Mapping[str, FloatArray], candidate: IntArray) -> None:
        """Write each world's candidate, unless the worlds hold them already."""
        before, whose = self._written
        if np.array_equal(whose, candidate) and all(np.array_equal(before[n], fields[n]) for n in fields):
            return
        rows, arrays = self._xp.asarray(candidate), dict(fields)
        gear, servos = self._blueprint.gear, self._blueprint.servos
        numbers = arrays.pop("numeric_data", np.empty(0))
        if servos is not None:
            self._view(self._of_servos)[:] = self._up(numbers[:, servos.at])[rows]
        if gear is not None:
            self._view(self._of_gears)[:] = self._up(numbers[:, gear.at])[rows]
            self._view(self._dry)[:] = self._up(arrays["dof_frictionloss"])[rows]
        for name, values in arrays.items():
            into = self._view(getattr(self._model, name))
            into[:] = self._up(values)[rows].reshape(into.shape)
        if self._blueprint.derives:
            self._derive()
        self._written = fields, candidate.copy()

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Computations of the array library on the same card as warp's, and in their order."""
        if not self._device.is_cuda:
            yield
            return
        # CuPy's current card is one for each thread, and is the first unless it is told
        cuda = self._xp.cuda
        with cuda.Device(self._device.ordinal), cuda.Stream.from_external(self._device.stream):
            yield

    def _up(self, values: FloatArray) -> AnyArray:
        return self._xp.asarray(np.ascontiguousarray(values, dtype=np.float32))

    def _array(self, values: AnyArray, kind: type) -> Any:
        return wp.array(np.ascontiguousarray(values, dtype=kind), device=self._device)

    def _view(self, array: Any) -> AnyArray:
        """A warp array in the array library, without a copy; vectors become a last axis."""
        return self._xp.asarray(array) if self._device.is_cuda else array.numpy()

    def _warp(self, values: AnyArray, kind: Any) -> Any:
        """An array of the array library in warp, without a copy."""
        pointer = values.data.ptr if self._device.is_cuda else values.ctypes.data
        return wp.array(ptr=pointer, shape=values.shape, dtype=kind, device=self._device)

    def _recorded(self, kernel: Any, size: Any, arguments: Sequence[Any]) -> Callable[[], None]:
        """A launch of a kernel with its arguments, which live as long as it may run."""
        kept = list(arguments)
        command: Any = wp.launch(kernel, size, kept, device=self._device, record_cmd=True)
        return lambda kept=kept: command.launch()


def _forces(model: Any, data: Any) -> None:
    """Compute forces in the present states, and leave everything from which a step starts as it is."""
    warm = wp.clone(data.qacc_warmstart)
    mjw.forward(model, data)
    wp.copy(data.qacc_warmstart, warm)


def _namespace(device: Any) -> Any:
    """The array library of a device: numpy for the processor, CuPy for a card."""
    if not device.is_cuda:
        return np
    import cupy  # pyright: ignore[reportMissingImports]

    return cupy


def _flat(array: Any, shape: tuple[int, int]) -> Any:
    """An array of vectors as one of numbers, shape (worlds, width), without a copy."""
    return wp.array(ptr=array.ptr, shape=shape, dtype=wp.float32, device=array.device)


def _by_row(rows: IntArray, steps: int) -> tuple[IntArray, IntArray]:
    """Samples of each clip in the order of their rows.

    Args:
        rows: Row of each sample, shape (c, s).
        steps: Number of rows, H.

    Returns:
        Where each row's samples begin in that order, shape (c, H + 1), and the order, shape (c, s).
    """
    order = np.argsort(rows, axis=1, kind="stable")
    first = [np.searchsorted(own[by], np.arange(steps + 1)) for own, by in zip(rows, order, strict=True)]
    return np.array(first), order
