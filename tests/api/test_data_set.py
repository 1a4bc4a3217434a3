"""A data set file: several logs, each with what is known of it, as one identification."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.errors import ConfigError, LogError

MODEL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.02" armature="0.01"/>
      <geom name="load" type="sphere" pos="0 0 -0.2" size="0.03" mass="0.4"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="1" kv="0.02"/></actuator>
</mujoco>
"""
SYSTEM = """
model: scene.xml
parameters:
  gain: {targets: [{actuator: servo, set: gain}], bounds: [0.1, 20], prior_sd: 1.0}
  load: {targets: [{body: arm, set: mass}]}
  damping: {targets: [{joint: hinge, set: damping}]}
signals:
  joints: {columns: {position: q}, joints: [hinge], noise: {position: 0.002}}
  command: {columns: {position: u}, actuators: [servo]}
settings:
  clips: {count: 6, length: [0.5, 1.0]}
  identify: {iterations: 6}
"""
GAINS, LOAD, DAMPING = (1.5, 2.0, 3.0, 4.0), 0.5, 0.03
#: What a model with a wrong gain lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A servo at four gains: a system, a log at each gain, and a file that says which."""
    folder = tmp_path_factory.mktemp("servo")
    (folder / "logs").mkdir()
    (folder / "arm").mkdir()
    (folder / "arm" / "scene.xml").write_text(MODEL)
    (folder / "arm" / "system.yaml").write_text(SYSTEM)
    lines = ["logs:"]
    for number, gain in enumerate(GAINS):
        time, angle, command = swing(gain, number)
        np.savez(folder / "logs" / f"run{number}.npz", time=time, q=angle, u=command)
        lines.append(f"  - {{log: logs/run{number}.npz, known: {{gain: {gain}}}, from: 0.2, to: 3.0}}")
    (folder / "runs.yaml").write_text("\n".join(lines) + "\n")
    return folder


