"""A YAML file within its limits costs seconds, not half a minute."""

import time
from pathlib import Path

import pytest
import yaml

from amhe_cli.core.yaml_file import YamlFile


@pytest.mark.skipif(not yaml.__with_libyaml__, reason="this PyYAML has no parser in C")
@pytest.mark.parametrize(
    "text",
    ['a: "' + "\n" * (4 * 2**20 - 10) + '"\n', "".join(f"k{i}: {i}\n" for i in range(140_000))],
    ids=["newlines", "keys"],
)
def test_the_largest_files_are_read_in_seconds(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    begun = time.process_time()
    YamlFile(tmp_path / "a.yaml")
    assert time.process_time() - begun < 10.0
