import os
from pathlib import Path

import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import abandoned, filling
from amhe_cli.report.folder import reserve


def test_the_default_folder_is_fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = reserve(None, "identify", force=False)
    assert first.parent.name == "amhe-out"
    assert first.name.startswith("identify-")
    first.mkdir(parents=True)
    second = reserve(None, "identify", force=False)
    assert second != first
    assert not second.exists()


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    assert reserve(tmp_path, "identify", force=False) == tmp_path
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match="`force=True`"):
        reserve(tmp_path, "identify", force=False)
    assert reserve(tmp_path, "identify", force=True) == tmp_path
    with pytest.raises(ConfigError, match="is a file"):
        reserve(tmp_path / "mine.txt", "identify", force=True)
    with pytest.raises(ConfigError, match="cannot be written"):
        reserve(tmp_path / "mine.txt" / "out", "identify", force=False)


def test_a_new_folder_appears_whole(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with filling(out) as scratch:
        (scratch / "a").write_text("1")
        assert not out.exists()
    assert [p.name for p in out.parent.iterdir()] == ["out"]
    assert (out / "a").read_text() == "1"


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ZeroDivisionError), filling(out) as scratch:
        (scratch / "a").write_text("1")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_force_replaces_our_files_and_leaves_others(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")
    (tmp_path / "mine").write_text("stays")
    with filling(tmp_path) as scratch:
        (scratch / "a").write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    assert (tmp_path / "mine").read_text() == "stays"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that takes no files")
def test_a_file_system_that_takes_no_files_is_refused_before_any_work() -> None:
    with pytest.raises(ConfigError, match=r"/proc/amhe/out: cannot be written \(.+\); choose another `out`"):
        reserve(Path("/proc/amhe/out"), "identify", force=False)


def test_reserving_leaves_nothing_behind(tmp_path: Path) -> None:
    reserve(tmp_path / "deep" / "out", "identify", force=False)
    assert list(tmp_path.iterdir()) == []


def test_files_do_not_leave_the_file_system_of_an_existing_folder(tmp_path: Path) -> None:
    """It may be mounted: a rename from beside it would fail."""
    with filling(tmp_path / "out") as beside:
        assert beside.parent == tmp_path
    with filling(tmp_path / "out") as inside:
        assert inside.parent == tmp_path / "out"
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("name", ["out", "out [1]"])
def test_what_a_killed_command_left_is_named(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out, left = tmp_path / name, tmp_path / f".{name}.99999999-0123abcd.partial"
    left.mkdir()
    (left / ".log.mcap.99999999.partial").touch()
    (tmp_path / f".{name}.{os.getppid()}-0123abcd.partial").mkdir()  # of one that runs
    (tmp_path / ".other.99999999-0123abcd.partial").mkdir()
    reserve(out, "run", force=False)
    (warning,) = caplog.messages
    assert warning == (
        f"{left} is what an earlier command wrote before it was killed; "
        f"`amhe inspect {left / '.log.mcap.99999999.partial'}` reads the log in it"
    )


def test_a_folder_that_is_cut_off_by_a_full_disk_is_kept_where_that_is_wanted(tmp_path: Path) -> None:
    for keep in (False, True):
        out = tmp_path / str(keep)
        with pytest.raises(OSError) as raised, filling(out, keep) as scratch:
            (scratch / "log").write_text("1")
            raise OSError(28, "No space left on device", str(scratch / "log"))
        assert out.exists() == keep
    assert [path.name for path in tmp_path.iterdir()] == ["True"]
    assert raised.value.filename == str(out / "log")


def test_what_was_left_in_the_current_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    left = tmp_path / f".{tmp_path.name}.99999999-0123abcd.partial"
    left.mkdir()
    assert abandoned(Path()) == [left]
