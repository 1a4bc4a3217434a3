"""LeRobot datasets on disk: each episode is a log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pyarrow import parquet

from amhe_cli.cli.main import run
from amhe_cli.core.errors import AmheError, ConfigError, LogError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.folder import init_system
from amhe_cli.logs import episode_paths, read_signals, survey
from tests.logs.test_table_damage import mutated

FPS, FRAMES, EPISODES = 50, 100, 4
T = np.arange(FRAMES) / FPS
NAMES = ("shoulder_pan.pos", "elbow_flex.pos", "gripper.pos")
SIGNALS = [
    Signal("joints", "", ("position",), columns={"position": [f"observation.state.{n}" for n in NAMES[:2]]}),
    Signal("command", "", ("position",), columns={"position": ["action.elbow_flex.pos"]}, is_input=True),
]


def state(episode: int, size: float) -> np.ndarray:
    angles = [size * np.sin((1 + episode) * T), size * np.cos(T), 50.0 + 0.0 * T]
    return np.stack(angles, axis=1).astype(np.float32)


def frames(episode: int, size: float) -> pa.Table:
    lists = pa.list_(pa.float32(), len(NAMES))
    values = state(episode, size)
    return pa.table(
        {
            "observation.state": pa.array(list(values), lists),
            "action": pa.array(list(values + np.float32(1.0)), lists),
            "timestamp": T.astype(np.float32),
            "frame_index": np.arange(FRAMES),
            "episode_index": np.full(FRAMES, episode),
            "index": episode * FRAMES + np.arange(FRAMES),
            "task_index": np.zeros(FRAMES, dtype=np.int64),
            "observation.images.top": [b"\xff\xd8"] * FRAMES,
        }
    )


def dataset(folder: Path, version: str, size: float = 1.0, names: Any = None, **more: Any) -> Path:
    """A dataset after the published layout: 2.1 a file for each episode, 3.0 two episodes in a file."""
    path = folder / "data_set"
    (path / "meta").mkdir(parents=True)
    joints = {"dtype": "float32", "shape": [len(NAMES)], "names": names or list(NAMES), **more}
    features = {
        "observation.state": joints,
        "action": joints,
        "timestamp": {"dtype": "float32", "shape": [1]},
    }
    features["observation.images.top"] = {"dtype": "image", "shape": [3, 4, 4]}
    new = version == "v3.0"
    places = "chunk_index:03d}/file-{file_index" if new else "episode_chunk:03d}/episode_{episode_index"
    info = {
        "codebase_version": version, "robot_type": "so101", "total_episodes": EPISODES, "chunks_size": 1000,
        "fps": FPS, "features": features, "data_path": f"data/chunk-{{{places}:0{3 if new else 6}d}}.parquet",
    }  # fmt: skip
    (path / "meta" / "info.json").write_text(json.dumps(info))
    (path / "data" / "chunk-000").mkdir(parents=True)
    if new:
        for file in range(EPISODES // 2):
            both = pa.concat_tables([frames(2 * file, size), frames(2 * file + 1, size)])
            parquet.write_table(both, path / "data" / "chunk-000" / f"file-{file:03d}.parquet")
        listed = path / "meta" / "episodes" / "chunk-000"
        listed.mkdir(parents=True)
        numbers = np.arange(EPISODES)
        places_of = {
            "episode_index": numbers,
            "data/chunk_index": 0 * numbers,
            "data/file_index": numbers // 2,
        }
        parquet.write_table(pa.table(places_of), listed / "file-000.parquet")
    else:
        for episode in range(EPISODES):
            file = path / "data" / "chunk-000" / f"episode_{episode:06d}.parquet"
            parquet.write_table(frames(episode, size), file)
    return path


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_is_a_log(version: str, tmp_path: Path) -> None:
    path = dataset(tmp_path, version)
    for episode in range(EPISODES):
        log = read_signals(Path(f"{path}#{episode}"), SIGNALS, 1.0 / FPS, LogSettings())
        assert log.steps == FRAMES
        np.testing.assert_allclose(log["joints.position"].values, state(episode, 1.0)[:, :2], atol=1e-6)
        wanted = state(episode, 1.0)[:, 1] + 1.0
        np.testing.assert_allclose(log["command.position"].values[:, 0], wanted, atol=1e-6)
    found = survey(Path(f"{path}#2"))
    assert found.format == f"LeRobot {version[:2]}"
    (topic,) = found.topics
    assert topic.count == FRAMES
    assert topic.entries == (
        *(f"observation.state.{name}" for name in NAMES), *(f"action.{name}" for name in NAMES), "timestamp"
    )  # fmt: skip


def test_addresses(tmp_path: Path) -> None:
    path = dataset(tmp_path, "v3.0")

    def numbers(part: str) -> list[int]:
        return [int(str(one).rpartition("#")[2]) for one in episode_paths(Path(f"{path}{part}"))]

    assert numbers("") == numbers("#:") == [0, 1, 2, 3]
    assert (numbers("#3"), numbers("#1:3"), numbers("#2:"), numbers("/#0")) == ([3], [1, 2], [2, 3], [0])
    for wrong in ("#4", "#2:2", "#2:9", "#x", "#-1"):
        with pytest.raises(ConfigError):
            episode_paths(Path(f"{path}{wrong}"))
    assert episode_paths(tmp_path) == [tmp_path]
    with pytest.raises(ConfigError, match="each episode of a dataset is a log; name one, such as .*#0"):
        survey(path)
    with pytest.raises(ConfigError, match="no such file"):
        survey(tmp_path / "none#3")


def test_what_is_missing_or_of_another_version_is_named(tmp_path: Path) -> None:
    path = dataset(tmp_path, "v2.1")
    (path / "data" / "chunk-000" / "episode_000002.parquet").unlink()
    with pytest.raises(LogError, match=r"#2: its file data/chunk-000/episode_000002.parquet is missing"):
        survey(Path(f"{path}#2"))
    info = path / "meta" / "info.json"
    info.write_text(info.read_text().replace("v2.1", "v4.0"))
    with pytest.raises(LogError, match="of version 4; versions 2 and 3 are read"):
        survey(Path(f"{path}#0"))


@pytest.mark.medium
def test_damage_is_reported_in_one_line(tmp_path: Path) -> None:
    path = dataset(tmp_path, "v3.0")
    rng = np.random.default_rng(3)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    for number in range(60):
        file = files[number % len(files)]
        content = file.read_bytes()
        file.write_bytes(mutated(content, rng))
        for read in (lambda p: read_signals(p, SIGNALS, 0.02, LogSettings()), survey):
            try:
                for one in episode_paths(path)[:2]:
                    read(one)
            except AmheError as error:
                assert str(path) in str(error)
                assert "\n" not in str(error)
        file.write_bytes(content)


ARM = """<mujoco>
  <worldbody><body><joint name="{}" axis="0 0 1"/><geom size=".1" mass="1"/>
    <body pos="0 0 .3"><joint name="{}" axis="0 1 0"/><geom size=".1" mass="1"/>
      <body pos="0 0 .3"><joint name="{}" axis="0 1 0"/><geom size=".1" mass=".1"/></body>
  </body></body></worldbody>
  <actuator>
    <position name="m1" joint="{}"/><position name="m2" joint="{}"/><position name="m3" joint="{}"/>
  </actuator>
