"""Layouts for viewers, held against the published formats and against the messages of the logs."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.logs import LogWriter

LOGS = Path(__file__).parents[2] / "examples" / "logs"
#: Keys of a plot's path and of a plot, by PlotPath and PlotConfig of Lichtblick's suite-base.
PATH = {"value": str, "label": str, "enabled": bool, "timestampMethod": str}
PLOT = {
    "paths": list, "showXAxisLabels": bool, "showYAxisLabels": bool, "showLegend": bool, "legendDisplay": str,
    "showPlotValuesInLegend": bool, "isSynced": bool, "xAxisVal": str, "sidebarDimension": int,
    "foxglovePanelTitle": str, "lichtblickPanelTitle": str,
}  # fmt: skip
CAMERA = {
    "perspective", "distance", "phi", "thetaOffset", "targetOffset", "target", "targetOrientation", "fovy",
    "near", "far",
}  # fmt: skip


def foxglove(path: Path, system: amhe.System | None = None) -> dict[str, Any]:
    return json.loads(amhe.layout(path, system=system))


def panels_in(mosaic: Any) -> list[str]:
    """The panels of a mosaic, whose inner nodes are checked on the way."""
    if isinstance(mosaic, str):
        return [mosaic]
    assert set(mosaic) == {"direction", "first", "second", "splitPercentage"}
    assert mosaic["direction"] in ("row", "column")
    assert 0.0 < mosaic["splitPercentage"] < 100.0
    return panels_in(mosaic["first"]) + panels_in(mosaic["second"])


def message_paths(layout: dict[str, Any]) -> list[str]:
    return [path["value"] for config in layout["configById"].values() for path in config.get("paths", ())]


@pytest.mark.parametrize("name", ["t1.mcap", "pendulum.mcap", "arm.csv"])
def test_a_layout_of_foxglove_has_the_published_structure(name: str) -> None:
    layout = foxglove(LOGS / name)
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    configs, shown = layout["configById"], panels_in(layout["layout"])
    tabs = configs["Tab!topics"]
    assert set(tabs) == {"activeTabIdx", "tabs"}
    for tab in tabs["tabs"]:
        assert set(tab) == {"title", "layout"}
        shown += panels_in(tab["layout"])
    assert sorted(shown) == sorted(configs), "each panel is shown once, and each that is shown has a config"
    for panel, config in configs.items():
        if panel.startswith("Plot!"):
            assert {key: type(value) for key, value in config.items()} == PLOT
            assert config["xAxisVal"] in ("timestamp", "index", "custom", "currentCustom")
            for path in config["paths"]:
                assert {key: type(value) for key, value in path.items()} == PATH
                assert path["timestampMethod"] in ("receiveTime", "headerStamp")
        elif panel.startswith("3D!"):
            assert set(config["cameraState"]) == CAMERA
            assert all(value == {"visible": True} for value in config["topics"].values())
    assert ("3D!scene" in configs) == (name == "t1.mcap")


@pytest.mark.parametrize("name", ["t1.mcap", "pendulum.mcap"])
def test_every_path_of_a_layout_is_a_number_of_the_messages(name: str) -> None:
    store = get_typestore(Stores.LATEST)
    first: dict[str, Any] = {}
    with (LOGS / name).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic not in first and schema is not None:
                store.register(
                    {k: v for k, v in get_types_from_msg(schema.data.decode(), schema.name).items()
                     if k not in store.fielddefs}
                )  # fmt: skip
                first[channel.topic] = store.deserialize_cdr(message.data, schema.name)
    paths = message_paths(foxglove(LOGS / name))
    assert len(paths) > 2
    for path in paths:
        topic, _, rest = path.partition(".")
        value = first[topic]
        for step in re.findall(r"\w+|\[\d+\]", rest):
            value = value[int(step[1:-1])] if step.startswith("[") else getattr(value, step)
        assert isinstance(float(value), float), path


def test_the_topics_of_the_system_come_first_and_its_fields_alone(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.define("my_msgs/msg/Drives", "float64[3] angle\nfloat64[3] heat\nfloat64 voltage\n")
        for step in range(20):
            log.numbers("/aaa", step * 10**7, [1.0, 2.0])
            values = log.message("my_msgs/msg/Drives", angle=np.full(3, 0.1), heat=np.ones(3), voltage=2.0)
            log.write("/drives", "my_msgs/msg/Drives", step * 10**7, values)
            log.joint_state("/cmd", step * 10**7, ["hinge"], [0.0])
    fields = {
        "topic": "/drives",
        "joints": ["hinge"],
        "fields": {"position": ["angle[1]"]},
        "noise": {"position": 1},
    }
    command = {"topic": "/cmd", "actuators": ["servo"], "quantity": "position"}
    system = amhe.System.load("pendulum", {"signals": {"joints": fields, "command": command}})
    plain, known = foxglove(tmp_path / "a.mcap"), foxglove(tmp_path / "a.mcap", system)
    assert message_paths(plain) == [
        "/aaa.data[0]", "/aaa.data[1]", "/cmd.position[0]",
        *(f"/drives.{name}[{i}]" for name in ("angle", "heat") for i in range(3)), "/drives.voltage",
    ]  # fmt: skip
    assert message_paths(known) == ["/drives.angle[1]", "/cmd.position[0]", "/aaa.data[0]", "/aaa.data[1]"]


def test_odd_names_stand_in_quotes(tmp_path: Path) -> None:
    table = tmp_path / 'a b";import os.csv'
    table.write_text('t,"the angle",<x>y&z\n' + "".join(f"{0.01 * i},{i},{i}\n" for i in range(20)))
    head = '"/a b\\";import os"'
    assert message_paths(foxglove(table)) == [f'{head}."the angle"', f'{head}."<x>y&z"']


def test_wrong_words_are_one_line(tmp_path: Path, capsys) -> None:
    log, out = str(LOGS / "pendulum.mcap"), str(tmp_path / "a.json")
    for arguments in (
        [log, "-o", out],
        [log, "--layout", "foxglove"],
        [log, log, "--layout", "foxglove", "-o", out],
    ):
        assert run(["inspect", *arguments]) == 2
        assert "--layout" in capsys.readouterr().err
    with pytest.raises(amhe.AmheError, match="did you mean 'foxglove'"):
        amhe.layout(log, "foxgloves")
    with LogWriter(tmp_path / "empty.mcap") as writer:
        writer.diagnostics(0, 0, "nothing", {})
    (tmp_path / "words.csv").write_text("t,word\n" + "".join(f"{0.1 * i},on\n" for i in range(9)))
    with pytest.raises(amhe.AmheError, match="can be plotted"):
        amhe.layout(tmp_path / "words.csv")
