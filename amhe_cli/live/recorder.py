"""A live run as a log: every cycle goes into an MCAP file that `amhe identify` and any viewer can read.

Stamps are the run's own time, from zero: a seed gives the same log every time. Only /amhe/timing and
/diagnostics depend on the wall clock. Estimates and plans are read back from such a log here, too.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import Ending, OperatorStopError
from amhe_cli.core.log import Samples
from amhe_cli.core.shown import TimeCurve
from amhe_cli.core.signals import Signal
from amhe_cli.estimation.online import messages as estimates
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.live.episode import Cycle, Episode
from amhe_cli.logs import Fields, LogWriter, read_topic
from amhe_cli.logs.messages.writer import ERROR, OK, WARN, message_type, write_samples

PLAN, TIMING = "amhe_msgs/msg/Plan", "amhe_msgs/msg/Timing"

_PLAN = """\
std_msgs/Header header
# rollouts of this cycle, and how many of them diverged
uint32 rollouts
uint32 diverged
# 1 where one sample decides, as many as samples where none does
float64 effective_samples
# least and mean cost of the last loop
float64 best_cost
float64 mean_cost
# cost of the best rollout by term
string[] terms
float64[] term_costs
# command of the behaviour, channels included
float64[] command
"""
_TIMING = """\
std_msgs/Header header
# time that the cycle took to compute
float64 plan_ms
# control periods that began without a new plan, so far
uint32 deadline_misses
"""
#: Types of all messages that are written.
_TYPES = (
    "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray",
    PLAN, TIMING, estimates.ESTIMATE,
)  # fmt: skip
#: Longest time between two messages of content that changes seldom, and of content that never changes [s].
_SELDOM, _NEVER = 0.1, 1.0


class Recorder:
    """Writes one cycle after the other; use it as a context manager.

    Args:
        path: Path of the .mcap file; it is complete and readable however the block ends.
        signals: Signals whose samples are written.
        attachments: Texts by file name.

    Raises:
        ConfigError: A signal is of a message type that cannot be written.
    """

    def __init__(
        self,
        path: Path,
        signals: Sequence[Signal],
        metadata: Mapping[str, str],
        attachments: Mapping[str, str],
    ) -> None:
        for signal in signals:
            message_type(signal)
        self._log = LogWriter(path, metadata)
        self._signals, self._attachments = signals, dict(attachments)
        self._written: dict[str, tuple[float, object]] = {}
        self._misses = 0

    def __enter__(self) -> Recorder:
        self._log.__enter__()
        self._log.define(PLAN, _PLAN)
        self._log.define(TIMING, _TIMING)
        estimates.define(self._log)
        self._log.prepare(_TYPES)  # now, as a running robot does not wait
        for name, text in self._attachments.items():
            self._log.attach(name, "application/yaml", text.encode())
        return self

    def __exit__(self, *error: Any) -> None:
        self._log.__exit__(*error)

    def write(self, cycle: Cycle) -> None:
        """Append all messages of a cycle."""
        write_samples(self._log, self._signals, cycle.samples, stamp_ns)
        self._transforms(cycle.samples)
        self._beliefs(cycle)
        self._news(cycle)
        self._plan(cycle)

    def note(self, time: float, level: int, text: str) -> None:
        """Write a line about the run itself into the diagnostics, after all else of that time [s]."""
        self._log.diagnostics(stamp_ns(time + 1e-3), level, text, {})

    def _transforms(self, samples: Samples) -> None:
        """The newest poses, for viewers: one message a cycle is enough for them."""
        poses, newest = {}, -np.inf
        for signal in self._signals:
            keys = signal.key("position"), signal.key("orientation")
            if all(key in samples and samples[key][0].size for key in keys):
                (times, places), (_, turns) = (samples[key] for key in keys)
                poses[signal.name] = places[-1], turns[-1]
                newest = max(newest, float(times[-1]))
        if poses:
            self._log.transform("/tf", stamp_ns(newest), poses)

    def _beliefs(self, cycle: Cycle) -> None:
        for topic, values in (("/amhe/params", cycle.belief), ("/amhe/truth", cycle.parameters)):
            if values is not None and self._due(topic, cycle.time, _SELDOM, values):
                self._log.joint_state(topic, stamp_ns(cycle.time), values, list(values.values()))

    def _news(self, cycle: Cycle) -> None:
        """Write estimates at the time from which they were in force, and troubles of the estimator."""
        stamp = stamp_ns(cycle.time)
        for news in cycle.news:
            if isinstance(news, Estimate):
                estimates.write_estimate(self._log, stamp, news)
            else:
                self._log.diagnostics(stamp, WARN, news.text, {}, of="estimator")

    def _plan(self, cycle: Cycle) -> None:
        """Write how planning went; its time is by the wall clock, unlike all else in a log."""
        log, stamp, step = self._log, stamp_ns(cycle.time), cycle.plan.step
        if self._due("/diagnostics", cycle.time, _NEVER):
            text, level = ("late", WARN) if cycle.misses > self._misses else ("planning in time", OK)
            self._misses = cycle.misses
            values = {"plan ms": f"{cycle.plan_ms:.1f}", "deadline misses": str(cycle.misses)}
            values |= {"rollouts": str(step.rollouts)} if step else {}
            log.diagnostics(stamp, level, text, values)
        if step is not None:  # the plan was sampled
            command = cycle.plan.command
            plan = {
                "rollouts": step.rollouts,
                "diverged": step.diverged,
                "effective_samples": step.effective_samples,
                "best_cost": step.best,
                "mean_cost": step.average,
                "terms": list(step.terms),
                "term_costs": list(step.terms.values()),
                "command": () if command is None else command,
            }
            log.write("/amhe/plan", PLAN, stamp, plan)
        timing = {"plan_ms": cycle.plan_ms, "deadline_misses": cycle.misses}
        log.write("/amhe/timing", TIMING, stamp, timing)

    def _due(self, topic: str, time: float, period: float, content: object = None) -> bool:
        """Whether to write a topic now; True counts as written.

        Args:
            time: Present time [s].
            period: Longest time between two messages [s].
            content: What would be written; other content than the last is due at once.
        """
        if topic in self._written:
            last, before = self._written[topic]
            if time - last < period - 1e-6 and content == before:
                return False
        self._written[topic] = time, content
        return True


def stamp_ns(time: float) -> int:
    """A time [s] in nanoseconds, to the microsecond: sums of periods come out round."""
    return round(time * 1e6) * 1000


#: Numbers of a run -> topic, field and unit.
_RUN = {
    "speed": ("/odom", "twist.twist.linear.x", "m/s"),
    "cost": ("/amhe/plan", "best_cost", ""),
    "cycle time": ("/amhe/timing", "plan_ms", "ms"),
}


def recorded_curves(
    path: Path, start_ns: int, units: Mapping[str, str]
) -> tuple[list[TimeCurve], FloatArray]:
    """Parameters over time with their 90 % bands and other numbers; and the times of jumps [s], shape (j,).

    Args:
        path: `log.mcap` of `amhe run`, or `estimates.mcap` of `amhe mhe-replay`.
        start_ns: The instant from which times are counted [ns].
        units: Name of each parameter -> its unit; empty: it has none.

    Raises:
        LogError: The log cannot be read.
    """
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)  # time, value and its band

    def messages(topic: str) -> Iterator[tuple[float, Fields]]:
        return (((stamp - start_ns) / 1e9, fields) for stamp, fields in read_topic(path, topic))

    jumps = []
    for time, fields in messages("/amhe/estimate"):
        for one in _places(fields, "parameters[{}].name"):
            numbers = (float(fields[one.replace("name", part)]) for part in ("value", "lower", "upper"))
            rows["parameters", str(fields[one])].append((time, *numbers))
        rows["estimator", "misfit"].append((time, float(fields["misfit"])))
        if fields["mark"] == "jump":
            jumps.append(time)
    if not rows:  # the belief was fixed
        for time, fields in messages("/amhe/params"):
            for name, value in _believed(fields).items():
                rows["parameters", name].append((time, value))
    for name, (topic, field, _) in _RUN.items():
        rows["run", name] = [(time, float(fields[field])) for time, fields in messages(topic)]
    known = {**units, **{name: unit for name, (_, _, unit) in _RUN.items()}}
    curves = []
    for (group, name), own in rows.items():
        if own:
            times, values, *band = np.array(own).T
            unit = known.get(name, "")
            curves.append(TimeCurve(name, group, unit, times, values, np.array(band) if band else None))
    return curves, np.array(jumps)


def first_belief(path: Path) -> dict[str, float]:
    """The parameters that a run began with, by name; {} where its log has none.

    Args:
        path: `log.mcap` of `amhe run`.

    Raises:
        LogError: The log cannot be read.
    """
    return next((_believed(fields) for _, fields in read_topic(path, "/amhe/params")), {})


def _believed(fields: Fields) -> dict[str, float]:
    """The values in one message of /amhe/params."""
    pairs = ((one, one.replace("name", "position")) for one in _places(fields, "name[{}]"))
    return {str(fields[one]): float(fields[other]) for one, other in pairs if other in fields}


def _places(fields: Fields, place: str) -> Iterator[str]:
    """The paths of a name in each element of an array."""
    return (path for i in range(len(fields)) if (path := place.format(i)) in fields)


logger = logging.getLogger(__name__)

#: Called after each cycle with it and its row of the history.
OnCycle = Callable[[Cycle, dict[str, float]], None]


class CycleHistory(Protocol):
    """Numbers of every cycle, for the report."""

    def add(self, cycle: Cycle) -> dict[str, float]:
        """Take in a cycle; returns its numbers by name."""
        ...

    @property
    def troubles(self) -> list[str]:
        """What went wrong with the online estimator, in words."""
        ...


def drive(
    episode: Episode,
    recorder: Recorder,
    history: CycleHistory,
    stopped: Callable[[], bool],
    on_cycle: OnCycle,
) -> Ending:
    """Run the episode, record every cycle, warn of the estimator's troubles, and return how it ended.

    A trouble is a warning when it first occurs; one that came again is another in the end, with its count.

    Args:
        recorder: Recorder of the run, open; the caller closes it.
        history: Takes in every cycle.
        stopped: Called after each cycle; True: stop here.
        on_cycle: Called after each cycle.
    """
    time = 0.0
    warned: list[str] = []
    try:
        for cycle in episode.cycles():
            time = cycle.time
            recorder.write(cycle)
            on_cycle(cycle, history.add(cycle))
            for trouble in history.troubles[len(warned) :]:
                logger.warning(trouble)
                warned.append(trouble)
            if stopped() and not cycle.over:
                recorder.note(time, WARN, "interrupted")
                return Ending(interrupted=True)
    except OperatorStopError as stop:
        recorder.note(time, WARN, str(stop))
        return Ending(interrupted=True)
    except Exception as error:
        recorder.note(time, ERROR, str(error))
        return Ending(error=error)
    finally:
        episode.belief.close()
        for trouble in history.troubles:
            if trouble not in warned:
                logger.warning(trouble)
    recorder.note(time, *episode.judge.verdict)
    return Ending()