</mujoco>"""


@pytest.mark.parametrize("own", [("shoulder_pan", "elbow_flex", "gripper"), ("a", "b", "c")])
def test_init_takes_the_state_and_the_action(own: tuple[str, ...], tmp_path: Path) -> None:
    """By name, and in order where no name is known."""
    path = dataset(tmp_path, "v2.1")
    model = tmp_path / "arm.xml"
    model.write_text(ARM.format(*own, *own))
    init_system(model, episode_paths(path), tmp_path / "system")
    system = yaml.safe_load((tmp_path / "system" / "system.yaml").read_text())
    joints, command = system["signals"]["joints"], system["signals"]["command"]
    assert joints["columns"] == {"position": [f"observation.state.{name}" for name in NAMES]}
    assert joints["joints"] == list(own)
    assert command["columns"] == {"position": [f"action.{name}" for name in NAMES]}


def test_commands_take_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = dataset(tmp_path, "v3.0")
    assert run(["inspect", f"{path}#1:3", "--json"]) == 0
    logs = json.loads(capsys.readouterr().out)["logs"]
    assert [one["path"].rpartition("#")[2] for one in logs] == ["1", "2"]
    assert run(["inspect", f"{path}#9"]) == 2
    assert "the dataset has the episodes 0 to 3" in capsys.readouterr().err
    assert run(["mhe-replay", str(path)]) == 2
    assert f"name one, such as {path}#0" in " ".join(capsys.readouterr().err.split())
