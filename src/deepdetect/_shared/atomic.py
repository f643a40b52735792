"""Atomic writing of files under temporary names, and folders for temporary files."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from .errors import DeepDetectError

ABANDONED_S, STEM_LENGTH = 24 * 3600.0, 40
"""Temporary files made by other machines are removed at an age of ABANDONED_S seconds. Temporary
names contain up to STEM_LENGTH characters of the final name, to stay short. Chosen by hand."""

# This part of a temporary name identifies its writer: machine, process and a random number.
_OWNER = re.compile(r"(?P<machine>[0-9a-f]{8})-(?P<process>\d+)-[0-9a-f]{8}")

# A temporary name has the stem of the final name, `_OWNER`, "part" and the final suffix.
_TEMPORARY = re.compile(rf"\..*\.{_OWNER.pattern}\.part(\..*)?")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path with the same suffix; rename it to `path` if the block succeeds.

    Missing folders are created. Temporary files that killed processes left there are removed.

    Raises:
        DeepDetectError: the file cannot be written.
    """
    final = Path(path)
    temporary = final.with_name(f".{final.stem[:STEM_LENGTH]}.{_owner()}.part{final.suffix}")
    try:
        _clear(final.parent.absolute())
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)  # at once, because others may remove the folder as empty
        yield temporary
        temporary.replace(final)
    except DeepDetectError:  # MissingFileError is also an OSError
        raise
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): free space, or choose another place"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write bytes, or text in UTF-8, to a file as `atomic_path` does."""
    with atomic_path(path) as temporary:
        if isinstance(content, str):
            temporary.write_text(content, encoding="utf-8")
        else:
            temporary.write_bytes(content)


def private_folder(prefix: str) -> Path:
    """Make a temporary folder that only this user can read; the caller removes it.

    Older folders with the same prefix are removed if the processes that made them have ended.

    Raises:
        DeepDetectError: no folder for temporary files is writable.
    """
    try:
        parent = Path(tempfile.gettempdir())
        for path in _abandoned(parent, re.compile(re.escape(prefix) + _OWNER.pattern)):
            shutil.rmtree(path, ignore_errors=True)  # removes no links or other users' folders
        folder = parent / f"{prefix}{_owner()}"
        folder.mkdir(mode=0o700)
    except OSError as error:
        raise DeepDetectError(
            f"cannot make a temporary folder ({error.strerror or error}): "
            "free some space, or set TMPDIR to a writable folder"
        ) from error
    return folder


@lru_cache
def _clear(folder: Path) -> None:
    """Remove abandoned temporary files from a folder, once per process."""
    for path in _abandoned(folder, _TEMPORARY):
        with contextlib.suppress(OSError):
            path.unlink()


def _abandoned(folder: Path, names: re.Pattern[str]) -> list[Path]:
    """List the paths in a folder that match `names` and were made by a process that has ended."""
    # `glob` finds nothing in a folder that is missing or cannot be listed.
    matches = [(path, names.fullmatch(path.name)) for path in folder.glob("*")]
    return [path for path, match in matches if match and _has_ended(path, **match.groupdict())]


def _has_ended(path: Path, machine: str, process: str) -> bool:
    """Return whether the process that made a file or folder has ended.

    A process on another machine, or on Windows, cannot be checked. Such a process counts as ended
    if its file is older than `ABANDONED_S` seconds.
    """
    try:
        if machine != _machine() or os.name != "posix":
            return time.time() - path.lstat().st_mtime > ABANDONED_S
        os.kill(int(process), 0)  # signal 0 only checks that the process exists
        # In a container without init, workers of a killed process remain as zombies (state Z).
        state = Path(f"/proc/{process}/stat")
        return state.is_file() and state.read_text().rpartition(")")[2].split()[0] == "Z"
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):  # the process is another user's, or the file is gone
        return False


def _owner() -> str:
    return f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


@lru_cache
def _machine() -> str:
    """Return a digest of the machine's boot and container, in which process numbers are unique."""
    parts = [platform.node()]
    with contextlib.suppress(OSError):  # Linux only
        parts += [Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")]
        parts += [os.readlink("/proc/self/ns/pid")]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:8]
