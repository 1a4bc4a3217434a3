"""Files for the host of the project: they parse, and they say the same as the package."""

import tomllib
from pathlib import Path

import pytest
import yaml

from amhe_cli import __version__

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
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
