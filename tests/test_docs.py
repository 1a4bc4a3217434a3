"""The documentation: links, commands, messages it quotes and logs it names."""

from __future__ import annotations

import ast
import base64
import hashlib
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli import LogWriter
from amhe_cli.cli.advice import entries, entry_of
from amhe_cli.cli.command import FORMER
from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.main import amhe, run
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.limits import Limits
from amhe_cli.estimation.core.result import VERDICTS
from tests.test_architecture import ALLOWED

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(
    (ROOT / "docs").rglob("*.md")
)
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]*))?\)")


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) < 600


def test_the_page_of_verdicts_gives_them_the_meanings_that_reports_give() -> None:
    text = (ROOT / "docs" / "verdicts.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| `([\w-]+)` \| ([^|]+) \|", text, re.MULTILINE)) == VERDICTS


@pytest.mark.parametrize("page", ["README.md", "docs/ARCHITECTURE.md"])
def test_the_library_is_linked(page: str) -> None:
    links = {path for path, _ in LINK.findall((ROOT / page).read_text(encoding="utf-8"))}
    targets = {((ROOT / page).parent / path).resolve().relative_to(ROOT).as_posix() for path in links if path}
    assert {"docs/api.md", "examples/identify_arrays.py", "examples/notebook.ipynb"} <= targets


def anchor(heading: str) -> str:
    """The fragment that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for path, fragment in LINK.findall(page.read_text(encoding="utf-8")):
        target = page.parent / path if path else page
        assert target.exists(), path
        if fragment:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert fragment in map(anchor, headings), f"{path}#{fragment}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_modules_exist(page: Path) -> None:
    for name in set(re.findall(r"`([\w./]+\.py)`", page.read_text(encoding="utf-8"))):
        assert (ROOT / "amhe_cli" / name).exists() or (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_conflict_is_left(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert [line for line in text.splitlines() if re.match(r"^(<{7}|={7}|>{7})( |$)", line)] == []


def test_the_table_of_limits_has_their_defaults() -> None:
    text = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| .* \| ([\d,]+) \| .* \|$", text, re.MULTILINE)
    assert {name: int(value.replace(",", "")) for name, value in rows} == asdict(Limits())


def test_every_room_is_described() -> None:
    text = (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert [room for room in ALLOWED if f"| `{room}/` |" not in text] == []


@pytest.mark.medium
def test_the_site_holds_every_page_and_its_links_lead_somewhere(site: Path) -> None:
    """Its links are looked at as it is built (--strict)."""
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} | {"index"}
    assert pages <= {page.stem for page in site.glob("*.html")}
    for page in site.glob("*.html"):
        assert "span>" not in re.sub(r"<[^<>]*>", "", page.read_text(encoding="utf-8")), page
    listed = re.findall(r": (\w+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(pages), "each page stands in the site's contents"


#: Parts of the site that are the user's path; Commands is written from the commands themselves.
PATH = ("amhe", "Tutorial", "How to", "Understand", "Troubleshooting", "Glossary", "Reference")
#: Words that the user's path may have.
WORDS = 21_500
#: What a page has no robot, network or browser for here, by the words of the command; tested elsewhere.
ELSEWHERE = ("--source ros2", "--source zenoh", "--follow", "udp://", "menagerie:", "amhe view found/  ",
             "amhe view arm-found/  ", "--view  ", "so101.xml", "dataset#", "amhe identify ...")  # fmt: skip


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


def commands(text: str) -> Iterator[str]:
    """Command lines of `amhe` in blocks."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    blocks += re.findall(r"^    (amhe .*)$", text, re.MULTILINE)
    for block in blocks:
        for line in block.replace("\\\n", " ").splitlines():
            line = line.removeprefix("$ ").split("  #")[0].strip()
            if re.match(r"amhe [\w-]+(?!.*: error)( |$)", line):
                yield line


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "gallery").glob("*.html")), ids=lambda p: p.stem)
def test_a_browser_lets_the_script_of_a_page_of_the_gallery_run(page: Path) -> None:
    html = page.read_text(encoding="utf-8")
    (script,) = re.findall(r"<script(?! type)[^>]*>(.*?)</script>", html, re.DOTALL)
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{allowed}'" in html


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
ROBOT = """<mujoco model="my_robot"><option timestep="0.005"/><worldbody><body name="load">
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


#: The same link as a URDF, and what a servo of it may be.
URDF = """<robot name="arm"><link name="base"/><link name="load"><inertial><origin xyz="0 0 -0.1"/>
  <mass value="0.3"/><inertia ixx="0.001" iyy="0.001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="load"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="2" velocity="9"/></joint></robot>"""
DRIVE = ("--drive", "elbow=feetech:sts3215", "--volts", "12", "--gain-p", "16")


