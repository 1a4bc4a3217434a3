"""A watch: what a terminal and Prometheus show of it, and the files that it keeps."""

from __future__ import annotations

import csv
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from amhe_cli.audit.audit import Line
from amhe_cli.core.belief import Belief
from amhe_cli.core.files import fresh, plain
from amhe_cli.estimation.online import messages
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.logs import LogWriter
from amhe_cli.logs.live.messages import LiveSource
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.report.audit import STYLES, audit_record, audit_table, count_text
from amhe_cli.report.numbers import interval, with_sd
from amhe_cli.report.replay_files import csv_header, csv_row
from amhe_cli.report.tables import NUMBER, Table, rich_table
from amhe_cli.system.provenance import attachments
from amhe_cli.system.system import System

#: Topics that a watch publishes, and the types of their messages.
PUBLISHED = {
    "/amhe/params": "sensor_msgs/msg/JointState",
    "/amhe/covariance": "std_msgs/msg/Float64MultiArray",
    "/amhe/jump": "sensor_msgs/msg/JointState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
#: Level of a diagnostic_msgs/DiagnosticStatus: nothing new comes.
STALE = 3
_LEVELS = {OK: ("ok", "green"), WARN: ("warning", "yellow"), ERROR: ("error", "red"), STALE: ("stale", "red")}
#: A jump or an event is a warning for so long; without new samples a watch is stale after so long [s].
_RECENT, _STALE = 5.0, 1.0
#: Time between two diagnostics, and two copies of the belief on the disk [s].
_DIAGNOSED, _KEPT = 1.0, 10.0
#: Estimates that a line of blocks shows, and events below it.
_SHOWN, _EVENTS = 24, 5
_BLOCKS = "▁▂▃▄▅▆▇█"


class WatchReport:
    """Takes in what happens, keeps files of it, and shows it; use it as a context manager.

    The files are estimates.csv, estimates.mcap and belief.yaml.

    Args:
        folder: Folder of the files; made if it does not exist.
        source: Where its samples come from.
        provenance: Versions, hashes, seed and command.
        send: What is called with topic, type and bytes of each message for others.
        alarms: Alarms in words -> whether an estimate raises them.
        audit: Holds the numbers of a file against a belief; None: there is no file.
    """

    def __init__(
        self,
        folder: Path,
        system: System,
        source: LiveSource,
        provenance: Mapping[str, object],
        send: Sequence[Callable[[str, str, bytes], None]],
        alarms: Mapping[str, Callable[[Estimate], bool]],
        audit: Callable[[Belief], Sequence[Line]] | None = None,
    ) -> None:
        self._folder, self._system, self._source = folder, system, source
        self._provenance, self._send, self._alarms = provenance, send, alarms
        self._audit, self._lines, self._audited = audit, list[Line](), list[Estimate]()
        self._counts, self._last, self._jump = Counter[str](), list[Estimate](), list[Estimate]()
        self._history: deque[Estimate] = deque(maxlen=_SHOWN)
        self._events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self._holding, self._noted, self._lag, self._now = list[str](), "", 0.0, -np.inf
        self._moved_at = self._kept_at = self._diagnosed_at = time.monotonic()
        self._jumped_at = self._noted_at = -np.inf

    def __enter__(self) -> WatchReport:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._open = ExitStack()
        path = self._folder / "estimates.csv"
        begun = path.exists()
        self._csv = self._open.enter_context(path.open("a", newline="", encoding="utf-8"))
        self._table = csv.writer(self._csv, lineterminator="\n")
        if not begun:
            self._table.writerow(csv_header(self._system.space.names))
        about = {"system": self._system.name, "command": str(self._provenance["command"])}
        self._log = self._open.enter_context(LogWriter(fresh(self._folder / "estimates", ".mcap"), about))
        messages.define(self._log)
        for name, text in attachments(self._system).items():
            self._log.attach(name, "application/yaml", text.encode())
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            self._keep()
            self._hold_against()
        finally:
            self._open.__exit__(*error)

    def take(self, event: Estimate | str | None) -> str:
        """Take in an estimate, an event in words, or (None) a look at the source.

        Returns:
            What is to be said of it; '' where nothing is.
        """
        clock, said = time.monotonic(), ""
        if isinstance(event, str):
            self._noted, self._noted_at, said = event, clock, event
            if self._events and self._events[-1][1] == event:  # what goes on and on has one line
                self._events.pop()
            self._events.append((self._source.now, event))
        elif event is not None:
            self._estimated(event)
            if event.mark == "jump":
                self._jump, self._jumped_at = [event], clock
                said = f"jump at {event.time:.2f} s: {self.values}"
        if self._source.now != self._now:
            self._now, self._moved_at = self._source.now, clock
        if clock - self._diagnosed_at >= _DIAGNOSED:
            self._diagnosed_at = clock
            self._hold_against()
            rates = {one.name: f"{one.rate:.0f} Hz" for one in self._source.topics.values()}
            self._log.also = self._send
            stamp = self._source.stamp_ns(max(self._now, 0.0))
            self._log.diagnostics(stamp, *self.status(), rates, of="watch")
        if clock - self._kept_at >= _KEPT:
            self._kept_at = clock
            self._keep()
        return said

    def status(self) -> tuple[int, str]:
        """Level of the diagnostics, and the reason in words."""
        clock = time.monotonic()
        if clock - self._moved_at > _STALE:
            return STALE, "no new samples"
        recent = clock - self._noted_at < _RECENT
        if recent and self._noted.startswith("the estimator") and "is late" not in self._noted:
            return ERROR, self._noted
        if self._holding:
            return WARN, f"alarm: {', '.join(self._holding)}"
        if clock - self._jumped_at < _RECENT:
            return WARN, "a parameter has jumped"
        if recent:
            return WARN, self._noted
        return OK, "estimating" if self._last else "waiting for the first window"

    @property
    def values(self) -> str:
        """'load_mass 0.55 ± 0.01, damping 0.03 ± 0.002'; '' before the first estimate."""
        return "".join(map(_values, self._last))

    def record(self) -> dict[str, Any]:
        """The keys of `amhe watch`, ready for JSON."""
        rows = [
            {"name": p.name, "unit": p.unit, "estimate": last.theta[i], "sd": last.sd[i],
             "lower": last.lower[i], "upper": last.upper[i]}
            for last in self._last for i, p in enumerate(self._system.space.parameters)
        ]  # fmt: skip
        counts = self._counts
        return plain({
            "system": self._system.name, "source": self._source.about,
            "end_s": self._last[0].time if self._last else None, "parameters": rows,
            "windows": counts.total(), "updated": counts["updated"] + counts["jump"],
            "jumps": counts["jump"], "still": counts["still"], "gaps": counts["gap"],
            "lost": counts["diverged"], **({"audit": audit_record(self._lines, None)} if self._audit else {}),
        })  # fmt: skip

    def metrics(self) -> str:
        """The newest values in the text format of Prometheus."""
        rows = sorted(self._metrics(), key=lambda row: row[0])  # all of one name together
        return "".join(f"amhe_{name}{{{label}}} {value:.9g}\n" for name, label, value in rows)

    def _metrics(self) -> Iterator[tuple[str, str, float]]:
        yield from (("status", "", self.status()[0]), ("lag_seconds", "", self._lag))
        yield from (("windows_total", _label(mark=mark), n) for mark, n in list(self._counts.items()))
        for one in self._source.topics.values():
            label = _label(topic=one.name)
            yield from (("topic_rate_hz", label, one.rate), ("topic_messages_total", label, one.count))
            yield ("topic_dropped_total", label, one.dropped)
        for row in self.record()["parameters"]:
            label = _label(name=row.pop("name"), unit=row.pop("unit"))
            yield from ((f"parameter_{name}", label, value) for name, value in row.items())

    def drawn(self) -> RenderableType:
        """The picture on a terminal."""
        level, text = self.status()
        word, colour = _LEVELS[level]
        shown = f"{self._now:.1f} s" if np.isfinite(self._now) else "waiting"
        title = f"  {self._system.name} on {self._source.about}, {shown}"
        head = Text.assemble((f" {word} ", f"reverse {colour}"), title, f"\n{text}\n")
        parts: list[RenderableType] = [head, rich_table(self._parameters()), Text()]
        if self._lines:
            parts += [rich_table(audit_table(self._lines), STYLES), Text(count_text(self._lines)), Text()]
        parts += [rich_table(self._topics(), {"stopped": "red", "waiting": "red"}), Text()]
        parts += [
            Text(f"{last.mark}; misfit {last.misfit:.2f}, excitation {last.excitation:.2f} (noise sd), "
                 f"update {last.update_ms:.0f} ms, lag {1e3 * self._lag:.0f} ms")
            for last in self._last
        ]  # fmt: skip
        parts += [Text(f"last jump at {one.time:.1f} s: {_values(one)}", "yellow") for one in self._jump]
        parts += [Text(f"{at:.1f} s: {event}", "yellow") for at, event in self._events]
        return Group(*parts)

    def _estimated(self, estimate: Estimate) -> None:
        """Write an estimate; what everybody's tools read of it is sent on."""
        self._last = [estimate]
        self._counts[estimate.mark] += 1
        self._history.append(estimate)
        self._lag = self._source.now - estimate.time
        self._holding = [text for text, holds in self._alarms.items() if holds(estimate)]
        self._table.writerow(csv_row(estimate))
        self._csv.flush()
        log, stamp, names = self._log, self._source.stamp_ns(estimate.time), estimate.belief.names
        log.also = ()
        messages.write_estimate(log, stamp, estimate)
        log.also = self._send
        for topic in ("/amhe/params", *(["/amhe/jump"] if estimate.mark == "jump" else [])):
            log.joint_state(topic, stamp, names, estimate.theta, effort=estimate.sd)
        log.numbers("/amhe/covariance", stamp, estimate.belief.covariance.reshape(-1))

    def _hold_against(self) -> None:
        """Hold the file's numbers against the newest belief, if that is a new one."""
        if self._audit and self._last != self._audited:
            self._lines, self._audited = list(self._audit(self._last[0].belief)), self._last

    def _keep(self) -> None:
        """Write the newest belief, whole."""
        for last in self._last:
            replace(last.belief, provenance=dict(self._provenance)).save(self._folder / "belief.yaml")

    def _parameters(self) -> Table:
        rows = [
            (
                row["name"], with_sd(row["estimate"], row["sd"]), row["unit"],
                interval(row["lower"], row["upper"]), blocks([float(one.theta[i]) for one in self._history]),
            )
            for i, row in enumerate(self.record()["parameters"])
        ]  # fmt: skip
        head = ("parameter", "estimate ± sd", "unit", "90 % interval", "last estimates")
        return Table(head, ("", NUMBER, "", NUMBER, ""), rows)

    def _topics(self) -> Table:
        rows = [
            (
                one.name, "stopped" if one.silent else f"{one.rate:.0f} Hz" if one.count else "waiting",
                f"{1e3 * (one.lag or 0.0):.0f} ms", str(one.dropped or "-"),
            )
            for one in self._source.topics.values()
        ]  # fmt: skip
        return Table(("topic", "rate", "lag", "dropped"), ("", *[NUMBER] * 3), rows)


def blocks(values: Sequence[float]) -> str:
    """A line of blocks as high as the values, the lowest at its bottom."""
    low, high = min(values), max(values)
    span = max(high - low, 1e-3 * max(abs(high), 1e-12))
    return "".join(_BLOCKS[min(7, int(8.0 * (value - low) / span))] for value in values)


def _values(estimate: Estimate) -> str:
    rows = zip(estimate.belief.names, estimate.theta, estimate.sd, strict=True)
    return ", ".join(f"{name} {with_sd(float(value), float(sd))}" for name, value, sd in rows)


def _label(**labels: str) -> str:
    quoted = {key: text.replace("\\", "\\\\").replace('"', '\\"') for key, text in labels.items()}
    return ",".join(f'{key}="{text}"' for key, text in quoted.items())
