"""The licences in docs/security.md: every package that is installed, and what each says itself."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest

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
