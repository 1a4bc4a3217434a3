"""What a watch shows: its level, its alarms, its numbers for Prometheus, a line of blocks."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.logs.live.messages import LiveTopic
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.report import watch
from amhe_cli.report.watch import STALE, WatchReport, blocks
from amhe_cli.system.system import System


@pytest.fixture(scope="module")
def estimate():
    system = System.load("pendulum")
    return MovingHorizon(system, open_engine(system), np.random.default_rng(0))._estimate(
        1.0, "updated", None, 0.0
    )


@pytest.fixture
def report(tmp_path: Path):
    arrivals = deque(round(k * 1e9 / 99.6) for k in range(11))
    topics = {
        name: LiveTopic(name, silent=name == "/gone", lag=0.003, dropped=2, count=10, arrivals=arrivals)
        for name in ('/a"b', "/gone")
    }
    source: Any = SimpleNamespace(about="a test", now=0.5, topics=topics, stamp_ns=lambda at: round(1e9 * at))
    alarms = {"load_mass > 0": lambda one: one.theta[0] > 0.0}
    sent: list[str] = []
    made = WatchReport(
        tmp_path / "out",
        System.load("pendulum"),
        source,
        {"command": "x"},
        [lambda topic, *_: sent.append(topic)],
        alarms,
    )
    with made:
        yield SimpleNamespace(report=made, source=source, sent=sent)


def test_the_level_says_what_is_the_matter(report, estimate, monkeypatch) -> None:
    made = report.report
    assert made.take(None) == "" and made.status() == (OK, "waiting for the first window")
    assert made.take("a topic is gone") == "a topic is gone" and made.status()[0] == WARN
    made.take("the estimator is late: the last good belief stays")
    assert made.status()[0] == WARN
    made.take("the estimator died")
    assert made.status() == (ERROR, "the estimator died")
    monkeypatch.setattr(watch, "_RECENT", 0.0)
    made.take(estimate)
    assert made.status() == (WARN, "alarm: load_mass > 0")
    monkeypatch.setattr(watch, "_STALE", 0.0)
    assert made.status() == (STALE, "no new samples")


def test_estimates_are_sent_on_and_shown(report, estimate) -> None:
    report.report.take(estimate)
    assert report.sent == ["/amhe/params", "/amhe/covariance"]
    console = Console(record=True, width=110)
    console.print(report.report.drawn())
    text = console.export_text()
    assert "pendulum on a test" in text and "load_mass" in text and "stopped" in text and "100 Hz" in text


def test_numbers_for_prometheus_are_well_formed(report, estimate) -> None:
    report.report.take(estimate)
    lines = report.report.metrics().splitlines()
    assert all(re.fullmatch(r'amhe_\w+\{(\w+="([^"\\]|\\.)*",?)*\} \S+', line) for line in lines)
    assert 'amhe_topic_dropped_total{topic="/a\\"b"} 2' in lines
    assert 'amhe_parameter_estimate{name="load_mass",unit="kg"} 0.4' in lines


def test_the_numbers_of_a_file_are_held_against_each_estimate_once(report, estimate, monkeypatch) -> None:
    monkeypatch.setattr(watch, "_DIAGNOSED", 0.0)
    held: list[object] = []
    made = report.report
    made._audit = lambda belief: held.append(belief) or []
    for event in (None, estimate, None, None, replace(estimate, time=2.0), None):
        made.take(event)
    assert len(held) == 2


def test_blocks_are_as_high_as_the_values() -> None:
    assert blocks([0.0, 1.0, 0.5]) == "▁█▅"
    assert blocks([3.0, 3.0]) == "▁▁"
