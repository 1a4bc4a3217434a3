"""A YAML file within its limits costs seconds, not half a minute."""

import time
from pathlib import Path

import pytest
import yaml

from amhe_cli import System
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.yaml_file import YamlFile


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="this PyYAML has no parser in C")
def test_the_largest_file_is_read_in_seconds(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text('a: "' + "\n" * (4 * 2**20 - 10) + '"\n')
    begun = time.process_time()
    YamlFile(tmp_path / "a.yaml")
    assert time.process_time() - begun < 10.0


@pytest.mark.medium
def test_a_file_of_mistakes_is_refused_in_seconds(tmp_path: Path) -> None:
    """Of 64,000 mistakes the first hundred are listed, and none of the others is put into words."""
    path = tmp_path / "system.yaml"
    path.write_text("".join(f"k{i}: {i}\n" for i in range(64_000)))
    begun = time.process_time()
    with pytest.raises(ConfigError) as refusal:
        System.load(tmp_path)
    assert time.process_time() - begun < 10.0
    *lines, last = str(refusal.value).splitlines()
    assert len(lines) == 100
    assert last == f"{path}: there are more mistakes"
    assert lines[0].startswith(f"{path}:1:1: no key 'k0'; there is: boxes,")
