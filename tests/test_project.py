"""What the project states about itself: licences, versions, private attributes, files for its host."""

from __future__ import annotations

import inspect
import re
import subprocess
import tomllib
from importlib.metadata import PackageNotFoundError, metadata, version
from itertools import chain
from pathlib import Path

import cmaes
import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli import __version__
from amhe_cli.core.errors import AmheError
from amhe_cli.estimation.offline.cma import memory_of, restore
from amhe_cli.robots.go1.poses.sources import PoseError, _listening_to
from amhe_cli.system.parameters.model_edits import inputs_of_set_const

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
#: Extras for work on amhe itself.
OURS = {"dev", "bench"}
TABLE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8").split("## What is installed")[1]
ROWS = dict(re.findall(r"^\| `?(\w+)`? \| (`.*) \|$", TABLE.split("\n## ")[0], re.M))
LICENCES = {extra: dict(re.findall(r"`([\w-]+)` ([\w.-]+)", row)) for extra, row in ROWS.items()}
#: Packages whose metadata states no licence; it is in a file of their wheel.
SILENT = {"motioncapture": "MIT License"}


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[^\w.-]", text)[0] for text in requirements}


def test_no_file_of_the_repository_is_large() -> None:
    git = ["git", "ls-files", "-z"]
    listed = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False).stdout.split("\0")
    files = [ROOT / name for name in listed if name]
    assert [f"{path}" for path in files if path.is_file() and path.stat().st_size > 2**20] == []


def test_every_package_of_every_extra_is_in_the_table() -> None:
    wanted = {"none": names(PROJECT["dependencies"])}
    wanted |= {
        extra: names(some) for extra, some in PROJECT["optional-dependencies"].items() if extra not in OURS
    }
    assert {extra: set(found) for extra, found in LICENCES.items()} == wanted


@pytest.mark.parametrize("package", [name for some in LICENCES.values() for name in some])
def test_the_package_says_the_same(package: str) -> None:
    try:
        said = metadata(package)
    except PackageNotFoundError:
        pytest.skip(f"{package} is not installed")
    (licence,) = {found[package] for found in LICENCES.values() if package in found}
    classifiers = [text for text in said.get_all("Classifier") or [] if text.startswith("License")]
    text = " ".join([said.get("License-Expression") or "", (said.get("License") or "")[:100], *classifiers])
    if package in SILENT:
        files = [path.read_text() for path in _files(package)]
        assert any(SILENT[package] in file for file in files)
        return
    assert {"PSF": "Python Software Foundation"}.get(licence, licence) in text
    assert not re.search(r"\bL?GPL", text)


def _files(package: str) -> list[Path]:
    from importlib.metadata import files

    return [Path(str(one.locate())) for one in files(package) or () if "LICENSE" in one.name.upper()]


#: What pyproject.toml asks for, in all extras.
REQUIREMENTS = [*PROJECT["dependencies"], *chain(*PROJECT["optional-dependencies"].values())]


def test_mujoco_lists_the_inputs_of_its_derived_constants() -> None:
    known = {"body_mass", "body_inertia", "body_ipos", "dof_armature", "qpos0"}
    assert known <= inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"
    assert "pair_friction" not in inputs_of_set_const(), f"broken by mujoco {version('mujoco')}"


def test_a_mujoco_without_that_list_is_refused_in_one_line(monkeypatch) -> None:
    monkeypatch.delattr(mujoco.MjModel, "_setconst_inputs")
    with pytest.raises(AmheError, match=r"mujoco 4\S* lists no inputs of mj_setConst; install"):
        inputs_of_set_const()


def test_a_cmaes_optimizer_with_the_memory_of_another_continues_as_that_one() -> None:
    one, other = (cmaes.CMA(mean=np.ones(3), sigma=0.5, seed=3, population_size=6) for _ in range(2))
    for _ in range(4):
        samples = [one.ask() for _ in range(6)]
        one.tell([(x, float((x - [1.0, 2.0, 3.0]) @ (x - [0.0, 1.0, 9.0]))) for x in samples])
    try:
        restore(other, memory_of(one))
    except AttributeError as error:
        pytest.fail(f"broken by cmaes {version('cmaes')}: {error}")
    for optimizer in (one, other):  # as the search does for each generation
        optimizer.reseed_rng(7)
    for _ in range(3):
        samples = [one.ask() for _ in range(6)]
        same = np.array_equal(samples, [other.ask() for _ in range(6)])
        assert same, f"broken by cmaes {version('cmaes')}: its state has more than MEMORY"
        for optimizer in (one, other):
            optimizer.tell([(x, float(x @ x)) for x in samples])


def test_natnet_makes_its_sockets_where_we_replace_them() -> None:
    natnet = pytest.importorskip("natnet")
    create = getattr(natnet.NatNetClient, "_NatNetClient__create_socket", None)
    assert create is not None, f"broken by natnet {version('natnet')}"
    assert list(inspect.signature(create).parameters) == ["addr", "port"], f"natnet {version('natnet')}"


def test_a_natnet_that_makes_its_sockets_elsewhere_is_refused() -> None:
    with pytest.raises(PoseError, match="install natnet 0.3"):
        _listening_to("127.0.0.1", type("NatNetClient", (), {}))


@pytest.mark.parametrize("package", ["cmaes", "mujoco", "natnet"])
def test_a_package_whose_private_attributes_we_use_has_an_upper_bound(package: str) -> None:
    (wanted,) = {text for text in REQUIREMENTS if re.match(rf"{package}\b(?!-)", text) and "[" not in text}
    assert re.search(r"<\d", wanted), f"{wanted}: a later version may lack them"


FORMS = sorted(path.stem for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def parsed(*parts: str) -> dict:
    return yaml.safe_load(ROOT.joinpath(*parts).read_text(encoding="utf-8"))


def test_the_citation_is_of_this_version_and_names_the_paper() -> None:
    citation = parsed("CITATION.cff")
    assert (str(citation["version"]), citation["license"]) == (__version__, PROJECT["license"])
    assert [author["family-names"] for author in citation["references"][0]["authors"]] == [
        "Keshavarz", "Ramirez-Serrano", "Khadiv"
    ]  # fmt: skip


def test_the_workflow_tests_from_the_lowest_python_on_and_runs_targets_that_exist() -> None:
    jobs = parsed(".github", "workflows", "ci.yml")["jobs"]
    assert f">={jobs['test']['strategy']['matrix']['python'][0]}" == PROJECT["requires-python"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    targets = {command.removeprefix("make ") for command in commands if command.startswith("make ")}
    assert targets == {"lint", "test", "test-lowest"}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert all(f"\n{target}: " in makefile for target in targets)


@pytest.mark.parametrize("form", [name for name in FORMS if name != "config"])
def test_an_issue_form_has_what_the_host_asks_for(form: str) -> None:
    content = parsed(".github", "ISSUE_TEMPLATE", f"{form}.yml")
    assert {"name", "description", "body"} <= set(content)
    ids = [field["id"] for field in content["body"]]
    assert len(ids) == len(set(ids))
    assert all(field["attributes"]["label"] for field in content["body"])
