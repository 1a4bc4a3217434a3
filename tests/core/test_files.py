"""Files that are written whole, and YAML that cannot cost more than it is worth."""

import errno
import os
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from amhe_cli import System
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import check_regular, filling, plain, whole, write_whole
from amhe_cli.core.yaml_file import YamlFile, dumped, flow, scalar


def test_a_file_that_fails_half_way_leaves_the_old_one_and_no_scratch(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_whole(path, "old")
    with pytest.raises(ZeroDivisionError), whole(path) as file:
        file.write(b"ne")
        assert path.read_text() == "old"
        raise ZeroDivisionError
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("result.json", "old")]


def test_a_file_is_readable_by_whom_the_user_lets_read(tmp_path: Path) -> None:
    umask = os.umask(0o027)
    try:
        write_whole(tmp_path / "result.json", "ü")
    finally:
        os.umask(umask)
    assert (tmp_path / "result.json").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "result.json").read_bytes() == "ü".encode()


def test_plain_values_have_no_number_that_json_lacks() -> None:
    value = {"a": np.array([1.0, np.nan]), 2: (np.float64(np.inf), np.int64(3)), "b": {"c": np.bool_(True)}}
    assert plain(value) == {"a": [1.0, None], "2": [None, 3], "b": {"c": True}}


def test_a_file_that_cannot_be_opened_is_named_and_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, mode: str) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    for keep in (False, True):
        with pytest.raises(PermissionError) as error, whole(tmp_path / "log.mcap", keep):
            pass
        assert error.value.filename == str(tmp_path / "log.mcap")


def test_results_of_another_command_are_not_written_over(tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = pytest.raises(AmheError, match=r"out: another command .* these results are in .*out-2$")
    with said, filling(out, force=False) as scratch:
        (scratch / "result.json").write_text("second")
        with filling(out, force=False) as other:
            (other / "result.json").write_text("first")
    assert (out / "result.json").read_text() == "first"
    assert (tmp_path / "out-2" / "result.json").read_text() == "second"
    assert {path.name for path in tmp_path.iterdir()} == {"out", "out-2"}
    with filling(out) as scratch:
        (scratch / "result.json").write_text("third")
    assert (out / "result.json").read_text() == "third"


def test_a_full_disk_is_said_of_what_is_written(tmp_path: Path) -> None:
    with pytest.raises(OSError) as error, filling(tmp_path / "out"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert error.value.filename == str(tmp_path / "out")


def test_a_name_that_no_file_can_have_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"^9{40} \.\.\.: File name too long; give another name$"):
        check_regular(Path("9" * 400))


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


@pytest.mark.parametrize(
    "text", ["056015197467", "5601e5197467", "1e5", "yes", "null", "0x1f", "12.5", "a: b"]
)
def test_a_word_that_looks_like_a_number_is_a_word_when_it_is_read_again(text: str) -> None:
    value = {"hash": text, "number": 0.1, "count": 12, "none": None, "yes": True}
    assert scalar(dumped(value)) == value
    assert scalar(flow(value)) == value
