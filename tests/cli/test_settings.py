"""Settings from options, environment and files."""

from __future__ import annotations

from pathlib import Path

import pytest

from amhe_cli.cli.settings import from_environment, from_file, merged, parse_set
from amhe_cli.core.errors import ConfigError


def test_options_are_nested_and_typed() -> None:
    options = [
        "clips.count=8",
        "clips.length=[0.3, 1e-1]",
        "logs.align=true",
        "signals.cube.topic=/x",
        "clips.count=9",
    ]
    assert parse_set(options) == {
        "clips": {"count": 9, "length": [0.3, 0.1]},
        "logs": {"align": True},
        "signals": {"cube": {"topic": "/x"}},
    }


@pytest.mark.parametrize("option", ["clips.count", "=3", ".a=3", "a..b=3"])
def test_what_is_no_assignment_is_refused(option: str) -> None:
    with pytest.raises(ConfigError, match="write KEY=VALUE"):
        parse_set([option])


def test_a_value_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(ConfigError, match="is not a value"):
        parse_set(["clips.length=[1, 2"])


def test_environment_variables_have_two_underscores_between_levels() -> None:
    environment = {
        "AMHE_CLIPS__HELD_OUT_LENGTH": "0.4",
        "AMHE_PARAMETERS__load_mass__NOMINAL": "2",
        "AMHE_PARAMETERS__MASS__NOMINAL": "3",
        "AMHE_THREADS": "4",
        "HOME": "/home",
    }
    assert from_environment(environment) == {
        "clips": {"held_out_length": 0.4},
        "parameters": {"load_mass": {"nominal": 2}, "mass": {"nominal": 3}},
    }


def test_a_file_is_read_with_the_same_care(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("clips: {count: 3}\n")
    assert from_file(path) == {"clips": {"count": 3}}
    path.write_text("clips: {count: 3, count: 4}\n")
    with pytest.raises(ConfigError, match="here twice"):
        from_file(path)


def test_the_stronger_source_wins_key_by_key() -> None:
    weak, strong = {"a": {"b": 1, "c": 2}}, {"a": {"b": 3}}
    assert merged(weak, strong) == {"a": {"b": 3, "c": 2}}
    assert weak == {"a": {"b": 1, "c": 2}}
