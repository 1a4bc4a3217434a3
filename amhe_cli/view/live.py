"""Pages that follow what happens now: a run, or the windows of a replay.

States, ghosts and numbers go to them while a loop runs.
The loop only puts an item into a queue, and drops it where the queue is full. A thread of its own computes
what is drawn, and each browser has another one: none of them makes the loop wait.
"""

from __future__ import annotations

import json
import logging
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Condition, Event, Thread
from types import TracebackType
from typing import Any, Generic, TypeVar

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.curves import TimeCurve
from amhe_cli.core.files import plain
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.replay import ReplayProblem
from amhe_cli.view.ghosts import RATE, MeasuredLog, Recording, Viewing, columns_of, takes_of
from amhe_cli.view.page import Heading, live_page, replay_page, take_data
from amhe_cli.view.scene import Scene, scene_of
from amhe_cli.view.server import PageServer

logger = logging.getLogger(__name__)

#: Time between two frames [s].
STEP = 0.04
#: Items that wait to be drawn.
_WAITING = 50
#: Messages that a browser gets that comes late.
_KEPT = 15_000

T = TypeVar("T")


class Broadcast(Generic[T]):
    """A served page and a stream of messages to it; use it as a context manager.

    Args:
        page: The page.
        encode: Makes a message of an item, in the broadcast's own thread.
    """

    def __init__(self, page: str, encode: Callable[[T], Mapping[str, Any]]) -> None:
        self._encode = encode
        self._queue: Queue[T] = Queue(_WAITING)
        self._messages: deque[bytes] = deque(maxlen=_KEPT)
        self._sent, self._news, self._over = 0, Condition(), Event()
        self._server = PageServer(page, stream=self._stream)
        self._thread = Thread(target=self._work, daemon=True)

    def put(self, item: T) -> None:
        """Hand over what has happened; it returns at once, and drops the item where too many wait."""
        with suppress(Full):
            self._queue.put_nowait(item)

    @property
    def server(self) -> PageServer:
        """The server of the page."""
        return self._server

    def __enter__(self) -> Broadcast[T]:
        self._server.__enter__()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join(timeout=2.0)
        self._server.__exit__(kind, error, trace)

    def _work(self) -> None:
        while not (self._over.is_set() and self._queue.empty()):
            try:
                message = plain(self._encode(self._queue.get(timeout=0.1)))
            except Empty:
                continue
            except Exception as error:  # a fault of the picture is none of the loop's
                logger.warning("the live page misses something: %s", error)
                continue
            with self._news:
                self._messages.append(json.dumps(message, separators=(",", ":")).encode())
                self._sent += 1
                self._news.notify_all()

    def _stream(self, send: Callable[[bytes], None]) -> None:
        done = 0
        while True:
            with self._news:
                if done == self._sent and self._over.is_set() and not self._thread.is_alive():
                    return send(b'{"over":true}')
                if done == self._sent:
                    self._news.wait(timeout=0.5)
                first = self._sent - len(self._messages)
                new = list(self._messages)[max(done - first, 0) :]
                done = self._sent
            for text in new:
                send(text)


@dataclass(frozen=True, slots=True, eq=False)
class Happening:
    """What a loop shows of one instant.

    Args:
        time: Time of the instant [s].
        states: qpos of what is measured, and of each ghost; None: there is none. Shape (nq,) each.
        numbers: Name of a curve -> its value, and the ends of its band where it has one.
        event: Whether something happened that one may want to jump to.
        forces: Forces between touching bodies as of `engine.contacts`, shape (m, 6).
        traces: Lines through places that may come to pass [m], shape (k, h, 3).
    """

    time: float
    states: Sequence[FloatArray | None]
    numbers: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    event: bool = False
    forces: FloatArray | None = None
    traces: FloatArray | None = None


class StatesShown(Broadcast[Happening]):
    """States of a system while they happen.

    Args:
        scene: What is drawn.
        ghosts: Names of the ghosts.
        curves: What is plotted, without values.
        heading: What stands around the scene.
    """

    def __init__(
        self,
        scene: Scene,
        ghosts: Sequence[str],
        curves: Sequence[TimeCurve],
        heading: Heading,
    ) -> None:
        self._scene, self._next = scene, -np.inf
        super().__init__(live_page(scene, ghosts, curves, STEP, heading), self._message)

    def due(self, time: float) -> bool:
        """Whether a frame is due at a time [s]; what lies between two frames is not shown."""
        if time < self._next:
            return False
        self._next = time + STEP - 1e-6
        return True

    def _message(self, item: Happening) -> dict[str, Any]:
        known = [state for state in item.states if state is not None]
        poses = iter(self._scene.poses(np.array(known)))
        packed = [
            None if state is None else b64encode(next(poses).astype("<f4").tobytes()).decode()
            for state in item.states
        ]
        message = {"time": item.time, "poses": packed, "numbers": item.numbers, "event": item.event}
        for name, drawn in (("forces", item.forces), ("traces", item.traces)):
            if drawn is not None:
                message[name] = b64encode(drawn.astype("<f4").tobytes()).decode()
        return message | ({} if item.traces is None else {"points": item.traces.shape[1]})


#: Frames of a second of the whole log.
_COARSE = 20.0


class TakesShown(Broadcast[tuple[int, Estimate]]):
    """Windows of a replay and their estimates.

    Args:
        problem: The replay; its windows are all of one log.
    """

    def __init__(self, problem: ReplayProblem) -> None:
        self._problem, self._count = problem, 0
        system, log = problem.system, problem.windows[0].log
        scene = scene_of(system)
        self._measured = MeasuredLog(scene, log, problem.start.z)
        self._engine = open_engine(system)  # the estimator's own is busy
        curves = [TimeCurve(p.name, "parameters", p.unit) for p in system.space.parameters]
        curves += [TimeCurve("misfit", "estimator"), TimeCurve("update time", "estimator", "ms")]
        track, gaps = self._measured.track(_COARSE), self._measured.gaps
        recording = Recording(Path(log.source).name, track, gaps, curves)
        found = Viewing(scene, tuple(columns_of(system, log)), ("before", "estimated"), (recording,), (), 0)
        heading = Heading(f"mhe-replay: {recording.name}", (f"{log.duration:.1f} s of log",))
        page, self._packed = replay_page(found, heading)
        super().__init__(page, self._message)

    def show(self, estimate: Estimate) -> None:
        """Hand over the estimate after the next window."""
        self.put((self._count, estimate))
        self._count += 1

    def _message(self, item: tuple[int, Estimate]) -> dict[str, Any]:
        number, estimate = item
        window, space = self._problem.windows[number], self._problem.system.space
        ends = zip(space.names, estimate.theta, estimate.lower, estimate.upper, strict=True)
        message: dict[str, Any] = {
            "time": window.stop * window.log.dt,
            "event": estimate.mark == "jump",
            "numbers": {name: tuple(map(float, values)) for name, *values in ends}
            | {"misfit": (estimate.misfit,), "update time": (estimate.update_ms,)},
        }
        if estimate.mark != "gap":
            z = np.stack((self._problem.start.z, space.z_of(estimate.theta)))
            (take,) = takes_of(self._measured, 0, [(window, None)], z, self._engine, RATE)
            message["take"] = take_data(take, self._packed)
        return message
