"""From messages as they come to samples: the decoder of logs, and a clock that goes on.

Nothing that a sender does takes more than a bounded memory, or ends anything: what cannot be read is left
out, counted, and said once for each topic.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Samples, merged
from amhe_cli.core.resample import longest_bridge
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs.clocks import Timeline
from amhe_cli.logs.collect import checked, missing
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.messages.decode import SignalDecoder, SignalSamples
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.split import Splitter
from amhe_cli.logs.tracks import SignalTrack

#: Time between two looks at a transport [s]: what comes meanwhile is decoded at once.
STEP = 0.01
#: Notes that a sender can cause.
_NOTES = 50
#: Topic of the simulated time.
CLOCK = "/clock"
#: A stamp that is off by more [s] from where its topic's stamps are is strange: it, or the clock, is wrong.
#: A topic without stamps is moved onto the clock of the others where that is off by more.
_STRANGE = 1.0
#: So many strange stamps of a topic in a row are a clock that was set.
_SET = 10
#: After a clock was set back, messages of before may still come for so long [s].
_SETTLING = 0.3
#: Share of a new lag in the mean of a topic's lags.
_NEW = 0.05
#: Decoders begin anew after so many messages: what they remember of a sender's names and layouts is bounded.
_FRESH = 50_000
#: A topic that is absent for so long [s] is reported; it may still come.
_ABSENT = 3.0
#: Shortest silence of a topic that is reported [s]; longer where its messages are further apart.
_SILENCE = 0.5
#: Arrivals that give a topic's rate, and pauses between looks that brought something.
_ARRIVALS, _PAUSES = 200, 20
#: Longest time that a window waits for a topic whose messages lag behind others [s].
_PATIENCE = 0.1


class Transport:
    """Brings messages as they are, and holds no more than a bounded number of them.

    Args:
        about: Whom it listens to, in words.

    Attributes:
        over: Whether nothing more will come.
        connections: Topics that are offered, wanted or not.
    """

    def __init__(self, about: str) -> None:
        self.about, self.over = about, False
        self.connections: list[Connection] = []
        self._told: dict[str, bool] = {}

    def receive(self) -> list[Batch]:
        """The messages since the last call; does not wait."""
        raise NotImplementedError

    def note(self, text: str) -> None:
        """Remember to say something, once."""
        if len(self._told) < _NOTES:
            self._told.setdefault(text, False)

    def notes(self) -> list[str]:
        """What is to be said since the last call."""
        fresh = [text for text, told in self._told.items() if not told]
        self._told |= dict.fromkeys(fresh, True)
        return fresh

    def announce(self, topic: str, msgtype: str) -> None:
        """Say that messages will be sent, where who listens would miss the first one otherwise."""

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """Send a message in CDR to whoever listens, where the transport can."""

    def close(self) -> None:
        """Let go of what was opened."""


@dataclass(slots=True)
class LiveTopic:
    """How one topic does, and what is known of it while its messages come.

    Attributes:
        name: Name of the topic.
        offset: What is added to its stamps [s].
        count: Messages so far.
        lag: Time from a message's stamp to its arrival [s]: transport, and the offset of the clocks; None
            before the first.
        dropped: Messages that could not be read, came out of order, or have a stamp that cannot be true.
        silent: Whether it has stopped.
    """

    name: str
    offset: float = 0.0
    count: int = 0
    lag: float | None = None
    dropped: int = 0
    silent: bool = False
    connection: Connection | None = None
    splitter: Splitter | None = None
    decoders: list[tuple[Signal, SignalDecoder]] = field(default_factory=list)
    strange: int = 0
    reached: dict[str, float] = field(default_factory=dict)
    angles: dict[str, FloatArray] = field(default_factory=dict)
    stamped: bool = False
    heard: float = 0.0
    arrivals: deque[int] = field(default_factory=lambda: deque(maxlen=_ARRIVALS))
    pauses: deque[float] = field(default_factory=lambda: deque(maxlen=_PAUSES))

    @property
    def rate(self) -> float:
        """Messages a second, lately [Hz]."""
        span = (self.arrivals[-1] - self.arrivals[0]) / 1e9 if self.arrivals else 0.0
        return (len(self.arrivals) - 1) / span if span > 0.0 and not self.silent else 0.0

    @property
    def newest(self) -> float:
        """Time of its newest sample [s]; minus infinity before the first."""
        return max(self.reached.values(), default=-np.inf)

    def bridge(self, max_gap: float) -> float:
        """Longest silence that is no gap [s]; infinite for commands that are sent on change."""
        held = all(signal.held for signal, _ in self.decoders)
        return longest_bridge(np.array(self.arrivals) / 1e9, max_gap, held)

    def believed(self, lags: FloatArray) -> BoolArray:
        """Which of some lags (n,) [s] fit those before them; after the first `_SET` that do not, none."""
        fits = np.zeros(lags.size, dtype=bool)
        for i, lag in enumerate(lags.tolist()):
            usual = lag if self.lag is None else self.lag
            fits[i] = abs(lag - usual) < _STRANGE
            self.strange = 0 if fits[i] else self.strange + 1
            self.lag = usual + (_NEW * (lag - usual) if fits[i] else 0.0)
            if self.strange >= _SET:
                break
        return fits


class LiveSource:
    """Samples of the messages that a transport brings.

    Args:
        transport: Brings the messages.
        signals: What is decoded.
        definitions: Definitions of the message types.
        settings: The stamps that count, and the longest gap.
        sim_time: Messages without a stamp are stamped by the topic /clock, as ROS does under `use_sim_time`.

    Attributes:
        about: Whom it listens to, in words.
        epoch: How often its clock has been set back.
        topics: How the topics of the signals do, by their names.
    """

    def __init__(
        self,
        transport: Transport,
        signals: Sequence[Signal],
        definitions: Definitions,
        settings: LogSettings,
        sim_time: bool = False,
    ) -> None:
        self.about, self.epoch, self._transport, self._signals = transport.about, 0, transport, signals
        self._definitions, self._settings = definitions, settings
        self._clock_ns: int | None = 0 if sim_time else None
        self.topics: dict[str, LiveTopic] = {}
        for signal in signals:
            self.topics.setdefault(signal.topic, LiveTopic(signal.topic, signal.offset))
        self._said: set[tuple[str, str]] = set()
        self._events: list[str] = []
        self._origin_ns: int | None = None
        self._resume_at, self._settled_at = 0.0, -np.inf
        self._begun = np.inf

    @property
    def over(self) -> bool:
        """Whether nothing more will come."""
        return self._transport.over

    @property
    def now(self) -> float:
        """Time up to which all that streams has arrived [s]; minus infinity before the first sample.

        It is that of the newest sample, or a little less while another topic lags.
        """
        topics, gap = self.topics.values(), self._settings.max_gap
        newest = max((topic.newest for topic in topics), default=-np.inf)
        streaming = (t.newest for t in topics if not t.silent and np.isfinite(t.bridge(gap)))
        return max(newest - _PATIENCE, min(streaming, default=newest))

    def wait(self) -> Samples:
        """The samples since the last call, after `STEP`; each quantity in the order of time."""
        self._begun = min(self._begun, time.monotonic())
        time.sleep(STEP)
        parts = [part for batch in self._transport.receive() for part in self._samples(batch)]
        if not self.over:
            self._look_around()
        return merged(parts) if parts else {}

    def events(self) -> list[str]:
        """What has gone wrong, or right again, since the last call, a line each."""
        found, self._events = self._events, []
        return [*self._transport.notes(), *found]

    def stamp_ns(self, seconds: float) -> int:
        """The sender's stamp [ns] at a time of the samples [s]."""
        return (self._origin_ns or 0) + round(1e9 * seconds)

    # -- messages -------------------------------------------------------------------------------------

    def _samples(self, batch: Batch) -> list[Samples]:
        """Samples of one batch, of each signal that its topic carries."""
        name = batch.connection.topic
        if self._clock_ns is not None:
            self._clock_ns = (name == CLOCK and _clock_of(batch)) or self._clock_ns
            batch = replace(batch, publish_ns=np.full_like(batch.log_ns, self._clock_ns))
        topic = self.topics.get(name)
        if topic is None or self._clock_ns == 0 or not self._readable(topic, batch.connection):
            return []
        assert topic.splitter is not None
        groups = sorted(topic.splitter.split(batch), key=lambda group: int(group.members[0]))
        heard, topic.heard = topic.heard, time.monotonic()
        topic.pauses.append(topic.heard - (heard or topic.heard))
        topic.arrivals.extend(batch.log_ns.tolist())
        topic.count += batch.starts.size
        if topic.splitter.damaged:
            topic.dropped, topic.splitter.damaged = topic.dropped + topic.splitter.damaged, 0
            self._say(name, "damaged", f"messages that cannot be read are dropped ({topic.splitter.reason})")
        found = []
        for signal, decoder in topic.decoders:
            try:
                decoder.feed(batch, groups)
            except (LogError, ConfigError) as error:
                self._say(name, signal.name, str(error))
            if decoder.lacking and topic.count > _SET:
                self._say(name, f"{signal.name} joints", decoder.lacking)
            samples = decoder.taken()
            times, rows = self._times(topic, signal, samples)
            if times.size:
                found.append(self._of_signal(topic, signal, samples.pick(rows), times))
            if topic.count % _FRESH < batch.starts.size:
                decoder.forget()
        if topic.count % _FRESH < batch.starts.size:
            topic.splitter = Splitter(batch.connection, self._definitions)
        return found

    def _readable(self, topic: LiveTopic, connection: Connection) -> bool:
        """Whether messages of a connection can be read as those of its topic so far."""
        if topic.connection is None:
            wanting = [signal for signal in self._signals if signal.topic == topic.name]
            try:
                topic.splitter = Splitter(connection, self._definitions)
                topic.decoders = [(signal, SignalDecoder(signal, connection)) for signal in wanting]
            except (LogError, ConfigError) as error:
                self._say(topic.name, "type", str(error))
                return False
            topic.connection = connection
        own = topic.connection.type
        if connection.type != own:
            self._say(topic.name, "types", f"carries {connection.type}, too; only {own} is read")
        return connection.type == own

    def _of_signal(
        self, topic: LiveTopic, signal: Signal, samples: SignalSamples, times: FloatArray
    ) -> Samples:
        """Values in SI at their times (n,)."""
        samples = checked(samples, signal, lambda text: self._say(signal.topic, "impossible", text))
        line = Timeline("header", samples.header_ns, np.arange(times.size), 0.0, ())
        track = SignalTrack(signal, line, samples)
        found: dict[str, tuple[FloatArray, FloatArray]] = {}
        for quantity in signal.quantities:
            values = track.converted(quantity)
            if values is None:
                continue
            if signal.wraps and quantity == "position":  # go on from where the last portion ended
                before = topic.angles.get(signal.name, values[0])
                values = values + 2.0 * np.pi * np.round((before - values[0]) / (2.0 * np.pi))
                topic.angles[signal.name] = values[-1]
            found[signal.key(quantity)] = times, values
        return found

    # -- times ----------------------------------------------------------------------------------------

    def _times(self, topic: LiveTopic, signal: Signal, samples: SignalSamples) -> tuple[FloatArray, IntArray]:
        """Times [s] of the samples that count, strictly increasing, and their rows; shape (n,) each."""
        if np.any(samples.delay_ns):
            text = "later points of a trajectory are left out; take the topic of the controller's state"
            self._say(signal.topic, "trajectory", text)
        stamps = self._stamps(topic, samples)
        arrivals = samples.log_ns if self._clock_ns is None else samples.publish_ns
        rows = np.flatnonzero((stamps != 0) & (samples.delay_ns == 0))
        if time.monotonic() < self._settled_at:
            rows = rows[:0]
        rows = rows[topic.believed((arrivals - stamps)[rows] / 1e9)]
        if topic.strange >= _SET:
            self._set(topic, float((arrivals - stamps)[-1]) / 1e9)
            rows = rows[:0]
        if rows.size and self._origin_ns is None:
            self._origin_ns = int(stamps[rows].min()) - round(1e9 * self._resume_at)
        times = (stamps[rows] - (self._origin_ns or 0)) / 1e9
        order = np.argsort(times, kind="stable")
        reached = topic.reached.get(signal.name, -np.inf)
        fresh = np.diff(times[order], prepend=-np.inf) > 0.0
        order = order[fresh & (times[order] > reached)]
        topic.dropped += stamps.size - order.size
        topic.reached[signal.name] = float(times[order[-1]]) if order.size else reached
        return times[order], rows[order]

    def _stamps(self, topic: LiveTopic, samples: SignalSamples) -> IntArray:
        """The stamps that count [ns], shape (n,); 0 where there is none."""
        chosen, shift = self._settings.stamp, topic.offset
        topic.stamped |= chosen in ("auto", "header") and bool(samples.header_ns.any())
        if topic.stamped or (
            samples.has_header and topic.count <= _SET
        ):  # a first stamp may be that of t = 0
            return np.where(samples.header_ns != 0, samples.header_ns + round(1e9 * shift), 0)
        lags = [other.lag for other in self.topics.values() if other.stamped and other.lag is not None]
        middle = float(np.median(lags)) if lags else 0.0
        shift -= middle if abs(middle) > _STRANGE else 0.0
        return (samples.log_ns if chosen == "log" else samples.publish_ns) + round(1e9 * shift)

    def _set(self, topic: LiveTopic, lag: float) -> None:
        """A clock was set: ahead, stamps count as they are; back, all begin again, later than now."""
        ahead, now = (topic.lag or 0.0) - lag, time.monotonic()
        topic.lag, topic.strange = lag, 0
        way = "ahead" if ahead > 0.0 else "back; estimation begins again, and the belief stays"
        if now > self._settled_at + _STRANGE:  # one that is set all the time is one event
            self._events.append(f"topic {topic.name!r}: its clock was set {abs(ahead):.3g} s {way}")
        self._settled_at = now
        if ahead > 0.0:
            return
        newest = max(one.newest for one in self.topics.values())
        self._resume_at = newest + 2.0 * self._settings.max_gap if np.isfinite(newest) else self._resume_at
        self._origin_ns, self._settled_at, self.epoch = None, now + _SETTLING, self.epoch + 1
        for one in self.topics.values():
            one.lag, one.reached, one.angles = None, {}, {}

    # -- health ---------------------------------------------------------------------------------------

    def _look_around(self) -> None:
        """Note topics that are absent, have stopped or go on again."""
        now = time.monotonic()
        for signal in self._signals:
            topic = self.topics[signal.topic]
            if topic.connection is None:
                if now - self._begun > _ABSENT and (signal.topic, "type") not in self._said:
                    text = missing(self._transport.connections, signal)
                    self._say(signal.topic, "absent", f"{text}; waiting")
                continue
            silence = now - topic.heard
            usual = max(_SILENCE, topic.bridge(self._settings.max_gap), 3.0 * max(topic.pauses))
            if (silence > usual) != topic.silent:
                topic.silent = not topic.silent
                words = f"has stopped: nothing for {silence:.1f} s" if topic.silent else "goes on again"
                self._events.append(f"topic {signal.topic!r} {words}")

    def _say(self, topic: str, kind: str, text: str) -> None:
        """Note something, once for each topic and kind."""
        if (topic, kind) not in self._said:
            self._said.add((topic, kind))
            self._events.append(text if repr(topic) in text else f"topic {topic!r}: {text}")


def _clock_of(batch: Batch) -> int:
    """The newest time on /clock [ns]: seconds and nanoseconds in CDR; 0 where there is none."""
    start = int(batch.starts[-1])
    message = batch.buffer[start : start + int(batch.lengths[-1])].tobytes()
    if len(message) != 12:
        return 0
    order = "little" if message[1] & 1 else "big"
    return int.from_bytes(message[4:8], order) * 10**9 + int.from_bytes(message[8:12], order)
