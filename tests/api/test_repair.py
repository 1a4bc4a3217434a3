"""`--repair`: what a model lacks is put into a copy of its system, if held-out clips agree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.api import repair
from amhe_cli.cli.main import run
from amhe_cli.core.yaml_file import YamlFile, scalar
from amhe_cli.estimation.core.result import AtHorizon, Missing, MissingRow
from amhe_cli.estimation.validation.prediction import improves
from amhe_cli.report.held_out import sized
from amhe_cli.report.missing import repairs_table
from tests.estimation.test_explain import XML, swung

YAML = """model: model.xml  # a pendulum
parameters:
  # what hangs at its end
  mass: {nominal: 0.4, prior_sd: 0.5, scale: log, targets: [{body: load, set: mass}]}
signals:
  joints: {topic: log, joints: [hinge], columns: {position: hinge}, noise: {position: 0.0005}}
  command: {topic: log, actuators: [servo], quantity: position, columns: {position: target}}
settings: {clips: {length: [0.4, 0.8], count: 8}}
"""
SPRING = "  k: {nominal: 0.5, scale: log, prior_sd: 1, targets: [{joint: hinge, set: stiffness}]}\n" + (
    "  rest: {nominal: 0.05, bounds: [-1, 1], prior_sd: 0.2, targets: [{joint: hinge, set: spring_rest}]}\n"
)


def _swing(folder: Path, stiffness: float) -> tuple[Path, Path]:
    """A system of a pendulum without a spring, and a log of one that has one about 0.1 rad."""
    system, log = folder / "pendulum", folder / "log.csv"
    system.mkdir()
    (system / "model.xml").write_text(XML)
    (system / "system.yaml").write_text(YAML)
    np.savetxt(log, swung(stiffness), delimiter=",", header="time,hinge,target", comments="")
    return system, log


def _files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _error(record: dict[str, Any]) -> float:
    """Held-out error of the position at the longest horizon."""
    (last,) = [
        one for one in record["held_out"]["horizons"] if one["to_end"] and "position" in one["channel"]
    ]
    return float(last["identified"])


@pytest.mark.medium
def test_a_missing_spring_is_put_into_a_copy_of_the_system(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    system, log = _swing(tmp_path, 0.8)
    before, out = _files(system), tmp_path / "out"

    assert run(["identify", str(log), "--system", str(system), "--repair", "-q", "-o", str(out)]) == 0

    assert _files(system) == before
    record = json.loads((out / "result.json").read_text())
    assert [(one["name"], one["kept"]) for one in record["repairs"]] == [("spring@hinge", True)]
    assert record["repairs"][0]["horizons"][0]["against_best"]["spring@hinge"]["upper"] < 1.0
    found = {p["name"]: p for p in record["parameters"]}
    assert found["hinge_stiffness"]["verdict"] == "conditional"
    assert found["hinge_stiffness"]["given"] == "the repair spring@hinge"
    assert found["hinge_stiffness"]["lower"] < 0.8 < found["hinge_stiffness"]["upper"]
    assert found["hinge_rest"]["lower"] < 0.1 < found["hinge_rest"]["upper"]
    assert "What was repaired" in (out / "report.html").read_text()
    text = (out / "system" / "system.yaml").read_text()
    assert "# spring@hinge: a spring of 0." in text and "# what hangs at its end\n  mass:" in text
    copy = amhe.System.load(out / "system")
    assert set(copy.space.names) == set(found)
    identified = mujoco.MjModel.from_xml_path(str(out / "identified.xml"))
    assert identified.qpos_spring[0] == pytest.approx(found["hinge_rest"]["estimate"], rel=1e-4)
    # the true structure, written by hand
    request.getfixturevalue("unexplained")
    (system / "system.yaml").write_text(YAML.replace("signals:", SPRING + "signals:"))
    true = tmp_path / "true"
    assert run(["identify", str(log), "--system", str(system), "-q", "-o", str(true)]) == 0
    assert _error(record) < 1.1 * _error(json.loads((true / "result.json").read_text()))


@pytest.mark.medium
def test_nothing_is_kept_of_a_faultless_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Nor of one where a cause is named that is none: held-out clips decide."""
    system, log = _swing(tmp_path, 0.0)
    before, opened = _files(system), amhe.System.load(system)
    logs = [amhe.read_log(log, opened)]

    assert amhe.repair(opened, logs, threads=1).found.repairs == ()

    entry = {"nominal": 0.1, "scale": "log", "targets": [{"joint": "hinge", "set": "stiffness"}]}
    zeros = np.zeros(1)
    named = MissingRow("spring", "hinge", "a spring", 0.5, (), {"k": entry}, ("q", zeros, zeros, zeros))

    def naming(*arguments: Any, **more: Any) -> amhe.Result:
        result = amhe.identify(*arguments, **more)
        return replace(result, found=replace(result.found, missing=Missing((named,))))

    request.getfixturevalue("unexplained")
    monkeypatch.setattr(repair, "identify", naming)
    result = amhe.repair(opened, logs, threads=1)
    assert [(one.name, one.kept) for one in result.found.repairs] == [("spring@hinge", False)]
    assert result.system.space.names == ("mass",)
    result.save(tmp_path / "out")
    assert not (tmp_path / "out" / "system").exists()
    assert _files(system) == before


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_a_cause_whose_place_a_later_one_takes_is_left_out_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of models are given here: that of `a` and `b` is that of `b` alone; `c` helps none.

    What `b` says of the parameter that `a` adds is added to what `a` says.
    """
    system, log = _swing(tmp_path, 0.0)
    opened = amhe.System.load(system)
    error = {"": 8.0, "a": 4.0, "ab": 1.0, "b": 1.0, "c": 8.0, "ac": 4.0, "bc": 1.0, "abc": 1.0}
    zeros, now = np.zeros(1), [""]
    entries_of = {"c": {"c": {}}, "a": {"a": {"unit": "m"}}, "b": {"b": {}, "a": {"nominal": 2.0}}}
    rows = [
        MissingRow(n, "hip", n, 0.5, (), adds, ("q", zeros, zeros, zeros)) for n, adds in entries_of.items()
    ]
    given = list[dict[str, Any]]()
    base = amhe.identify(opened, amhe.read_log(log, opened), threads=1)
    named = replace(base, found=replace(base.found, missing=Missing(tuple(rows))))

    def tried(_: Any, __: Any, entries: dict[str, Any], *more: Any) -> tuple[str, amhe.Result, Any]:
        given.append(entries)
        both = np.array([error[now[0]], error["".join(sorted(entries))]])
        ratios = both[:, None] / both[None]
        at = AtHorizon(0.5, False, 9, {("hip", "rad"): both}, ratios, 0.9 * ratios, 1.1 * ratios)
        if both[1] <= both[0]:
            now[0] = (
                "".join(sorted(entries)) if improves([at], 1, 0) or len(entries) < len(now[0]) else now[0]
            )
        return "so it is", named, (at,)

    monkeypatch.setattr(repair, "identify", lambda *_, **__: named)
    monkeypatch.setattr(repair, "_tried", tried)
    found = amhe.repair(opened, []).found

    assert [(one.name, one.kept) for one in found.repairs] == [
        ("c@hip", False), ("a@hip", False), ("c@hip", False), ("b@hip", True), ("c@hip", False),
        ("without a@hip", True),
    ]  # fmt: skip
    assert given[3] == {"a": {"unit": "m", "nominal": 2.0}, "b": {}}
    said = [row[-1] for row in repairs_table(found.repairs).rows]
    assert said == ["", "not kept", "dropped later", "not kept", "kept", "not kept", "kept"]
    assert [row[1] for row in repairs_table(found.repairs).rows][-1] == sized(1.0, "rad")


def test_wrong_names_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["identify", "--repair", "log.csv"]) == 2
    assert "'log.csv' is no cause such as spring@arm" in capsys.readouterr().err
    model = amhe.System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters=scalar(
            YAML.split("parameters:")[1].split("signals:")[0].replace("# what hangs at its end", "")
        ),
        signals={"joints": {"joints": ["hinge"], "noise": {"position": 5e-4}}},
        warn=False,
    )
    with pytest.raises(amhe.AmheError, match="give a system folder"):
        amhe.repair(model, [])


@pytest.mark.parametrize(
    "group",
    [
        "  m: {a: 1}",
        "  m:  # x\n    a: 1\n  # of n\n  n: {a: 2}",
        " {m: {a: 1}}  # x",
        " {}",
        "  # nothing",
        " {m: {a: 1},\n    n: {a: 2}}",
    ],
)
def test_entries_are_added_to_a_file_and_all_else_stays(tmp_path: Path, group: str) -> None:
    path = tmp_path / "system.yaml"
    path.write_text(
        f"model: m.xml\nparameters:{'' if group.startswith(' {') else chr(10)}{group}\nsignals: {{}}\n"
    )
    file = YamlFile(path)
    entry = {"nominal": 0.1, "targets": [{"joint": "a: b"}]}

    path.write_text(file.with_entries("parameters", [("k", entry, "why: [x]"), ("r", entry, "")]))

    own = file.own["parameters"] or {}
    assert YamlFile(path).own == {**file.own, "parameters": {"k": entry, "r": entry, **own}}
    assert path.read_text().count("# why: [x]\n") == 1
    again = YamlFile(path).with_entries("parameters", [("m", {"b": 7}, "so")])
    merged = {"m": {**own.get("m", {}), "b": 7}}
    assert scalar(again)["parameters"] == {"k": entry, "r": entry, **own, **merged}
    assert "# so\n" in again and ("# x" in again) == ("# x" in path.read_text())
    path.write_text("model: m.xml\n")
    assert scalar(YamlFile(path).with_entries("parameters", [("k", entry, "")]))["parameters"] == {"k": entry}
