"""A YAML file within its limits costs seconds, not half a minute."""

import time
from pathlib import Path

import pytest
import yaml

from amhe_cli import System
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.yaml_file import YamlFile


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="this PyYAML has no parser in C")
@pytest.mark.parametrize(
    "text",
    ['a: "' + "\n" * (4 * 2**20 - 10) + '"\n', "".join(f"k{i}: {i}\n" for i in range(70_000))],
    ids=["newlines", "keys"],
)
def test_the_largest_files_are_read_in_seconds(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    begun = time.process_time()
    YamlFile(tmp_path / "a.yaml")
    assert time.process_time() - begun < 10.0


def test_a_file_of_mistakes_is_refused_in_seconds(tmp_path: Path) -> None:
    """Of 70,000 unknown keys the first hundred mistakes are listed, and the rest is counted."""
    (tmp_path / "system.yaml").write_text("".join(f"k{i}: {i}\n" for i in range(70_000)))
    begun = time.process_time()
    with pytest.raises(ConfigError) as refusal:
        System.load(tmp_path)
    assert time.process_time() - begun < 20.0
    lines = str(refusal.value).splitlines()
    assert len(lines) == 101
    assert lines[3] == (
        f"{tmp_path}/system.yaml:1:1: no key 'k0'; there is: "
        "boxes, keyframe, match, model, parameters, robot, settings, signals, unknowns"
    )
    assert lines[-1] == f"{tmp_path}/system.yaml: 69903 more mistakes"
