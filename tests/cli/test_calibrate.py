"""`amhe calibrate` from the outside, on an emulated robot whose rigid bodies are off."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.cli.main import run
from amhe_cli.core.rotations import exp, multiply
from tests.robots.go1.emulator.emulating import Emulated, emulating

ROOT = Path(__file__).parents[2]
TRUNK = (0.03, -0.012, -0.045, 0.02, -0.035, 0.3)
BOX = (-0.05, 0.02, -0.15, 0.0, 0.01, -1.2)


def at(emulated: Emulated) -> list[str]:
    here = ["--host", "127.0.0.1", "--port", str(emulated.port)]
    eyes = ["--pose-host", "127.0.0.1", "--pose-port", str(emulated.mocap_port), "--set", "go1.slow=2"]
    return [*here, *eyes, "--set", "go1.connect_time=5"]


def off(name: str, offset: tuple[float, ...]) -> list[str]:
    return ["--set", f"go1.{name}_offset=[{','.join(map(str, offset))}]"]


@pytest.mark.slow
def test_offsets_are_found_again_and_make_the_robot_fit_to_run() -> None:
    pytest.importorskip("natnet")
    with emulating("--set", "go1.slow=2", *off("trunk", TRUNK), *off("box", BOX)) as emulated:
        command = [sys.executable, "-m", "amhe_cli", "calibrate", "-o", "out", *at(emulated)]
        pressed, nobody = (
            subprocess.run(
                [*command, *more], input=keys, text=True, capture_output=True, timeout=120,
                env={"PYTHONPATH": str(ROOT)},
            )
            for keys, more in (("\n\n", ()), ("", ("--force",)))
        )  # fmt: skip
        check = ["run", "--task", "t1", "--target", "go1", "--dry-run", *at(emulated)]
        assert run([*check, "--config", "out/offsets.yaml"]) == 0
        assert run(check) == 1, "without the offsets it is refused"
    assert pressed.returncode == 0, pressed.stderr
    assert pressed.stderr.count("then press Enter") == 2
    assert "its head along the x axis" in pressed.stderr
    assert (nobody.returncode, "give --yes" in nobody.stderr) == (2, True)
    assert pressed.stdout.startswith(Path("out/offsets.yaml").read_text())
    found = json.loads(Path("out/result.json").read_text())
    for name, true in (("trunk_offset", TRUNK), ("box_offset", BOX)):
        np.testing.assert_allclose(found[name][:3], true[:3], atol=0.001, err_msg=name)
        wrong = multiply(exp(-np.array(found[name][3:])), exp(np.array(true[3:])))
        assert 2.0 * np.arccos(min(1.0, abs(wrong[0]))) < np.deg2rad(0.3), name
    assert sorted(path.name for path in Path("out").iterdir()) == ["offsets.yaml", "result.json"]


@pytest.mark.slow
def test_what_cannot_be_is_refused(capfd) -> None:
    pytest.importorskip("natnet")
    with emulating("--set", "go1.slow=2", "--fault", "yup=1") as emulated:
        assert run(["calibrate", "--yes", *at(emulated)]) == 1
    err = capfd.readouterr().err
    assert "up axis z" in err
    assert sum("error:" in line for line in err.splitlines()) == 1
    assert list(Path().glob("*/*/*")) == []
