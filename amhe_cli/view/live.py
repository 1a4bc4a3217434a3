"""A page that follows an online estimator: states of a run, or windows and what is predicted of them."""

from __future__ import annotations

import json
import logging
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, Full, Queue
from threading import Condition, Event, Thread
from typing import Any, Generic, TypeVar

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import plain
from amhe_cli.core.log import Window
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, usable
from amhe_cli.system.system import System
from amhe_cli.view.ghosts import MeasuredLog, takes_of
from amhe_cli.view.page import Heading, live_page
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
        encode: Makes the messages of an item, in the broadcast's own thread.
    """

    def __init__(self, page: str, encode: Callable[[T], Iterable[Mapping[str, Any]]]) -> None:
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

    def __exit__(self, *error: Any) -> None:
        self._over.set()
        self._thread.join(timeout=2.0)
        self._server.__exit__(*error)

    def _work(self) -> None:
        while not (self._over.is_set() and self._queue.empty()):
            try:
                messages = [plain(one) for one in self._encode(self._queue.get(timeout=0.1))]
            except Empty:
                continue
            except Exception as error:  # a fault of the picture is none of the loop's
                logger.warning("the live page misses something: %s", error)
                continue
            with self._news:
                self._messages.extend(json.dumps(one, separators=(",", ":")).encode() for one in messages)
                self._sent += len(messages)
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
        self, scene: Scene, ghosts: Sequence[str], curves: Sequence[TimeCurve], heading: Heading
    ) -> None:
        self._scene, self._next = scene, -np.inf
        super().__init__(live_page(scene, ghosts, curves, STEP, heading), lambda item: [self._message(item)])

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


class WindowsShown(Broadcast[tuple[Window, Estimate]]):
    """The newest part of each window, measured, and rolled out from the window's start by two beliefs.

    Args:
        first: Values of the parameters before the first estimate, shape (d,).
        about: Where the samples come from, in words.
    """

    def __init__(self, system: System, first: FloatArray, about: str) -> None:
        curves = [TimeCurve(p.name, "parameters", p.unit) for p in system.space.parameters]
        self._scene = scene_of(system)
        self._engine, self._first = open_engine(system, threads=1), system.space.z_of(first)
        self._shown = -np.inf
        page = live_page(self._scene, ["before", "now"], curves, STEP, Heading(system.name, (about,)))
        super().__init__(page, self._frames)

    def _frames(self, item: tuple[Window, Estimate]) -> Iterator[Mapping[str, Any]]:
        """The frames of a window that came after those of the one before."""
        (window, estimate), space = item, self._scene.system.space
        rows = zip(space.names, estimate.theta, estimate.lower, estimate.upper, strict=True)
        numbers = {name: values for name, *values in rows}
        last: dict[str, Any] = {"numbers": numbers, "event": estimate.mark == "jump", "time": estimate.time}
        if not usable(self._scene.system, window):
            yield last
            return
        z = [self._first, space.z_of(estimate.theta)]
        measured = MeasuredLog(self._scene, window.log, z[-1])
        (take,) = takes_of(measured, 0, [(window, None)], z, self._engine, 1.0 / STEP)
        tracks = [
            None if track is None else track.poses.astype("<f4") for track in (take.measured, *take.ghosts)
        ]
        begun = estimate.time - window.length * window.log.dt
        times = begun + take.measured.step * np.arange(len(take.measured.poses))
        for k in np.flatnonzero(times > self._shown + 0.5 * STEP):
            self._shown = float(times[k])
            poses = [None if each is None else b64encode(each[k].tobytes()).decode() for each in tracks]
            yield {"time": self._shown, "poses": poses}
        yield last
