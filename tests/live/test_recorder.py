"""The log of a run, written and read again."""

import json
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.log import merged
from amhe_cli.live.recorder import WALL_CLOCK, Recorder
from amhe_cli.logs import inspect_log, read_log, read_metadata, survey
from amhe_cli.robots.go1.kinematics import JOINTS
from amhe_cli.robots.go1.run import RunOptions, open_run, recorder_of
from amhe_cli.system.system import System

QUICK = {"control": {"samples": 5, "horizon": 8}}


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Every message by topic, as it lies in the file."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def record(path: Path, task: str = "t1", seconds: float = 0.6, threads: int = 1, seed: int = 0) -> list:
    """Run a task for some time; its cycles."""
    run = open_run(RunOptions(task, seed=seed, duration=seconds, threads=threads, settings=QUICK))
    cycles = []
    with recorder_of(run, path) as recorder:
        for cycle in run.episode.cycles():
            recorder.write(cycle)
            cycles.append(cycle)
    return cycles


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    path = tmp_path_factory.mktemp("live") / "log.mcap"
    return path, record(path)


def test_identify_finds_every_signal_all_the_time(log) -> None:
    found = inspect_log(log[0], System.load("go1_push"))
    assert found.system == "go1_push"
    assert found.problem is None
    assert all(check.problem is None for check in found.checks)
    assert found.duration == pytest.approx(0.58, abs=0.02)  # from the first command on


def test_what_is_read_is_what_was_measured_and_played(log) -> None:
    path, cycles = log
    read = read_log(path, System.load("go1_push"))
    samples = merged([cycle.samples for cycle in cycles])
    times, joints = samples["joints.position"]
    at = round((0.3 - 1e-9 * read.start_ns) / read.dt)  # the row of 0.3 s
    assert read["joints.position"].columns == JOINTS
    measured = joints[np.argmin(np.abs(times - 0.3))]
    assert read["joints.position"].values[at] == pytest.approx(measured, abs=1e-6)
    cycle = next(c for c in cycles if c.estimate.time == pytest.approx(0.3))
    assert read["box.position"].values[at] == pytest.approx(cycle.samples["box.position"][1][-1], abs=1e-6)
    assert read["trunk.linear_velocity"].values[at] == pytest.approx(cycle.estimate.trunk.velocity, abs=1e-6)
    assert read["trunk.angular_velocity"].values[at] == pytest.approx(cycle.estimate.trunk.rate, abs=1e-6)
    assert read["command.position"].values[at] == pytest.approx(cycle.played, abs=1e-6)


def test_stamps_are_the_time_of_the_run(log) -> None:
    path, cycles = log
    by_topic = messages(path)
    stamps = [stamp for stamp, _ in by_topic["/joint_commands"]]
    assert stamps == [round(cycle.estimate.time * 1e6) * 1000 for cycle in cycles]
    assert stamps[0] == 20_000_000
    assert [stamp for stamp, _ in by_topic["/joint_states"]][:3] == [20_000_000, 30_000_000, 40_000_000]


def test_the_log_says_what_it_is_of_and_carries_its_settings(log) -> None:
    metadata = read_metadata(log[0])
    assert (metadata["system"], metadata["task"], metadata["mode"], metadata["seed"]) == (
        "go1_push",
        "t1",
        "true",
        "0",
    )
    assert json.loads(metadata["truth"]) == pytest.approx(
        {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.6}
    )
    from mcap.reader import make_reader

    with log[0].open("rb") as file:
        attached = {one.name: one.data.decode() for one in make_reader(file).iter_attachments()}
    assert '"samples": 5' in attached["settings.yaml"]
    assert "box_mass" in attached["system.yaml"]


def test_a_truth_that_will_change_is_no_metadata(tmp_path: Path) -> None:
    record(tmp_path / "log.mcap", "t4", seconds=0.04)
    assert "truth" not in read_metadata(tmp_path / "log.mcap")
    assert "/amhe/truth" in {topic.name for topic in survey(tmp_path / "log.mcap").topics}


@pytest.mark.medium
def test_a_seed_gives_the_same_log_whatever_the_threads(log, tmp_path: Path) -> None:
    record(tmp_path / "again.mcap", threads=2)
    first, again = (messages(path) for path in (log[0], tmp_path / "again.mcap"))
    assert set(first) == set(again)
    for topic in set(first) - set(WALL_CLOCK):
        assert first[topic] == again[topic], topic


def test_a_log_that_breaks_off_is_whole(log, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with pytest.raises(KeyboardInterrupt), Recorder(path, (), {}, {}) as recorder:
        recorder.write(log[1][0])
        raise KeyboardInterrupt
    assert not survey(path).problems
    assert [p.name for p in tmp_path.iterdir()] == ["log.mcap"]


def test_a_quarter_of_a_minute_takes_less_than_a_megabyte(log, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    record(path, seconds=0.02)
    definitions, whole = path.stat().st_size, log[0].stat().st_size
    assert definitions + (whole - definitions) / 0.58 * 15.0 < 1e6
