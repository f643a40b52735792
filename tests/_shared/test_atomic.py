from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from deepdetect._shared import atomic
from deepdetect._shared.atomic import atomic_path, private_folder
from deepdetect._shared.errors import DeepDetectError


class BlockFailed(Exception):
    pass


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_and_fail(target: Path, error: type[BaseException] | BaseException) -> None:
    with atomic_path(target) as temporary:
        temporary.write_text("half")
        raise error


def test_a_whole_file_appears(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folders" / "out.txt"
    with atomic_path(str(target)) as temporary:
        assert temporary.parent == target.parent
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert names(target.parent) == ["out.txt"]


@pytest.mark.parametrize("name", ["out.png", "out.tar.gz", "out", ".hidden", 251 * "o" + ".npz"])
def test_the_temporary_name_keeps_the_suffix(name: str, tmp_path: Path) -> None:
    with atomic_path(tmp_path / name) as temporary:
        assert temporary.suffix in (Path(name).suffix, ".part")
        assert temporary.name.endswith(Path(name).suffix)
        assert temporary.name.startswith(".")
        assert temporary.name != name
    assert names(tmp_path) == [name]


def test_a_full_disk_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(DeepDetectError) as caught:
        write_and_fail(tmp_path / "out.txt", OSError(errno.ENOSPC, "No space left on device"))
    assert str(tmp_path / "out.txt") in str(caught.value)
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


@pytest.mark.parametrize("error", [BlockFailed, KeyboardInterrupt])
def test_an_old_file_survives_a_failure(error: type[BaseException], tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(error):
        write_and_fail(target, error)
    assert target.read_text() == "old"
    assert names(tmp_path) == ["out.txt"]


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    with atomic_path(target) as first, atomic_path(target) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # the outer block ends last
    assert names(tmp_path) == ["out.txt"]


def test_the_mode_is_that_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_path(tmp_path / "out") as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_an_unwritable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(DeepDetectError), atomic_path(tmp_path / "out.txt"):
        pass


def start_writer(folder: Path) -> subprocess.Popen[str]:
    """Start a process that writes a file and does not end."""
    code = (
        "import sys, time\n"
        "from deepdetect._shared.atomic import atomic_path\n"
        "with atomic_path(sys.argv[1]):\n"
        "    print('writing', flush=True)\n"
        "    time.sleep(600)\n"
    )
    writer = subprocess.Popen(
        [sys.executable, "-c", code, str(folder / "out.npz")], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    assert writer.stdout.readline() == "writing\n"
    return writer


@pytest.mark.skipif(os.name != "posix", reason="elsewhere only the age tells")
def test_what_a_killed_process_left_is_removed_and_what_a_live_one_writes_is_not(
    tmp_path: Path,
) -> None:
    living, killed = start_writer(tmp_path), start_writer(tmp_path)
    try:
        killed.send_signal(signal.SIGKILL)
        if sys.platform == "linux":  # nobody waits for it, as in a container without an init
            os.waitid(os.P_PID, killed.pid, os.WEXITED | os.WNOWAIT)
        else:
            killed.wait()
        assert len(names(tmp_path)) == 2
        with atomic_path(tmp_path / "other.txt") as temporary:
            temporary.write_text("whole")
        kept, other = names(tmp_path)
        assert other == "other.txt"
        assert f"-{living.pid}-" in kept
    finally:
        for process in (living, killed):
            process.kill()
            process.wait()
            process.communicate()


@pytest.mark.parametrize(("age_s", "stays"), [(3600.0, True), (2 * atomic.ABANDONED_S, False)])
def test_files_of_another_machine_are_removed_after_a_day(
    tmp_path: Path, age_s: float, stays: bool
) -> None:
    foreign = tmp_path / ".out.00000000-1-0123abcd.part.npz"
    users = tmp_path / ".out.part.npz"
    for path in (foreign, users):
        path.touch()
        os.utime(path, (path.stat().st_mtime - age_s,) * 2)
    with atomic_path(tmp_path / "new"):
        pass
    assert foreign.exists() == stays
    assert users.exists()


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_private_folder_is_for_its_user_only(temporary: Path) -> None:
    folder = private_folder("example-")
    assert folder.parent == temporary
    assert folder.stat().st_mode & 0o777 == 0o700
    assert private_folder("example-") != folder
    assert folder.is_dir()  # its process is at work


def test_folders_of_processes_that_ended_are_removed(temporary: Path) -> None:
    code = "from deepdetect._shared.atomic import private_folder as f; print(f('example-'))"
    environment = {**os.environ, "TMPDIR": str(temporary)}
    words = [sys.executable, "-c", code]
    left = Path(subprocess.check_output(words, text=True, env=environment).strip())
    (left / "photograph.jpg").write_bytes(b"x")
    other = temporary / "example-x" / "y"
    other.mkdir(parents=True)
    named_alike = temporary / left.name.replace("example", "sample")
    named_alike.mkdir()
    link = temporary / f"{left.name[:-8]}00000000"
    link.symlink_to(other, target_is_directory=True)
    assert private_folder("example-").is_dir()
    assert not left.exists()
    assert other.is_dir()
    assert named_alike.is_dir()
    assert link.is_symlink()
