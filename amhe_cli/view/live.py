"""A page that follows a run while it goes on.

States, ghosts and numbers go to it while a loop runs.
The loop only puts an item into a queue, and drops it where the queue is full. A thread of its own computes
what is drawn, and each browser has another one: none of them makes the loop wait.
"""

from __future__ import annotations

import json
import logging
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, Full, Queue
from threading import Condition, Event, Thread
from types import TracebackType
from typing import Any, Generic, TypeVar

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import plain
from amhe_cli.core.shown import TimeCurve
from amhe_cli.view.page import Heading, live_page
from amhe_cli.view.scene import Scene
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join(timeout=2.0)
        self._server.__exit__(kind, error, trace)

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
        self,
        scene: Scene,
        ghosts: Sequence[str],
        curves: Sequence[TimeCurve],
        heading: Heading,
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
