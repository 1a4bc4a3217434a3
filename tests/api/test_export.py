"""Exports: files that other tools read, and draws that keep the belief."""

import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.belief import belief_of
from amhe_cli.system.description.folders import bundled_systems
from amhe_cli.system.provenance import sha256

COVARIANCE = np.array([[0.01, 0.008, 0, 0], [0.008, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 0.01]])


@pytest.fixture
def belief(tmp_path: Path) -> Path:
    system = amhe.System.load("pendulum")
    path = tmp_path / "belief.yaml"
    belief_of(system, np.array([0.5, 0.2, -0.1, 0.0]), COVARIANCE).save(path)
    return path


def test_samples_keep_the_correlation(belief: Path, tmp_path: Path) -> None:
    amhe.export(belief, "samples", tmp_path / "out", count=2000)
    with np.load(tmp_path / "out" / "samples.npz") as file:
        samples, names = file["samples"], list(file["names"])
    assert names == ["load_mass", "damping", "friction_loss", "armature"]
    assert samples.shape == (2000, 4)
    assert np.corrcoef(np.log(samples[:, :2]).T)[0, 1] == pytest.approx(0.8, abs=0.05)
    rows = np.genfromtxt(tmp_path / "out" / "samples.csv", delimiter=",", names=True)
    np.testing.assert_allclose(rows["damping"], samples[:, 1], rtol=1e-8)


def test_a_model_of_each_sample(belief: Path, tmp_path: Path) -> None:
    files = amhe.export(belief, "samples", tmp_path / "out", count=3, models=True)
    masses = [mujoco.MjModel.from_xml_path(str(file)).body("load").mass[0] for file in files[2:]]
    with np.load(files[1]) as file:
        np.testing.assert_allclose(masses, file["samples"][:, 0], rtol=1e-5)


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        ("mjcf", {"identified.xml"}),
        ("mjlab", {"identified.xml", "mjlab_events.py"}),
        ("isaaclab", {"identified.xml", "isaaclab_events.py"}),
    ],
)
def test_every_kind_is_a_command(
    kind: str, files: set[str], belief: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(belief), "--to", kind, "-o", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == files
    assert "wrote" in capsys.readouterr().out
    model = next(path for path in (tmp_path / "out").iterdir() if path.stem == "identified")
    load, rod = amhe.Belief.load(belief).estimate[0], 0.05
    assert sum(mujoco.MjModel.from_xml_path(str(model)).body_mass) == pytest.approx(load + rod, rel=1e-5)


def test_a_belief_shows_the_folder_of_its_system_and_opens_it_only_when_it_is_given(
    tmp_path: Path, pendulum_log: Path
) -> None:
    system = amhe.System.load("pendulum")
    folder = tmp_path / "mine"
    folder.mkdir()
    for file in system.folder.iterdir() if system.folder else ():
        (folder / file.name).write_bytes(file.read_bytes())
    mine = amhe.System.load(folder)
    log = amhe.read_log(pendulum_log, mine, end=3.0)
    amhe.identify(mine, log, only=["load_mass"], max_time=1.0).save(tmp_path / "result")
    belief = tmp_path / "result" / "belief.yaml"
    with pytest.raises(
        amhe.AmheError, match=f"in {folder}, which .+: give its folder with `system={folder}`"
    ):
        amhe.export(belief, "mjcf", tmp_path / "out")
    renamed = tmp_path / "renamed.yaml"
    renamed.write_text(re.sub("system_folder: .*\n", "", belief.read_text()).replace("mine", str(folder)))
    with pytest.raises(amhe.AmheError, match="give its folder with `system=DIR`"):
        amhe.export(renamed, "mjcf", tmp_path / "out")
    amhe.export(belief, "mjcf", tmp_path / "out", system=folder)
    assert (tmp_path / "out" / "identified.xml").is_file()


@pytest.mark.medium
def test_a_result_folder_names_the_system_of_its_belief(
    tmp_path: Path, pendulum_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, out = tmp_path / "mine", tmp_path / "out"
    shutil.copytree(bundled_systems()["pendulum"], mine)
    search = [
        "--only",
        "load_mass",
        "--set",
        "parameters.load_mass.nominal=0.5",
        "--max-time",
        "1",
        "--to",
        "3",
    ]
    done = ["-o", str(tmp_path / "mon"), "-q"]
    assert run(["identify", str(pendulum_log), "--system", str(mine), *search, *done]) in (0, 3)
    belief = tmp_path / "mon" / "belief.yaml"
    export = ["export", "--to", "mjcf", "-o", str(out), "--force"]
    assert run([*export, str(belief)]) == 0
    assert f"the belief is of system {mine}" in capsys.readouterr().err
    assert "load_mass" in (out / "identified.xml").read_text()

    shutil.copytree(tmp_path / "mon", tmp_path / "tue")
    other = tmp_path / "tue" / "belief.yaml"  # as if of another log
    other.write_text(other.read_text().replace(sha256(pendulum_log), "0" * 64))
    assert run(["pool", str(belief), str(other)]) == 0
    alone = tmp_path / "belief.yaml"
    shutil.copy(belief, alone)
    capsys.readouterr()
    assert run([*export, str(alone)]) == 2, "a belief alone opens no folder"
    assert f"--system {mine}" in capsys.readouterr().err
    assert run(["pool", str(alone), str(other)]) == 2

    mine.rename(tmp_path / "moved")
    assert run([*export, str(belief)]) == 2
    assert "the system of this result is not there; give its folder with --system" in capsys.readouterr().err
    assert run([*export, str(belief), "--system", str(tmp_path / "moved")]) == 0


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (
            '{"schema_version": 1, "command": "identify", "inputs": {"system": 5}}',
            "is no result of this amhe",
        ),
        ('{"schema_version": 1, "command": "identify"}', "run `amhe identify` again"),
        ("no JSON", "is no result of this amhe"),
        ("[]", "is no result of this amhe"),
    ],
)
def test_a_result_folder_that_was_tampered_with_is_one_line(
    result: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    belief_of(amhe.System.load("pendulum"), np.zeros(4), COVARIANCE).save(tmp_path / "belief.yaml")
    (tmp_path / "result.json").write_text(result)
    for command in (["export", "--to", "mjcf", "-o", str(tmp_path / "out")], ["pool"]):
        assert run([*command, str(tmp_path / "belief.yaml")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert text in line
        assert "--system" in line


def test_a_pooled_belief_is_not_written_over(belief: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["pool", str(belief), str(belief), "-o", str(belief)]) == 2
    assert "--force" in capsys.readouterr().err


def test_wrong_arguments_are_one_line(belief: Path, tmp_path: Path) -> None:
    with pytest.raises(amhe.AmheError, match="did you mean 'mjcf'"):
        amhe.export(belief, "mjfc", tmp_path / "out")
    with pytest.raises(amhe.AmheError, match="`count`"):
        amhe.export(belief, "samples", tmp_path / "out", count=0)
    with pytest.raises(amhe.AmheError, match="another model|is about"):
        amhe.export(belief, "mjcf", tmp_path / "out", system="cube_toss")
