"""A fixed number of worlds on one card: their models, states, and the graph of one step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from amhe_cli.engine.gpu import kernels
from amhe_cli.engine.gpu.blueprint import Blueprint, Room
from amhe_cli.engine.rollout import Starts, Wanted

#: Blocks of the input vector, in the order of mjtState: bit, array of mjw.Data.
INPUTS = (
    (mujoco.mjtState.mjSTATE_CTRL, "ctrl"),
    (mujoco.mjtState.mjSTATE_QFRC_APPLIED, "qfrc_applied"),
    (mujoco.mjtState.mjSTATE_XFRC_APPLIED, "xfrc_applied"),
    (mujoco.mjtState.mjSTATE_MOCAP_POS, "mocap_pos"),
    (mujoco.mjtState.mjSTATE_MOCAP_QUAT, "mocap_quat"),
)
#: Buffers that were too small; the worlds are made again with larger ones.
FULL = (
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
)
#: Held while a job is prepared: graphs are captured, and warp's default device is one for all threads.
PREPARING = Lock()


@dataclass(frozen=True, eq=False)
class Job:
    """n rollouts, each of one candidate on one clip.

    Args:
        theta: Parameters of p candidates in SI units, shape (p, d).
        starts: Inputs and lengths of c clips.
        candidate, clip: Candidate and clip of each rollout, shape (n,).
        qpos, qvel: First states, shape (n, nq) and (n, nv).
        delays: Delays of each candidate's inputs [steps], shape (p, nu), or (p, 1) where all are alike.
        wanted: The numbers to pick.
    """

    theta: FloatArray
    starts: Starts
    candidate: IntArray
    clip: IntArray
    qpos: FloatArray
    qvel: FloatArray
    delays: FloatArray
    wanted: Sequence[Wanted]


def captured(device: Any, launches: Callable[[], None]) -> Callable[[], None]:
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


class _Launch:
    """A kernel with its arguments, which live as long as it may run."""

    def __init__(self, kernel: Any, size: Any, arguments: Sequence[Any], device: Any) -> None:
        self._arguments = list(arguments)
        self._command: Any = wp.launch(kernel, size, self._arguments, device=device, record_cmd=True)

    def run(self) -> None:
        self._command.launch()


class Worlds:
    """Worlds on one device, kept from call to call.

    Args:
        blueprint: What the worlds share.
        count: Number of worlds.
        room: Buffers of each.
        device: Warp's name of the device.
    """

    def __init__(self, blueprint: Blueprint, count: int, room: Room, device: str) -> None:
        self.count, self.room = count, room
        self._blueprint, self._device = blueprint, wp.get_device(device)
        self._xp = _namespace(self._device)
        with PREPARING, wp.ScopedDevice(self._device):
            model = mjw.put_model(blueprint.nominal, batch_sizes=dict.fromkeys(blueprint.own, count))
            data = mjw.make_data(blueprint.nominal, nworld=count, nconmax=room.contacts, njmax=room.rows)
            model.opt.warn_overflow = 0
            # contacts in a fixed order cost nothing; sums in a fixed order cost forty times the step
            model.opt.deterministic = mjw.DeterminismType.CONTACTS | mjw.DeterminismType.CONSTRAINT
            self._clock = wp.zeros(1, dtype=int)
            self._completed = wp.zeros(count, dtype=int)
            self.step = captured(self._device, lambda: mjw.step(model, data))
            self._reset = captured(self._device, lambda: mjw.reset_data(model, data))
            if blueprint.edits.needs_set_const:
                self._derive = captured(self._device, lambda: mjw.set_const(model, data, restore=False))
        self._model, self._data = model, data
        self._written = (np.empty((0, 0)), np.empty(0))

    def run(self, job: Job) -> tuple[list[AnyArray], BoolArray, bool]:
        """Roll out a job of at most `count` rollouts.

        Returns:
            The wanted numbers, each of shape (n, s, k), where the device has them; False where a rollout
            diverged, shape (n,); and whether a buffer was too small.
        """
        n, steps = len(job.clip), int(job.starts.lengths.max())
        with PREPARING, self.stream():
            into = [self._xp.zeros((self.count, w.rows.shape[1], len(w.columns))) for w in job.wanted]
            before, after = self.prepare(job, into, steps)
        for _ in range(steps + any(wanted.source == "sensordata" for wanted in job.wanted)):
            for launch in before:
                launch.run()
            self.step()
            for launch in after:
                launch.run()
        wp.synchronize_device(self._device)
        full = self._data.overflow.numpy()[:n] & int(FULL) != 0
        completed = self._completed.numpy()[:n].astype(bool) & ~full
        return [values[:n] for values in into], completed, bool(full.any())

    def prepare(self, job: Job, into: list[AnyArray], steps: int) -> tuple[list[_Launch], list[_Launch]]:
        """Write parameters and first states; the launches before and after each step."""
        n, data = len(job.clip), self._data
        fill = np.minimum(np.arange(self.count), n - 1)  # worlds without a rollout repeat the last
        candidate, clip = job.candidate[fill], job.clip[fill]
        self._write(job.theta, candidate)
        self._reset()
        good = np.all(np.abs(np.hstack((job.qpos, job.qvel))) < 1e10, axis=1)
        self._view(data.qpos)[:] = self._up(
            np.where(good[:, None], job.qpos, self._blueprint.model.qpos0)[fill]
        )
        self._view(data.qvel)[:] = self._up(np.where(good[:, None], job.qvel, 0.0)[fill])
        self._view(self._clock)[:] = 0
        self._view(self._completed)[:] = self._xp.asarray(good[fill])
        return self._launches(job, candidate, clip, into, steps)

    def _launches(
        self, job: Job, candidate: IntArray, clip: IntArray, into: list[AnyArray], steps: int
    ) -> tuple[list[_Launch], list[_Launch]]:
        """Launches before and after mujoco-warp's step, recorded once for all steps."""
        data, clips = self._data, self._array(clip, np.int32)
        before: list[_Launch] = []
        if job.starts.inputs.shape[2]:
            every = (len(job.delays), job.starts.inputs.shape[2])
            whole, fraction = np.divmod(np.broadcast_to(job.delays, every), 1.0)
            shared = (
                self._clock,
                self._array(job.starts.inputs[:, : job.starts.history + steps], np.float32),
                self._array(candidate, np.int32),
                clips,
                self._array(whole, np.int32),
                self._array(fraction, np.float32),
                job.starts.history,
            )
            first = 0
            for bit, name in INPUTS:
                width = mujoco.mj_stateSize(self._blueprint.model, int(bit))
                if self._blueprint.input_spec & int(bit) and width:
                    flat = _flat(getattr(data, name), (self.count, width))
                    before.append(self._recorded(kernels.write_inputs, flat.shape, (*shared, first, flat)))
                    first += width
        after = [
            self._recorded(
                kernels.record,
                (self.count, len(wanted.columns)),
                (
                    self._clock,
                    int(wanted.source == "sensordata"),
                    getattr(data, wanted.source),
                    self._array(np.array(wanted.columns), np.int32),
                    clips,
                    *(self._array(part, np.int32) for part in _by_row(wanted.rows, steps)),
                    self._warp(values, wp.float64),
                ),
            )
            for wanted, values in zip(job.wanted, into, strict=True)
            if values.size
        ]
        state = (data.qpos, data.qvel, data.act, data.qacc_warmstart, self._completed)
        lengths = self._array(job.starts.lengths, np.int32)
        watched = (self._clock, clips, lengths, self._model.qpos0, *state)
        after.append(self._recorded(kernels.watch, self.count, watched))
        after.append(self._recorded(kernels.tick, 1, (self._clock,)))
        return before, after

    def _write(self, theta: FloatArray, candidate: IntArray) -> None:
        """Write each world's candidate, unless the worlds hold them already."""
        if all(map(np.array_equal, self._written, (theta, candidate))):
            return
        edits, model = self._blueprint.edits, self._blueprint.model
        arrays = {name: np.repeat(getattr(model, name)[None], len(theta), axis=0) for name in edits.fields}
        edits.write(arrays, theta)
        rows = self._xp.asarray(candidate)
        for name, values in arrays.items():
            into = self._view(getattr(self._model, name))
            into[:] = self._up(values)[rows].reshape(into.shape)
        if edits.needs_set_const:
            self._derive()
        self._written = theta.copy(), candidate.copy()

    def stream(self) -> AbstractContextManager[Any]:
        """Computations of the array library in the order of warp's own."""
        if not self._device.is_cuda:
            return nullcontext()
        return self._xp.cuda.Stream.from_external(self._device.stream)

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

    def _recorded(self, kernel: Any, size: Any, arguments: Sequence[Any]) -> _Launch:
        return _Launch(kernel, size, arguments, self._device)


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
    first = np.zeros((len(rows), steps + 1), dtype=np.int64)
    clip, sample = np.nonzero(rows < steps)
    np.add.at(first, (clip, rows[clip, sample] + 1), 1)
    return first.cumsum(axis=1), np.argsort(rows, axis=1, kind="stable")
