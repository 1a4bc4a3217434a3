"""One process that has the cards, and many that ask it: what they ask at the same time is one rollout.

A search asks for a few hundred rollouts, computes, and asks again. A card takes about as long for those of
one search as for those of fifty. So searches run in processes of their own, on all cores, and the process
with the cards answers all jobs upon one model that have arrived in the meantime with one run of its worlds.
No search waits for another one, but for the run that is going on.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from multiprocessing import current_process, get_context
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from threading import Condition, Lock, Thread
from typing import Any

import numpy as np

from amhe_cli.core.arrays import to_host
from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.gpu.blueprint import Blueprint
from amhe_cli.engine.gpu.job import Job, NoRoomError, joined
from amhe_cli.engine.rollout import Predicted

#: Blueprints of which the worlds are kept on a card.
KEPT = 12


@contextmanager
def sharing(devices: list[str]) -> Iterator[str]:
    """The address of a process that has these devices, for processes that are started inside.

    Raises:
        SimulationError: That process did not begin.
    """
    with tempfile.TemporaryDirectory() as folder:
        address, spawn = str(Path(folder) / "cards"), get_context("spawn")
        ready, tell = spawn.Pipe(duplex=False)
        process = spawn.Process(target=_serve, args=(address, devices, tell), daemon=True)
        process.start()
        tell.close()
        try:
            ready.recv()
        except EOFError:
            raise SimulationError("the process that has the graphics cards did not begin") from None
        try:
            yield address
        finally:
            process.terminate()
            process.join()


# -- the process that asks ---------------------------------------------------------------------------------


class SharedCard:
    """The cards of another process, in place of a `Card`.

    Args:
        blueprint: What all worlds share.
        address: Where the other process listens.

    Raises:
        SimulationError: mujoco-warp cannot simulate the model, or the other process is gone.
    """

    memory, part = 0, 1.0

    def __init__(self, blueprint: Blueprint, address: str) -> None:
        self._line, self._name = _line(address, os.getpid()), blueprint.name
        self._line.ask("open", self._name, blueprint.packed)
        self._at_once: dict[int, int] = {}

    def run(self, job: Job) -> Predicted:
        """See `Card.run`."""
        completed, values = self._line.ask("run", self._name, job)
        return Predicted(tuple(each.astype(np.float64) for each in values), completed)

    def at_once(self, record: int) -> int:
        """See `Card.at_once`."""
        if record not in self._at_once:
            self._at_once[record] = self._line.ask("at_once", self._name, record)
        return self._at_once[record]

    def narrow(self) -> None:
        """See `Card.narrow`."""
        self.part *= 0.5
        self._at_once.clear()
        self._line.ask("narrow", self._name, None)

    def follow(self, other: SharedCard) -> None:
        """See `Card.follow`; the other process sees to it."""

    def load(self) -> None:
        """See `Card.load`; the other process sees to it."""


class _Line:
    """The connection of this process to that with the cards."""

    def __init__(self, address: str) -> None:
        self._connection, self._lock = Client(address, authkey=current_process().authkey), Lock()

    def ask(self, *question: Any) -> Any:
        """What the other process answers.

        Raises:
            SimulationError: It refuses, or is gone.
        """
        with self._lock:
            try:
                self._connection.send(question)
                answer = self._connection.recv()
            except (EOFError, OSError):
                raise SimulationError("the process that has the graphics cards has ended") from None
        if isinstance(answer, Exception):
            raise answer
        return answer


@cache
def _line(address: str, process: int) -> _Line:
    """One for each process: a forked one has the connections of its parent in its memory."""
    return _Line(address)


# -- the process that has the cards ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Asked:
    """A question that waits for its answer; runs of one kind are answered together."""

    verb: str
    name: str
    about: Any
    answer: Future[Any] = field(default_factory=Future)

    @cached_property
    def kind(self) -> object:
        return (self.name, self.about.picks) if self.verb == "run" else self


def _serve(address: str, devices: list[str], tell: Connection) -> None:
    """Answer until the process is ended."""
    listener = Listener(address, backlog=1024, authkey=current_process().authkey)
    desk = _Desk()
    for device in devices:
        Thread(target=desk.work, args=(device,), daemon=True).start()
    tell.send(None)
    while True:
        Thread(target=_hear, args=(listener.accept(), desk.put), daemon=True).start()


def _hear(connection: Connection, ask: Callable[[_Asked], None]) -> None:
    """Answer the questions of one process, one after the other, until it ends."""
    while True:
        try:
            asked = _Asked(*connection.recv())
            ask(asked)
            try:
                answer = asked.answer.result()
            except Exception as error:
                answer = error
            connection.send(answer)
        except (EOFError, OSError):
            return


class _Desk:
    """Where questions wait for a card that is free."""

    def __init__(self) -> None:
        self._waiting: list[_Asked] = []
        self._change = Condition()
        self._packed: dict[str, bytes] = {}

    def put(self, asked: _Asked) -> None:
        """A new question."""
        with self._change:
            if asked.verb == "open":
                self._packed[asked.name] = asked.about
            self._waiting.append(asked)
            self._change.notify()

    def work(self, device: str) -> None:
        """Answer questions with one card, as long as the process lives."""
        cards: dict[str, Any] = {}
        while True:
            some = self._next()
            try:
                self._answer(some, self._card(cards, some[0].name, device))
            except Exception as error:
                for asked in some:
                    if not asked.answer.done():
                        asked.answer.set_exception(error)

    def _next(self) -> list[_Asked]:
        """The oldest question, and those that can be answered with it."""
        with self._change:
            self._change.wait_for(lambda: bool(self._waiting))
            kind = self._waiting[0].kind
            some = [asked for asked in self._waiting if asked.kind == kind]
            self._waiting = [asked for asked in self._waiting if asked.kind != kind]
        return some

    def _card(self, cards: dict[str, Any], name: str, device: str) -> Any:
        """The worlds of a blueprint on a card; the last used are the last to go."""
        import pickle

        from amhe_cli.engine.gpu.card import Card

        card = cards.pop(name, None)
        if card is None:
            while len(cards) >= KEPT:
                del cards[next(iter(cards))]
            card = Card(pickle.loads(self._packed[name]), device, coarse=True)
        cards[name] = card
        return card

    def _answer(self, some: list[_Asked], card: Any) -> None:
        verb, about = some[0].verb, some[0].about
        if verb != "run":
            some[0].answer.set_result({"open": lambda: None, "at_once": lambda: card.at_once(about),
                                       "narrow": card.narrow}[verb]())  # fmt: skip
            return
        record = sum(8 * rows * len(columns) for rows, columns in self._widths(some))
        most = card.at_once(record)
        while some:
            count, part = 0, []
            while some and (not part or count + len(some[0].about.clip) <= most):
                part.append(some.pop(0))
                count += len(part[-1].about.clip)
            try:
                self._run(part, card)
            except NoRoomError:
                if len(part) == 1:
                    raise
                for asked in part:
                    self._run([asked], card)

    @staticmethod
    def _widths(some: list[_Asked]) -> Iterator[tuple[int, tuple[int, ...]]]:
        """Samples and columns of the numbers that questions want."""
        for each in zip(*(asked.about.wanted for asked in some), strict=True):
            yield max(one.rows.shape[1] for one in each), each[0].columns

    @staticmethod
    def _run(part: list[_Asked], card: Any) -> None:
        """Answer some questions with one run of a card's worlds."""
        done, at = card.run(joined([asked.about for asked in part])), 0
        single = [each.astype(np.float32) for each in done.values]
        for asked in part:
            rows = slice(at, at + len(asked.about.clip))
            at = rows.stop
            values = [
                to_host(each[rows, : wanted.rows.shape[1]])
                for each, wanted in zip(single, asked.about.wanted, strict=True)
            ]
            asked.answer.set_result((done.completed[rows], values))
