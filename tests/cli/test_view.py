"""`amhe view` from the outside."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.identify import identify
from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.main import run
from amhe_cli.cli.mhe_replay import mhe_replay
from amhe_cli.cli.viewed import viewed
from amhe_cli.view.server import LOOPBACK, PageServer
from amhe_cli.web.page import script_digest
from tests.conftest import MODELS


def test_a_log_becomes_one_page(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    page = tmp_path / "page.html"
    assert run(["view", str(pendulum_log), "--out", str(page)]) == 0
    assert str(page) in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert "http" not in text.replace("http-equiv", "").replace("http://www.w3.org/2000/svg", "")
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert f"script-src '{script_digest(script)}';" in text
    page.write_text("kept")
    assert run(["view", str(pendulum_log), "--out", str(page)]) == 2
    assert "--force" in capsys.readouterr().err
    assert page.read_text() == "kept"
    assert run(["view", str(pendulum_log), "--out", str(page), "--force"]) == 0
    assert page.read_text(encoding="utf-8") == text


@pytest.fixture(scope="module")
def result(pendulum_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results") / "found"
    quick = ["--set", "clips.count=4", "--set", "clips.held_out=0.4", "--max-time", "1", "-q"]
    assert run(["identify", str(pendulum_log), *quick, "-o", str(out)]) == 0
    return out


def data_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    return json.loads(text.partition('id="data">')[2].partition("</script>")[0])


@pytest.mark.medium
def test_a_result_shows_both_ghosts_and_its_held_out_clips_first(result: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    assert run(["view", str(result), "--out", str(page)]) == 0
    data = data_of(page)
    assert data["candidates"] == ["before", "after"]
    assert all("estimate" in row for row in data["parameters"])
    held = [take["held"] for take in data["takes"]]
    assert held[0] is True
    # with the result's own setting 40 % of the time are held out
    assert 0.2 < sum(held) / len(held) < 0.6


@pytest.mark.medium
def test_a_replay_shows_its_estimates_over_time_and_that_of_each_clip_as_a_ghost(
    pendulum_log: Path, result: Path, tmp_path: Path
) -> None:
    out, page = tmp_path / "replay", tmp_path / "page.html"
    assert run(["mhe-replay", str(pendulum_log), "--from", "1", "--to", "4", "-q", "-o", str(out)]) == 0
    assert run(["view", str(out), "--out", str(page)]) == 0
    record, data = json.loads((out / "result.json").read_text()), data_of(page)
    assert data["candidates"] == ["before", "at that time"]
    late = [take["costs"] for take in data["takes"] if take["start"] > 1.9]
    early = [take["costs"] for take in data["takes"] if take["stop"] <= 1.0]
    assert len(late) > 2 and all(then < 0.5 * before for before, then in late)
    assert early and all(then == before for before, then in early), "nothing was estimated yet"
    last = {row["name"]: row for row in record["parameters"]}
    for row in data["parameters"]:
        assert row["first"] == pytest.approx(last[row["name"]]["start"])
        assert row["estimate"] == pytest.approx(last[row["name"]]["estimate"])
        assert row["lower"] == pytest.approx(last[row["name"]]["lower"])
    curves = {curve["name"]: curve for curve in data["recordings"][0]["curves"]}
    assert curves.keys() == {*last, "misfit"}
    begun = 1.0 + record["settings"]["window"]
    for name, row in last.items():
        times, *ends = (numbers(curves[name][key]) for key in ("times", "values", "lower", "upper"))
        assert times.size == record["windows"]
        # the estimates of a part of the log stand at its times in the whole log
        assert (times[0], times[-1]) == pytest.approx((begun, record["end_s"]), abs=0.01)
        assert [end[-1] for end in ends] == pytest.approx([row[k] for k in ("estimate", "lower", "upper")])
    assert (
        run(["view", str(out), "--belief", str(result / "belief.yaml"), "--out", str(page), "--force"]) == 0
    )
    assert data_of(page)["candidates"] == ["before", "after"]


@pytest.mark.medium
def test_a_run_shows_its_path_its_belief_and_how_it_planned(tmp_path: Path) -> None:
    out, page = tmp_path / "t4", tmp_path / "page.html"
    arguments = ["--task", "t4", "--mode", "baseline", "--duration", "0.6", "--threads", "1"]
    run(["run", *arguments, "-q", "-o", str(out)])
    assert run(["view", str(out), "--out", str(page)]) == 0
    record, data = json.loads((out / "result.json").read_text()), data_of(page)
    curves = {curve["name"]: curve for curve in data["recordings"][0]["curves"]}
    assert {"speed", "cost", "cycle time"} < curves.keys()
    assert numbers(curves["cost"]["values"]).size == record["cycles"]
    for name, value in record["belief"].items():
        assert numbers(curves[name]["values"]) == pytest.approx(value)
        assert curves[name]["lower"] is None
        assert {row["name"]: row["first"] for row in data["parameters"]}[name] == pytest.approx(value)
    plates = [geom for geom in data["geoms"] if geom["body"] < 0 and not geom["floor"]]
    assert max(geom["pose"][0] for geom in plates) == pytest.approx(0.6 + 2.4, abs=0.2)  # the goal


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(b64decode(text), "<f4")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"inputs": {"system": "pendulum", "settings": {}, "logs": 3}}, "is no result of this amhe"),
        ({"command": "run"}, "log.mcap"),
        ({"schema_version": 2}, "is no result of this amhe"),
        ({"fixed": [1]}, "is no result of this amhe"),
        ({"fixed": "x"}, "is no result of this amhe"),
        ({"parameters": [{"verdict": "weak"}]}, "is no result of this amhe"),
        ({"fixed": {"damping": None}}, "is no result of this amhe"),
        ({"command": "eval"}, "of `amhe eval`"),
        ({"inputs": None}, "run `amhe identify` again"),
        ({"inputs": {"system": None, "settings": {}, "logs": []}}, "give it with --system"),
        ({"inputs": {"system": "gone", "settings": {}, "logs": []}}, "give its folder with --system"),
        ({"inputs": {"system": "pendulum", "settings": {}, "logs": []}}, "it was made from arrays"),
        ({"inputs": {"system": "pendulum", "settings": {}, "logs": [{"path": "gone.mcap"}]}}, "gone.mcap"),
    ],
)
def test_other_results_are_refused(result: Path, tmp_path: Path, change: dict, text: str, capsys) -> None:
    record = json.loads((result / "result.json").read_text()) | change
    (tmp_path / "result.json").write_text(json.dumps(record))
    (tmp_path / "belief.yaml").write_text((result / "belief.yaml").read_text())
    assert run(["view", str(tmp_path), "--out", str(tmp_path / "page.html")]) == 2
    err = [line for line in capsys.readouterr().err.splitlines() if "note: shows" not in line]
    assert text in err[0]
    assert len(err) == 1


@pytest.mark.parametrize("content", ["", "[]", '{"command": 3}'])
def test_a_folder_with_another_result_is_one_line(tmp_path: Path, content: str, capsys) -> None:
    (tmp_path / "result.json").write_text(content)
    assert run(["view", str(tmp_path), "--out", str(tmp_path / "page.html")]) == 2
    assert "is no result of this amhe" in capsys.readouterr().err


def test_a_result_of_the_library_shows_what_it_was_made_from(pendulum_log: Path, tmp_path: Path) -> None:
    system = amhe.System.load("pendulum", {"clips": {"count": 4}}).reading({"joints": "/joint_states"})
    logs = amhe.read_log([pendulum_log], system, end=3.0)
    amhe.identify(system, logs, only=["load_mass"], max_time=1.0).save(tmp_path / "result")
    inputs = json.loads((tmp_path / "result" / "result.json").read_text())["inputs"]
    assert inputs["settings"] == {"clips": {"count": 4}, "signals": {"joints": {"topic": "/joint_states"}}}
    shown = viewed(tmp_path / "result", Inputs(start=1.0))
    opened = shown.open()
    ((log,), apart) = shown.read(opened)
    assert (opened.name, opened.settings.clips.count, apart) == ("pendulum", 4, [])
    assert log.duration == pytest.approx(2.0, abs=0.01)  # --from of now, the end of then


@pytest.mark.medium
def test_it_serves_until_it_is_stopped(pendulum_log: Path) -> None:
    command = [sys.executable, "-m", "amhe_cli", "view", str(pendulum_log)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stderr is not None
        line = next(line for line in process.stderr if "http://" in line)
        address = line.partition("http://")[2].partition(";")[0]
        with urllib.request.urlopen(f"http://{address}") as answer:
            assert b'id="data"' in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0


@pytest.mark.parametrize(
    ("host", "names"),
    [
        ("127.0.0.1", ("127.0.0.1", "localhost:1", "localhost", "LOCALHOST:80")),
        ("localhost", ("127.0.0.1:1", "localhost")),
        ("127.0.0.2", ("127.0.0.2:1", "localhost")),
        ("::1", ("[::1]:1", "[::1]", "localhost:1")),
    ],
)
def test_the_server_answers_to_its_own_names_only(host: str, names: tuple[str, ...]) -> None:
    if host == "::1" and not Path("/proc/net/if_inet6").exists():
        pytest.skip("no IPv6 here")
    with PageServer("<p>", host) as server:
        assert server.private
        for name in names:
            request = urllib.request.Request(server.address, headers={"Host": name})
            with urllib.request.urlopen(request) as answer:
                assert answer.read() == b"<p>"
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                assert answer.headers["X-Frame-Options"] == "DENY"
        for name in ("evil.example:1", "localhost.evil.example", "a@127.0.0.1", "10.0.0.1", ""):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(urllib.request.Request(server.address, headers={"Host": name}))
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{server.address}etc/passwd")


def test_clients_that_drip_or_are_too_many_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amhe_cli.view.server._PATIENCE", 1.0)
    monkeypatch.setattr("amhe_cli.view.server._MOST", 3)
    with PageServer("<p>") as server:
        place = (LOOPBACK, int(server.address.rstrip("/").rpartition(":")[2]))
        dripping = [socket.create_connection(place) for _ in range(3)]
        for one in dripping:
            one.sendall(b"GET / HTTP/1.1\r\n")
        time.sleep(0.3)
        one_more = socket.create_connection(place)
        one_more.settimeout(5.0)
        assert one_more.recv(1) == b"", "closed at once"
        begun = time.monotonic()
        with pytest.raises(OSError):
            while time.monotonic() - begun < 8.0:
                for one in dripping:
                    one.sendall(b"a: b\r\n")
                time.sleep(0.2)
        assert urllib.request.urlopen(server.address).read() == b"<p>"
        for one in (*dripping, one_more):
            one.close()


def test_a_port_that_is_taken_is_one_line(pendulum_log: Path, capsys) -> None:
    with PageServer("<p>") as server:
        port = server.address.rstrip("/").rpartition(":")[2]
        assert run(["view", str(pendulum_log), "--port", port]) == 2
    err = capsys.readouterr().err
    assert "cannot listen" in err
    assert "--port" in err


@pytest.fixture(scope="module")
def own_result(pendulum_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay of a system of the user's own, whose signal has another topic and whose prior is moved."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copytree(MODELS / "pendulum", folder / "mine")
    text = (folder / "mine" / "system.yaml").read_text()
    (folder / "mine" / "system.yaml").write_text(text.replace("/joint_states", "/elsewhere"))
    system = ["--system", str(folder / "mine"), "--topic", "joints=/joint_states"]
    more = ["--set", "parameters.load_mass.nominal=0.7", "--to", "3", "-q"]
    # options of `amhe` itself may stand before the command
    before = ["-q", "--limit", "topics=3000"]
    assert run([*before, "mhe-replay", str(pendulum_log), *system, *more, "-o", str(folder / "out")]) == 0
    return folder


@pytest.mark.medium
def test_a_replay_of_an_own_system_needs_no_option_again(own_result: Path, tmp_path: Path, capsys) -> None:
    assert run(["view", str(own_result / "out"), "--out", str(tmp_path / "page.html")]) == 0
    (note,) = [line for line in capsys.readouterr().err.splitlines() if "note: shows" in line]
    assert "pendulum" in note and str(own_result / "mine") in note
    data = data_of(tmp_path / "page.html")
    assert {row["name"]: row["first"] for row in data["parameters"]}["load_mass"] == 0.7
    assert data["recordings"][0]["curves"]


def test_paths_of_a_result_are_looked_for_above_it(
    own_result: Path, pendulum_log: Path, tmp_path: Path, monkeypatch
) -> None:
    """The command ran in a folder of its own, and named its files from there."""
    work = tmp_path / "work"
    shutil.copytree(own_result, work)
    shutil.copy(pendulum_log, work / "log.mcap")
    record = json.loads((work / "out" / "result.json").read_text())
    record["inputs"]["system"], record["inputs"]["logs"][0]["path"] = "mine", "log.mcap"
    (work / "out" / "result.json").write_text(json.dumps(record))
    monkeypatch.chdir(tmp_path)
    assert run(["view", "work/out", "--out", "page.html"]) == 0


def test_a_system_that_moved_is_one_line_that_names_the_option(
    own_result: Path, tmp_path: Path, capsys
) -> None:
    shutil.copytree(own_result / "mine", tmp_path / "moved")
    shutil.copytree(own_result / "out", tmp_path / "out")
    record = (tmp_path / "out" / "result.json").read_text()
    (tmp_path / "out" / "result.json").write_text(record.replace("/mine", "/gone"))
    command = ["view", str(tmp_path / "out"), "--out", str(tmp_path / "page.html")]
    assert run(command) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "gone: the system of this result is not there" in line
    assert "--system" in line
    assert run([*command, "--system", str(tmp_path / "moved")]) == 0


def altered(result: Path, to: Path, old: str, new: str) -> list[str]:
    """The command that views a copy of a result whose record has another text."""
    shutil.copytree(result, to)
    record = (to / "result.json").read_text()
    assert old in record
    (to / "result.json").write_text(record.replace(old, new))
    return ["view", str(to), "--out", str(to / "page.html")]


def test_messages_given_now_replace_those_that_are_gone(own_result: Path, tmp_path: Path, capsys) -> None:
    gone = f'"msg_path": "{tmp_path / "gone"}"'
    command = altered(own_result / "out", tmp_path / "out", '"msg_path": null', gone)
    assert run(command) == 2
    assert f"{tmp_path / 'gone'}" in capsys.readouterr().err
    (tmp_path / "Some.msg").write_text("float64 x\n")
    assert run([*command, "--msg-path", str(tmp_path)]) == 0


def test_a_line_that_is_only_completed_opens_no_data_set(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{")
    (tmp_path / "one.yaml").write_text("{")
    with identify.make_context("identify", [str(tmp_path)], resilient_parsing=True) as context:
        assert context.params["logs"] == (tmp_path,)
    file = str(tmp_path / "one.yaml")
    with mhe_replay.make_context("mhe-replay", [file], resilient_parsing=True) as context:
        assert context.params["log"] == Path(file)
