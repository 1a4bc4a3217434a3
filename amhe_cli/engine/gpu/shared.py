"""One process that has the cards, and many that ask it: what they ask at the same time is one rollout.

A search asks for a few hundred rollouts, computes, and asks again. A card takes about as long for those of
one search as for those of fifty. So searches run in processes of their own, on all cores, and the process
with the cards answers all jobs upon one model that have arrived in the meantime with one run of its worlds.
No search waits for another one, but for the run that is going on.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from multiprocessing.managers import BaseManager
from pathlib import Path
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from amhe_cli.core.arrays import AnyArray, to_host
from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.gpu.blueprint import Blueprint
from amhe_cli.engine.gpu.job import Job, NoRoomError, joined
from amhe_cli.engine.gpu.visible import missing
from amhe_cli.engine.rollout import Predicted

if TYPE_CHECKING:
    from amhe_cli.engine.gpu.card import Card

#: Blueprints of which the worlds are kept on a card.
KEPT = 12
#: Rollouts that one process asks for at once.
MOST = 8192


@contextmanager
def sharing(devices: list[str]) -> Iterator[str]:
    """The address of a process that has these devices, for processes that are started inside.

    Raises:
        SimulationError: That process did not begin, or lacks a library of the cards.
    """
    with tempfile.TemporaryDirectory() as folder:
        manager = _Manager(address := str(Path(folder) / "cards"), ctx=get_context("spawn"))
        try:
            manager.start()
        except EOFError:
            raise SimulationError("the process that has the graphics cards did not begin") from None
        with manager:
            try:
                manager.desk().open(devices)
            except ImportError as error:
                raise missing(error) from None
            yield address


# -- the process that asks ---------------------------------------------------------------------------------


class SharedCard:
    """The cards of another process, in place of a `Card`.

    Args:
        blueprint: What all worlds share.
        address: Where the other process listens.

    Raises:
        SimulationError: mujoco-warp cannot simulate the model, or the other process is gone.
    """

    memory = 0

    def __init__(self, blueprint: Blueprint, address: str) -> None:
        self._desk, self._name, self._most = _desk_at(address), blueprint.name, MOST
        self._ask(blueprint.packed)

    @property
    def part(self) -> float:
        """See `Card.part`."""
        return self._most / MOST

    def run(self, job: Job) -> Predicted:
        """See `Card.run`."""
        completed, values = self._ask(job)
        return Predicted(tuple(each.astype(np.float64) for each in values), completed)

    def at_once(self, record: int) -> int:
        """See `Card.at_once`; no more than what others wait for."""
        return self._most

    def narrow(self) -> None:
        """See `Card.narrow`."""
        self._most //= 2

    def follow(self, other: SharedCard) -> None:
        """See `Card.follow`."""
        self._ask(other._name)

    def stand_back(self) -> None:
        """See `Card.stand_back`; the other process has cores of its own to ask for."""

    def _ask(self, about: bytes | str | Job) -> Any:
        try:
            return self._desk.ask(self._name, about)
        except (EOFError, OSError):
            raise SimulationError("the process that has the graphics cards has ended") from None


@cache
def _desk_at(address: str) -> _Desk:
    """What stands for the desk of another process; it connects anew in each thread and forked process."""
    manager = _Manager(address)
    try:
        manager.connect()
    except OSError:
        raise SimulationError("the process that has the graphics cards has ended") from None
    return manager.desk()


# -- the process that has the cards ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Request:
    """A question that waits for its answer.

    Args:
        name: Of the blueprint.
        about: The blueprint itself, packed, to begin with; another one's name, to follow it; or a job.
    """

    name: str
    about: bytes | str | Job
    answer: Future[Any] = field(default_factory=Future)

    @property
    def kind(self) -> object:
        """Questions of one kind are answered together."""
        return (self.name, self.about.picks) if isinstance(self.about, Job) else self


class _Desk:
    """Where questions wait for a card that is free."""

    def __init__(self) -> None:
        self._waiting: list[_Request] = []
        self._change = Condition()
        self._packed: dict[str, bytes] = {}

    def open(self, devices: Sequence[str]) -> None:
        """Begin to answer with these cards."""
        from amhe_cli.engine.gpu.card import Card  # which takes seconds to load

        for device in devices:
            Thread(target=self._work, args=(Card, device), daemon=True).start()

    def ask(self, name: str, about: bytes | str | Job) -> Any:
        """The answer to a question, as soon as a card has it."""
        request = _Request(name, about)
        with self._change:
            if isinstance(about, bytes):
                self._packed[name] = about
            self._waiting.append(request)
            self._change.notify()
        return request.answer.result()

    def _work(self, new: Callable[..., Card], device: str) -> None:
        """Answer questions with one card, as long as the process lives."""
        cards: dict[str, Card] = {}
        while True:
            together = self._next()
            for some in (together, *([request] for request in together)):
                left = [request for request in some if not request.answer.done()]
                if not left:
                    continue
                try:
                    name = left[0].name
                    card = cards.pop(name, None) or new(pickle.loads(self._packed[name]), device, coarse=True)
                    cards[name] = card  # the last used is the last to go
                    if len(cards) > KEPT:
                        del cards[next(iter(cards))]
                    if isinstance(about := left[0].about, str) and about in cards:
                        card.follow(cards[about])
                    _answer(left, card)
                except NoRoomError as error:  # worlds of other models go, and each job gets a run of its own
                    for card in cards.values():
                        card.clear()
                    if len(left) == 1:
                        left[0].answer.set_exception(error)
                except Exception as error:
                    for request in left:
                        request.answer.set_exception(error)

    def _next(self) -> list[_Request]:
        """The oldest question, and those that can be answered with it."""
        with self._change:
            self._change.wait_for(lambda: bool(self._waiting))
            kind = self._waiting[0].kind
            some = [request for request in self._waiting if request.kind == kind]
            self._waiting = [request for request in self._waiting if request.kind != kind]
        return some


@cache
def _desk() -> _Desk:
    return _Desk()


class _Manager(BaseManager):
    """The process that has the cards, or what leads to it."""

    desk: Callable[[], _Desk]


_Manager.register("desk", _desk, exposed=("open", "ask"))


def _answer(some: Sequence[_Request], card: Card) -> None:
    """Answer questions of one kind: jobs with as few runs of a card's worlds as it has room for."""
    jobs = [(one, one.about) for one in some if isinstance(one.about, Job)]
    if not jobs:
        some[0].answer.set_result(None)
        return
    wanted = zip(*(job.wanted for _, job in jobs), strict=True)
    record = sum(8 * max(one.rows.shape[1] for one in each) * len(each[0].columns) for each in wanted)
    most, sizes = card.at_once(record), np.cumsum([len(job.clip) for _, job in jobs])
    for number in np.unique(sizes // most):
        _run([jobs[i] for i in np.flatnonzero(sizes // most == number)], card)


def _run(part: Sequence[tuple[_Request, Job]], card: Card) -> None:
    """Answer jobs with one run of a card's worlds; numbers go in single precision, as they are."""
    done, at = card.run(joined([job for _, job in part])), 0
    single = [_single(each) for each in done.values]
    for request, job in part:
        rows, at = slice(at, at + len(job.clip)), at + len(job.clip)
        pairs = zip(single, job.wanted, strict=True)
        values = [to_host(each[rows, : wanted.rows.shape[1]]) for each, wanted in pairs]
        request.answer.set_result((done.completed[rows], values))


def _single(values: AnyArray) -> AnyArray:
    """An array in single precision, on the card where it lies."""
    with nullcontext() if isinstance(values, np.ndarray) else values.device:
        return values.astype(np.float32)
