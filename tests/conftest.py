"""What several rooms' tests share: a small log of a pendulum whose parameters are known."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import mujoco
import numpy as np
import pytest

from amhe_cli.logs import LogWriter

if TYPE_CHECKING:
    from tests.view.browser import Browser, Chromium

MODELS = Path(__file__).parents[1] / "models"

# A job in the background of a shell is started with SIGINT ignored, and hands that on to what it starts:
# tests of Ctrl-C need the usual state.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The width and the colours of the terminal that starts the tests are none of theirs.
for variable in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR"):
    os.environ.pop(variable, None)

# Where compiled files are not written, each worker and each command that a test starts compiles all anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What takes long on a busy machine is no failure.
hypothesis.settings.register_profile("unhurried", deadline=None)
hypothesis.settings.load_profile("unhurried")


def pytest_collection_finish() -> None:
    """What is imported by now stays to the end: no search for garbage needs to look through it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def hangs_up() -> Iterator[None]:
    """SIGHUP ends a process, as in a terminal: `nohup make test` ignores it, and hands that on."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The documentation as a site, which one worker builds for all."""
    pytest.importorskip("mkdocs")
    base = tmp_path_factory.getbasetemp()
    folder = (base if worker_id == "master" else base.parent) / "site"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
            built = subprocess.run(
                command, cwd=MODELS.parent, capture_output=True, text=True,
                env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
            )  # fmt: skip
            assert built.returncode == 0, built.stderr
    return folder


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """The browser of this worker."""
    from tests.view import browser

    if browser.PROGRAM is None:
        pytest.skip("no Chromium is installed (Debian: chromium)")
    with browser.chromium(tmp_path_factory.mktemp("profile")) as one:
        yield one


@pytest.fixture
def tab(chromium: Chromium, tmp_path: Path) -> Iterator[Browser]:
    """A tab of its own."""
    with chromium.tab(tmp_path) as one:
        yield one


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Function) -> Iterator[None]:
    """A test that fails with a page open leaves a picture of it in its folder."""
    given: dict[str, Any] = item.funcargs
    if "tab" not in given:
        return (yield)
    from tests.view.browser import picture_of_failure

    with picture_of_failure(given["tab"], given["tmp_path"]):
        return (yield)


@pytest.fixture
def unexplained(monkeypatch: pytest.MonkeyPatch) -> None:
    """No search for causes of what a model misses: it takes longer than the fit; `explain` has tests."""
    monkeypatch.setattr("amhe_cli.estimation.conclude._missing", lambda fit, watch: watch.omits())


#: The pendulum that the log is of; system.yaml starts elsewhere.
PENDULUM_TRUTH = {"load_mass": 0.62, "damping": 0.035, "friction_loss": 0.03, "armature": 0.006}


def write_pendulum_log(
    path: Path, seconds: float, seed: int = 0, silent: tuple[float, float] = (np.inf, np.inf), **metadata: str
) -> Path:
    """Swing the bundled pendulum with other parameters; log states at 250 Hz and commands at 50 Hz.

    Between the two times `silent` [s] no state is logged.
    """
    model = mujoco.MjModel.from_xml_path(str(MODELS / "pendulum" / "scene.xml"))
    model.body("load").mass[0] = PENDULUM_TRUTH["load_mass"]
    hinge = model.joint("hinge").dofadr[0]
    model.dof_damping[hinge] = PENDULUM_TRUTH["damping"]
    model.dof_frictionloss[hinge] = PENDULUM_TRUTH["friction_loss"]
    model.dof_armature[hinge] = PENDULUM_TRUTH["armature"]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    rng = np.random.default_rng(seed)
    with LogWriter(path, metadata) as log:
        for step in range(round(seconds / model.opt.timestep) + 1):
            stamp_ns = 1_700_000_000_000_000_000 + round(step * model.opt.timestep * 1e9)
            if step % 2 == 0 and not silent[0] < step * model.opt.timestep < silent[1]:
                position = data.qpos + rng.normal(0.0, 0.002, 1)
                velocity = data.qvel + rng.normal(0.0, 0.05, 1)
                log.joint_state("/joint_states", stamp_ns, ["hinge"], position, velocity)
            if step % 10 == 0:
                if step % 250 == 0:
                    data.ctrl[:] = rng.uniform(-1.2, 1.2)
                log.joint_state("/joint_commands", stamp_ns, ["hinge"], data.ctrl)
            mujoco.mj_step(model, data)
    return path


@pytest.fixture(scope="session")
def pendulum_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds of the pendulum; the log names its system."""
    return write_pendulum_log(tmp_path_factory.mktemp("logs") / "pendulum.mcap", 8.0, system="pendulum")


@pytest.fixture
def jumping(tmp_path: Path) -> Path:
    """A log whose load grows by 0.8 kg after four seconds."""
    model = mujoco.MjModel.from_xml_path(str(MODELS / "pendulum" / "scene.xml"))
    model.body("load").mass[0] = 0.4
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    mujoco.mj_setConst(model, data)
    with LogWriter(tmp_path / "jump.mcap", {"system": "pendulum"}) as log:
        for step in range(round(7.0 / model.opt.timestep)):
            stamp = 1_700_000_000_000_000_000 + round(step * model.opt.timestep * 1e9)
            if step == round(4.0 / model.opt.timestep):
                model.body("load").mass[0] += 0.8
                mujoco.mj_setConst(model, data)
            if step % 2 == 0:
                position = data.qpos + rng.normal(0.0, 0.002, 1)
                log.joint_state(
                    "/joint_states", stamp, ["hinge"], position, data.qvel + rng.normal(0.0, 0.05, 1)
                )
            if step % 10 == 0:
                data.ctrl[:] = np.sin(3.0 * data.time) + 0.3 * np.sin(11.0 * data.time)
                log.joint_state("/joint_commands", stamp, ["hinge"], data.ctrl)
            mujoco.mj_step(model, data)
    return tmp_path / "jump.mcap"


def go1_system_with(setting: str, folder: Path) -> int:
    """Copy the bundled system of the Go1 to a folder, with one more line of settings; the line's number."""
    shutil.copytree(MODELS / "go1_push", folder)
    file = folder / "system.yaml"
    lines = file.read_text().splitlines()
    row = lines.index("settings:") + 1
    file.write_text("\n".join([*lines[:row], setting, *lines[row:]]) + "\n")
    return row + 1


@pytest.fixture(scope="session")
def plant() -> mujoco.MjModel:
    """The Go1's plant, its box out of the robot's way."""
    from amhe_cli.robots.go1.model import plant_model
    from tests.robots.go1.playing import FAR

    return plant_model(FAR)
