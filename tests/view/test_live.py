"""Live pages: what happens reaches the browser, and a browser changes nothing of what happens."""

from __future__ import annotations

import json
import socket
import time
import urllib.request
from base64 import b64decode
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.log import Window
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.view.live import Broadcast, Happening, StatesShown, WindowsShown
from amhe_cli.view.page import Heading
from amhe_cli.view.scene import scene_of
from tests.view.browser import Browser


def messages(address: str, count: int) -> list[dict]:
    """The first messages of a stream."""
    found: list[dict] = []
    with urllib.request.urlopen(f"{address}stream", timeout=30) as stream:
        while len(found) < count:
            line = stream.readline()
            if line.startswith(b"data: "):
                found.append(json.loads(line[6:]))
    return found


def test_items_arrive_in_their_order_also_at_a_viewer_that_comes_late() -> None:
    with Broadcast("<p>", lambda item: [{"item": item}]) as shown:
        for item in range(20):
            shown.put(item)
        assert [m["item"] for m in messages(shown.server.address, 20)] == list(range(20))
        shown.put(20)
        assert [m["item"] for m in messages(shown.server.address, 21)][-1] == 20


def test_a_loop_never_waits_where_drawing_hangs() -> None:
    free = Event()
    with Broadcast("<p>", lambda item: [{"item": item}] if free.wait(30.0) else []) as shown:
        begun = time.perf_counter()
        for item in range(10_000):
            shown.put(item)
        assert time.perf_counter() - begun < 5.0  # one item would take 30 s
        free.set()


def test_a_fault_of_the_picture_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    def faulty(item: int) -> list[dict[str, float]]:
        return [{"item": 1 / item}]

    with Broadcast("<p>", faulty) as shown:
        shown.put(0)
        shown.put(2)
        assert messages(shown.server.address, 1) == [{"item": 0.5}]
    assert "misses something" in caplog.text


def test_viewers_that_leave_or_hang_change_nothing() -> None:
    with Broadcast("<p>", lambda item: [{"item": item, "long": "x" * 100_000}]) as shown:
        host, port = shown.server.address.removeprefix("http://").rstrip("/").split(":")
        request = f"GET /stream HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
        hanging = socket.create_connection((host, int(port)))
        hanging.sendall(request)
        leaving = socket.create_connection((host, int(port)))
        leaving.sendall(request)
        leaving.close()
        for item in range(40):
            shown.put(item)
        assert len(messages(shown.server.address, 40)) == 40
        hanging.close()


@pytest.mark.slow
def test_a_watched_run_finds_the_same(tmp_path: Path, capsys) -> None:
    found, arguments = [], ["run", "--task", "t4", "--duration", "0.3", "--mode", "true"]
    for name, more in (("plain", []), ("watched", ["--view"])):
        out = tmp_path / name
        run([*arguments, *more, "-q", "--threads", "1", "-o", str(out)])
        record = json.loads((out / "result.json").read_text())
        timed = (
            "seconds",
            "out",
            "cycle_ms",
            "update_ms",
            "real_time_factor",
            "estimator",
            "warnings",
            "provenance",
        )
        found.append({key: value for key, value in record.items() if key not in timed})
        assert ("http://127.0.0.1:" in capsys.readouterr().err) is bool(more)
    assert found[0] == found[1]


@pytest.mark.medium
def test_the_page_follows_what_happens(tab: Browser) -> None:
    scene = scene_of(amhe.System.load("pendulum"))
    page = StatesShown(scene, ["guess"], [TimeCurve("load", "parameters", "kg")], Heading("live"))
    with page:
        tab.open(page.server.address)
        for i in range(50):
            state = np.array([0.02 * i])
            forces, traces = np.array([[0.0, 0, 0, 0, 0, i]]), np.full((3, 4, 3), 0.1)
            numbers = {"load": (0.5, 0.4, 0.6)}
            page.put(Happening(0.04 * i, [state, state + 0.3], numbers, i == 20, forces, traces))
        tab.run(
            "new Promise((done) => { const wait = () => player.end > 1.9 && player.now === player.end "
            "? done() : setTimeout(wait, 20); wait(); })"
        )
        assert tab.run("player.recording.ghosts[0].count") == 50
        assert tab.run("player.recording.curves.get('load').upper.length") == 50
        turned = tab.run("Math.abs(player.recording.track.at(1.96)[5])")
        assert turned == pytest.approx(np.sin(0.5 * 0.02 * 49), abs=1e-3)
        assert tab.run("player.drawn(null).forces[5]") == 49.0
        assert tab.run("[player.drawn(null).traces.length, player.drawn(null).points]") == [36, 4]
        assert not tab.run("document.getElementById('forces').parentElement.hidden")
        tab.run("document.getElementById('forces').click()")
        assert tab.run("player.drawn(null).forces") is None
        tab.run("player.seek(0); document.getElementById('next').click()")
        assert tab.run("player.now") == pytest.approx(0.8)
    assert tab.requests[:2] == [page.server.address, f"{page.server.address}stream"]


@pytest.mark.medium
def test_a_window_is_shown_with_what_two_beliefs_predict_of_it() -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log("example:pendulum", system)
    truth = json.loads(log.metadata["truth"])
    true = np.array([truth[name] for name in system.space.names])
    window = Window(log, 1000, round(0.5 / log.dt))
    estimator = MovingHorizon(system, open_engine(system), np.random.default_rng(0))
    end = window.stop * log.dt
    estimate = replace(
        estimator.update(window, end), theta=true, lower=0.9 * true, upper=1.1 * true, mark="jump"
    )
    wrong = true * [2.0, 1.0, 1.0, 1.0]
    with WindowsShown(system, wrong, "a test") as shown:
        shown.put((window, estimate))
        *frames, last = messages(shown.server.address, round(0.5 / 0.04) + 2)
    assert last["event"] and last["time"] == pytest.approx(end)
    assert last["numbers"]["load_mass"] == pytest.approx([true[0], 0.9 * true[0], 1.1 * true[0]])
    times = [frame["time"] for frame in frames]
    assert times[0] == pytest.approx(window.start * log.dt)
    np.testing.assert_allclose(np.diff(times), 0.04, atol=1e-9)
    measured, before, now = (
        np.array([np.frombuffer(b64decode(frame["poses"][i]), "<f4") for frame in frames]) for i in range(3)
    )
    assert np.abs(now - measured).max() < 0.03 < np.abs(before - measured).max()
