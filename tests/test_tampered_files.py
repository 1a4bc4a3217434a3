"""Files that amhe wrote and somebody changed, and models made to cost: one line, no traceback."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.robots.go1.run import MODES
from amhe_cli.robots.go1.tasks import TASKS
from amhe_cli.study.store import Store, Study, open_store, start
from amhe_cli.system.model.files import compiled, read_spec
from tests.study.cells_at_play import CODE, record

FLOORS = {name: task.floor for name, task in TASKS.items()}


def one_line(error: BaseException, path: Path) -> bool:
    return "\n" not in str(error) and str(path) in str(error)


@pytest.fixture
def study(tmp_path: Path) -> Store:
    """A study of one cell."""
    from amhe_cli.study.cells import Cell

    cell = Cell("t4", "true", 0)
    store = start(tmp_path / "study", Study(CODE, {}, machine={"python": "3"}), False, False)
    store.write(cell, record({"cell": cell.plain(), "code": CODE}))
    return store


DEEP: Any = "deep"
STUDIES = {
    "code": (None, "x", {"amhe": 1}, DEEP),
    "defaults": (None, 3),
    "setting": ("x", None, [1]),
    "duration": ("x", None, {}),
    "commands": (3, [3], None),
    "made": (None, 7),
    "machine": (None, [], {"python": []}),
}


def written(path: Path, content: dict[str, Any]) -> None:
    """Write JSON; DEEP stands for lists without end."""
    path.write_text(json.dumps(content).replace(json.dumps(DEEP), "[" * 100_000))


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, all in STUDIES.items() for value in all])
def test_a_changed_description_of_a_study(study: Store, key: str, value: Any) -> None:
    path = study.folder / "study.json"
    written(path, json.loads(path.read_text()) | {key: value})
    with pytest.raises(ConfigError) as error:
        open_store(study.folder)
    assert one_line(error.value, path)


CELLS: dict[str, Callable[[dict[str, Any]], object]] = {
    "no outcome": lambda cell: cell.update(outcome=None),
    "outcome is a list": lambda cell: cell.update(outcome=[]),
    "no trace": lambda cell: cell.update(trace=None),
    "ragged trace": lambda cell: cell["trace"].update(speed=[1.0, 2.0]),
    "nested trace": lambda cell: cell["trace"].update(speed=[[1.0]] * 60),
    "no time": lambda cell: cell["trace"].pop("time"),
    "no speed": lambda cell: cell["trace"].pop("speed"),
    "deep": lambda cell: cell.update(trace=DEEP),
    "seed": lambda cell: cell["cell"].update(seed="x"),
    "setting": lambda cell: cell["cell"].update(setting="x"),
    "seconds": lambda cell: cell.update(seconds="x"),
    "code": lambda cell: cell.update(code=[]),
}


@pytest.mark.parametrize("change", CELLS)
def test_a_changed_cell(study: Store, change: str) -> None:
    [path] = (study.folder / "cells").iterdir()
    content = json.loads(path.read_text())
    CELLS[change](content)
    written(path, content)
    with pytest.raises(AmheError) as error:
        study.results()
    assert one_line(error.value, path)


def test_a_measure_that_is_no_number(study: Store) -> None:
    from amhe_cli.report.study.page import write_study

    [path] = (study.folder / "cells").iterdir()
    content = json.loads(path.read_text())
    content["outcome"]["cost"] = "x"
    written(path, content)
    with pytest.raises(AmheError, match="t4 true, seed 0: its result has no cost"):
        write_study(study, FLOORS, MODES)


def test_an_unknown_machine_is_no_reason_to_fail(study: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    from amhe_cli.report.study import page

    monkeypatch.setattr(page, "drawn", lambda *of: [])
    path = study.folder / "study.json"
    written(path, json.loads(path.read_text()) | {"machine": {}, "code": {}})
    page.write_study(open_store(study.folder), FLOORS, MODES)
    assert "Python –" in (study.folder / "report.html").read_text()


MODELS = {
    "replicate": '<worldbody><replicate count="1000"><replicate count="100000"><geom size="1"/></replicate>'
    "</replicate></worldbody>",
    "flexcomp": '<worldbody><body name="b"><flexcomp name="f" type="grid" count="1000 1000 1000" dim="3" '
    'spacing=".1 .1 .1" mass="1"/></body></worldbody>',
    "hfield": '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
    "texture": '<asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>',
    "nuser": '<size nuser_body="1000000000"/>',
    "nkey": '<size nkey="1000000000"/>',
}


@pytest.mark.parametrize("name", MODELS)
def test_a_model_whose_elements_multiply(name: str, tmp_path: Path) -> None:
    inner, path = tmp_path / "inner.xml", tmp_path / "scene.xml"
    inner.write_text(f"<mujoco>{MODELS[name]}</mujoco>")
    path.write_text('<mujoco><!-- a -- b --><include file="inner.xml"/></mujoco>')
    with pytest.raises(ConfigError, match="beyond the limit model_") as error:
        read_spec(path)
    assert one_line(error.value, inner)


def test_a_name_that_is_no_utf8_is_refused_and_a_comment_may_be_anything(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    for names, comment in ((b"a", b"\xe9t\xe9"), (b"\xff\xfe", b"")):
        body = b'<body><joint name="' + names + b'"/><geom size="1"/></body>'
        path.write_bytes(b"<mujoco><!--" + comment + b"--><worldbody>" + body + b"</worldbody></mujoco>")
        if comment:
            assert compiled(read_spec(path)).joint(0).name == "a"
        else:
            with pytest.raises(ConfigError, match="no text in UTF-8"):
                read_spec(path)


def test_pipes_in_a_model_are_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    (tmp_path / "meshes").mkdir()
    os.mkfifo(tmp_path / "meshes" / "a.stl")
    path.write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="a" file="a.stl"/></asset></mujoco>'
    )
    with pytest.raises(ConfigError, match="a pipe or a device"):
        read_spec(path)
    (tmp_path / "part.xml").unlink(missing_ok=True)
    os.mkfifo(tmp_path / "part.xml")
    path.write_text('<mujoco><include file="part.xml"/></mujoco>')
    with pytest.raises(ConfigError, match="a pipe or a device"):
        read_spec(path)


@pytest.mark.parametrize(
    "inner",
    [
        '<include file="{secret}"/>',
        '<asset><mesh name="a" file="{secret}"/></asset>',
        '<custom><text name="a" data="&x;"/></custom>',
    ],
)
def test_a_model_shows_nothing_of_other_files(inner: str, tmp_path: Path) -> None:
    secret, path = tmp_path / "secret", tmp_path / "scene.xml"
    secret.write_text("root:x:0:0:secret words\n")
    entity = f'<!DOCTYPE mujoco [<!ENTITY x SYSTEM "file://{secret}">]>'
    path.write_text(f"{entity}<mujoco>{inner.format(secret=secret)}</mujoco>")
    try:
        spec = read_spec(path)
        shown = compiled(spec) and spec.to_xml()
    except ConfigError as error:
        shown = str(error)
    assert "secret words" not in shown and "root:x" not in shown


def test_what_mujoco_cannot_explain_is_an_error_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.xml"
    path.write_text('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    spec = read_spec(path)
    assert compiled(spec).ngeom == 1

    def fail(*of: object) -> None:
        raise RuntimeError("Caught an unknown exception!")

    class Broken:
        compile = fail

    with pytest.raises(ConfigError, match="cannot compile the model: Caught an unknown exception"):
        compiled(Broken())  # type: ignore[arg-type]