def swing(gain: float, seed: int) -> np.ndarray:
    """Times, measured angles and commands, shape (3, T)."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = gain, -gain
    model.body_inertia[1] *= LOAD / model.body_mass[1]
    model.body_mass[1] = LOAD
    model.dof_damping[0] = DAMPING
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(seed), []
    mujoco.mj_setConst(model, data)
    for step in range(800):
        if step % 100 == 0:
            data.ctrl[0] = rng.uniform(-1.5, 1.5)
        rows.append((data.time, data.qpos[0] + 0.002 * rng.normal(), data.ctrl[0]))
        mujoco.mj_step(model, data)
    return np.array(rows).T


@pytest.mark.medium
def test_a_servo_at_four_gains_is_one_identification(folder: Path) -> None:
    system = amhe.System.load(folder / "arm")
    logs = amhe.read_log([folder / "runs.yaml"], system)
    assert [log.known["gain"] for log in logs] == list(GAINS)
    assert all(log.duration == pytest.approx(2.8) for log in logs)
    result = amhe.identify(system, logs, threads=1)
    assert set(result.parameters) == {"load", "damping"}  # the gain is known in every log
    for name, truth in (("load", LOAD), ("damping", DAMPING)):
        found = result.parameters[name]
        assert abs(found.estimate - truth) < 3.0 * found.sd and found.sd < 0.05 * truth
        assert found.verdict == "identified"
    wrong = amhe.identify(system, [log.with_(known={"gain": 2.0}) for log in logs], threads=1)
    assert wrong.found.held_out and result.found.held_out
    assert wrong.found.held_out.cost > 10.0 * result.found.held_out.cost


@pytest.mark.medium
def test_the_command_takes_the_file(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (folder / "runs.yaml").read_text().replace("logs/", f"{folder}/logs/").splitlines()
    text[4] = text[4].replace("{log", "{held_out: true, log")
    (tmp_path / "runs.yaml").write_text("\n".join(text))
    arguments = ["identify", str(tmp_path / "runs.yaml"), "--system", str(folder / "arm"), "--json"]
    assert run([*arguments, "-o", str(tmp_path / "out"), "--threads", "1"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [Path(log).name for log in record["logs"]] == ["run0.npz", "run1.npz", "run2.npz"]
    assert record["held_out"]["clips"] == 3
    belief = (tmp_path / "out" / "belief.yaml").read_text()
    assert "gain" not in belief.partition("provenance")[0]
    assert all(f"run{i}.npz" in belief for i in range(4)) and "runs.yaml" in belief


@pytest.mark.medium
def test_parameters_that_logs_know_or_own_can_be_fixed(folder: Path, tmp_path: Path) -> None:
    system = amhe.System.load(folder / "arm", {"identify": {"iterations": 2}})
    logs = amhe.read_log([folder / "runs.yaml"], system)

    def found(logs: list[amhe.Log], **given: object) -> amhe.Result:
        return amhe.identify(system, logs, threads=1, **given)  # type: ignore[arg-type]

    only = found(logs, only=["load"])
    assert set(only.parameters) == {"load"} and set(only.system.fixed) == {"damping"}
    assert [log.known["gain"] for log in only.logs] == list(GAINS), "what logs know stays so"
    some = [log.with_(own=["damping"]) for log in (*logs[:2], *(log.with_(known={}) for log in logs[2:]))]
    fixed = found(some, fix={"damping": DAMPING}, only=["load"])
    assert set(fixed.parameters) == {"load"} and fixed.belief.fixed == {"damping": DAMPING}
    nominal = system.space.named(system.space.nominal)["gain"]
    assert [log.known["gain"] for log in fixed.logs] == [*GAINS[:2], nominal, nominal]
    for one in (logs, [*some[2:], logs[0].with_(held_out=True)]):
        with pytest.raises(ConfigError, match=r"`fix`: .*run0\.npz.* knows its own value of gain"):
            found(one, fix={"gain": 2.0})
    with pytest.raises(ConfigError, match="gain is known in every fitted log; give its value here too"):
        found([*logs[:3], logs[3].with_(known={}, held_out=True)], only=["load"])
    with pytest.raises(ConfigError, match="`known`: the logs know every parameter"):
        found(logs, only=["gain"])


@pytest.mark.medium
def test_fix_and_only_go_with_the_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["identify", str(folder / "runs.yaml"), "--system", str(folder / "arm"), "--json", "--force"]
    command += ["-o", str(folder / "only"), "--threads", "1", "--set", "identify.iterations=2"]
    assert run([*command, "--only", "load"]) == 0
    assert [p["name"] for p in json.loads(capsys.readouterr().out)["parameters"]] == ["load"]
    fixed = amhe.System.load(folder / "arm").fixing({"gain": 2.0})
    with pytest.raises(ConfigError, match=r"runs\.yaml:2:40: gain is fixed in the system, and a log cannot"):
        amhe.read_log([folder / "runs.yaml"], fixed)


@pytest.mark.medium
def test_other_commands_take_it_or_say_why_not(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, arm = str(folder / "runs.yaml"), str(folder / "arm")
    assert run(["inspect", path, "--system", arm, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["logs"]) == 4
    for command in (["mhe-replay", path, "--system", arm], ["init", f"{arm}/scene.xml", path]):
        assert run([*command, "-o", str(folder / "none")]) != 0
        assert "name one" in capsys.readouterr().err


def test_mistakes_have_their_place(folder: Path, tmp_path: Path) -> None:
    system = amhe.System.load(folder / "arm")
    (tmp_path / "run.npz").touch()
    (tmp_path / "runs.yaml").write_text(
        "logs:\n"
        "  - {log: run.npz, known: {gian: 2}}\n"
        "  - {log: run.npz, known: {gain: 99}, own: [drag]}\n"
        "  - {log: gone.npz, from: 3, to: 2}\n"
        "  - {log: run.npz, topics: {joint: /q}}\n"
    )
    with pytest.raises(ConfigError) as raised:
        amhe.read_log([tmp_path / "runs.yaml"], system)
    lines = str(raised.value).replace(f"{tmp_path}/", "").splitlines()
    assert lines[0].startswith("runs.yaml:2:34: no parameter 'gian' (did you mean 'gain'?)")
    assert lines[1].startswith("runs.yaml:3:34: gain is 99; between 0.1 and 20 would be valid")
    assert lines[2].startswith("runs.yaml:3:39: no parameter 'drag'")
    assert lines[3].startswith("runs.yaml:4:11: no file or folder 'gone.npz' beside this file")
    assert lines[4].startswith("runs.yaml:4:34: to: 2 is not after from: 3")
    assert lines[5].startswith("runs.yaml:5:36: no signal 'joint' (did you mean 'joints'?)")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("logs: run.npz", "runs.yaml:1:7: logs is 'run.npz'; a list such as"),
        ("log: [run.npz]", "runs.yaml:1:1: this file lacks the key 'logs'"),
        ("logs: [{log: run.npz, form: 2}]", "runs.yaml:1:23: no key 'form' (did you mean 'from'?)"),
        ("logs: [{from: 2}]", "runs.yaml:1:8: logs.0 lacks the key 'log'"),
        ("logs: [{log: run.npz, own: 3}]", "runs.yaml:1:28: own is 3; a list of parameters would be valid"),
        ("logs: [{log: run.npz, known: {gain: x}}]", "gain is 'x'; a number (without quotes) would be valid"),
        ("logs: [{log: run.npz, held_out: 1}]", "held_out is 1; true or false would be valid"),
    ],
)
def test_another_shape_is_refused(tmp_path: Path, folder: Path, text: str, expected: str) -> None:
    (tmp_path / "runs.yaml").write_text(text)
    with pytest.raises(ConfigError) as raised:
        amhe.read_log([tmp_path / "runs.yaml"], amhe.System.load(folder / "arm"))
    assert expected in str(raised.value)


def test_one_path_is_one_log(folder: Path) -> None:
    system = amhe.System.load(folder / "arm")
    with pytest.raises(LogError, match=r"runs\.yaml holds 4 logs; name one, such as .*run0\.npz"):
        amhe.read_log(folder / "runs.yaml", system)
    with pytest.raises(ConfigError, match="a data set file says which part of each log counts"):
        amhe.read_log([folder / "runs.yaml"], system, end=2.0)


def test_parts_of_one_file_may_be_fitted_and_held_out(folder: Path) -> None:
    system = amhe.System.load(folder / "arm", {"identify": {"iterations": 1}})
    path = folder / "logs" / "run0.npz"
    first = amhe.read_log(path, system, end=1.5).with_(known={"gain": GAINS[0]})
    second = amhe.read_log(path, system, start=1.6).with_(known={"gain": GAINS[0]}, held_out=True)
    assert amhe.identify(system, [first, second], threads=1).held_out == (second,)
    with pytest.raises(ConfigError, match="is fitted too"):
        amhe.identify(system, first, held_out=first.with_(), threads=1)
