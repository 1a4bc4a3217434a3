"""The commands of the pages that a user reads: all have the options they show, and blocks of `sh` run."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli.cli.command import FORMER
from amhe_cli.cli.main import amhe, run

ROOT = Path(__file__).parents[1]
#: Parts of the site that are the user's path; Commands is written from the commands themselves.
PATH = ("amhe", "Tutorial", "How to", "Understand", "Troubleshooting", "Glossary", "Reference")
#: Words that the user's path may have.
WORDS = 22_000
#: What a page has no robot, network or browser for here, by the words of the command; tested elsewhere.
ELSEWHERE = ("--source ros2", "--source zenoh", "--follow", "udp://", "menagerie:", "amhe view found/  ")


def user_pages() -> list[Path]:
    """The pages of the user's path, by the site's contents."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2])
    pages: list[str] = []
    for entry in nav:
        ((title, content),) = entry.items()
        if title in PATH:
            pages += (
                [content] if isinstance(content, str) else [name for one in content for name in one.values()]
            )
    return [ROOT / "README.md" if name == "index.md" else ROOT / "docs" / name for name in pages]


def commands(text: str, fence: str | None = None) -> Iterator[str]:
    """Command lines of `amhe` in blocks: those of a fence, or all."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    if fence is None:
        blocks += [("", line) for line in re.findall(r"^    (amhe .*)$", text, re.MULTILINE)]
    for kind, block in blocks:
        if fence in (None, kind):
            for line in block.replace("\\\n", " ").splitlines():
                line = line.removeprefix("$ ").split("  #")[0].strip()
                if re.match(r"amhe [\w-]+(?!.*: error)( |$)", line):
                    yield line


def test_the_users_path_is_short_enough() -> None:
    texts = {page.name: page.read_text(encoding="utf-8") for page in user_pages()}
    counts = {name: len(re.sub(r"<!--.*?-->", "", text).split()) for name, text in texts.items()}
    assert sum(counts.values()) - counts["cli.md"] <= WORDS, counts


@pytest.mark.parametrize("page", [*user_pages(), *sorted((ROOT / "docs").glob("*.md"))], ids=lambda p: p.name)
def test_commands_and_options_that_a_page_shows_exist(page: Path) -> None:
    for line in commands(page.read_text(encoding="utf-8")):
        if page.name == "cli.md" or "..." in line.split()[1]:
            continue
        _, name, *words = shlex.split(line)
        known = {option for param in amhe.commands[name].params for option in param.opts} | {"-h", "--help"}
        used = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert used <= known | FORMER.keys(), line


#: The user's robot: a link on a servo.
ROBOT = """<mujoco model="my_robot"><option timestep="0.005"/><worldbody><body name="fore">
  <joint name="elbow" axis="0 1 0" range="-3 3" damping="0.1" frictionloss="0.02" armature="0.002"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/></body></worldbody>
  <actuator><position name="elbow" joint="elbow" kp="6" kv="0.4" forcerange="-2 2"/></actuator></mujoco>"""


def swing(phase: float) -> str:
    """Six seconds of the robot, as a table."""
    model = mujoco.MjModel.from_xml_string(ROBOT)
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(0), ["time,elbow_pos,elbow_cmd"]
    for step in range(1200):
        if step % 2 == 0:
            data.ctrl[0] = 0.8 * np.sin(2.0 * data.time + phase) + 0.4 * np.sin(5.0 * data.time)
            rows.append(f"{data.time:.4f},{data.qpos[0] + rng.normal(0, 1e-3):.5f},{data.ctrl[0]:.5f}")
        mujoco.mj_step(model, data)
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pages take for given: logs and a model of the user's, a system folder, a result."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "my_robot.xml").write_text(ROBOT.replace('damping="0.1"', 'damping="0.05"'))
    for name, phase in {"my_log": 0.0, "run1": 0.0, "run2": 1.0}.items():
        (folder / f"{name}.csv").write_text(swing(phase))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        quick(patch)
        assert run(["init", "my_robot.xml", "my_log.csv", "--actuators", "-o", "my_system", "-q"]) == 0
        assert run(["identify", "my_log.csv", "--system", "my_system", "-o", "found", "-q"]) == 0
    return folder


def quick(patch: pytest.MonkeyPatch) -> None:
    """Few clips, and little time: what is tested is that each command works on what those before it made."""
    patch.setenv("AMHE_CLIPS__COUNT", "4")
    patch.setenv("AMHE_IDENTIFY__ITERATIONS", "2")
    patch.setenv("AMHE_PROBE__CANDIDATES", "4")


#: Command -> options that let it take little time.
LITTLE = {"amhe identify": ["--max-time", "2"], "amhe audit example:": ["--to", "3"]}
RUN = [page for page in user_pages() if list(commands(page.read_text(encoding="utf-8"), "sh"))]


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_the_commands_of_a_page_run_in_their_order(
    page: Path, prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    text = page.read_text(encoding="utf-8")
    for given in prepared.iterdir():
        if not re.search(rf"-o {re.escape(given.name)}/?(\s|$)", text):
            (shutil.copytree if given.is_dir() else shutil.copy)(given, tmp_path / given.name)
    monkeypatch.chdir(tmp_path)
    quick(monkeypatch)
    for line in commands(text, "sh"):
        if any(words in f"{line}  " for words in ELSEWHERE):
            continue
        little = next((options for start, options in LITTLE.items() if line.startswith(start)), [])
        assert run([*shlex.split(line)[1:], *little]) == 0, f"{line}\n{capsys.readouterr().err}"