def recorded(path: Path) -> None:
    """The first of these logs as messages of ROS."""
    rows = np.loadtxt(swing(0.0).splitlines()[1:], delimiter=",")
    with LogWriter(path) as log:
        for time, angle, target in rows:
            stamp = round(1e9 * time)
            log.joint_state("/joint_states", stamp, ["elbow"], [angle])
            log.joint_state("/joint_commands", stamp, ["elbow"], [target])


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pages take for given: logs and a model of the user's, a system folder, a result."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "my_robot.xml").write_text(ROBOT.replace('damping="0.1"', 'damping="0.05"'))
    for name, phase in {"my_log": 0.0, "run1": 0.0, "run2": 1.0}.items():
        (folder / f"{name}.csv").write_text(swing(phase))
    shutil.copy(ROOT / "examples" / "logs" / "arm_torque.csv", folder / "arm.csv")
    for name in ("run.mcap", "swing.mcap"):
        recorded(folder / name)
    urdf = folder / "arm_description" / "urdf" / "arm.urdf"
    urdf.parent.mkdir(parents=True)
    for path in (urdf, folder / "arm.urdf"):
        path.write_text(URDF)
    for name, log in {"calibrate": "run1", "weigh": "run2"}.items():
        (folder / f"{name}.yaml").write_text(f"logs: [{{log: {log}.csv}}]")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        quick(patch)
        made = {"my_system": ("my_log.csv",), "my_arm": ("swing.mcap",), "servo": ("my_log.csv", *DRIVE)}
        for system, words in made.items():
            assert run(["init", "my_robot.xml", *words, "-o", system, "-q"]) == 0
        shutil.copytree("my_arm", "arm")
        assert run(["identify", "my_log.csv", "--system", "my_system", "-o", "found", "-q"]) == 0
    return folder


def quick(patch: pytest.MonkeyPatch) -> None:
    """Few clips, and little time: what is tested is that each command works on what those before it made."""
    patch.setenv("AMHE_CLIPS__COUNT", "4")
    patch.setenv("AMHE_IDENTIFY__ITERATIONS", "2")
    patch.setenv("AMHE_IDENTIFY__FIRST_STATE", "never")
    patch.setenv("AMHE_PROBE__CANDIDATES", "1")
    patch.setenv("AMHE_PROBE__PAIRS", "0")
    patch.setattr("amhe_cli.estimation.conclude._missing", lambda fit, watch: watch.omits())


#: Command -> options that let it take little time.
LITTLE = {
    "amhe identify": ["--max-time", "1"],
    "amhe audit example:": ["--to", "3"],
    "amhe check example:": ["--to", "2"],
    "amhe mhe-replay arm.csv": ["--to", "2"],
    "amhe init arm": ["--force"],  # three ways to the same folder
}
RUN = [
    page
    for page in user_pages()
    if page.name != "cli.md" and list(commands(page.read_text(encoding="utf-8")))
]


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
    for line in commands(text):
        if any(words in f"{line}  " for words in ELSEWHERE):
            continue
        little = next((options for start, options in LITTLE.items() if line.startswith(start)), [])
        assert run([*shlex.split(line)[1:], *little]) == 0, f"{line}\n{capsys.readouterr().err}"


def test_every_kind_of_reason_has_an_entry() -> None:
    code = (ROOT / "amhe_cli" / "estimation" / "uncertainty" / "verdicts.py").read_text()
    kinds = set(re.findall(r'Reason\(\s*"(\w+)"', code)) | {"assumed", "parts", "minimum"}
    texts = re.search(r"_TEXTS = \{(.*?)\n\}", code, re.DOTALL)
    assert texts is not None
    kinds |= set(re.findall(r'^    "(\w+)":', texts[1], re.MULTILINE))
    assert kinds >= {"bound", "misfit", "idle", "open", "together", "search"}
    assert kinds - entries().keys() == set()


def literal(node: ast.expr) -> str | None:
    """A text with 'x' for what is filled in; None: it is not written here."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%[-+.\w]*?[a-z]", "x", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(one.value) if isinstance(one, ast.Constant) else "x" for one in node.values)
    return None


def warnings() -> Iterator[tuple[str, str]]:
    """Place and text of each warning of the library."""
    for path in sorted((ROOT / "amhe_cli").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "warning":
                text = literal(node.args[0])
                if text is not None and text.replace("x", "").strip(" :'"):
                    yield (
                        f"{path.name}:{node.lineno}",
                        text.replace("topic x", "topic 'x'").replace("signal x", "signal 'x'"),
                    )


@pytest.mark.medium
def test_every_warning_has_an_entry() -> None:
    found = dict(warnings())
    assert len(found) > 40
    assert {place: text for place, text in found.items() if entry_of(text) is None} == {}


def test_a_message_names_its_entry_and_help_prints_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "run.csv"
    log.write_text("time,q\n0,1\n0.1,2\n")
    assert run(["identify", str(log), "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.endswith("(amhe help no-system)\n")
    assert run(["help", "no-system"]) == 0
    assert "amhe init" in capsys.readouterr().out
    assert not entries().keys() & amhe.commands.keys(), "a command's name would hide the entry"


LOGS = {"pendulum": "pendulum", "pusher": "pusher", "t1": "go1_push", "t4": "go1_push"}


@pytest.mark.parametrize(("name", "system"), LOGS.items())
def test_a_bundled_log_is_read_by_its_system_without_options(name: str, system: str) -> None:
    path = bundled_root() / "examples" / "logs" / f"{name}.mcap"
    assert path.stat().st_size < 2**20
    inputs = Inputs()
    opened = inputs.open([path])
    assert opened.name == system
    (log,) = inputs.read(opened, [path])
    assert log.duration > 5.0
    assert all(series.valid.mean() > 0.99 for series in log.series.values())
    assert ("truth" in log.metadata) == (name != "t4")  # the floor of t4 changes on the way


def test_no_bundled_log_is_forgotten_here() -> None:
    folder: Path = bundled_root() / "examples" / "logs"
    assert {path.stem for path in folder.glob("*.mcap")} == set(LOGS)
