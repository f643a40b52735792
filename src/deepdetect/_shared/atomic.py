"""Files that appear whole under their final name, or not at all; folders for temporary files."""

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
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from .errors import DeepDetectError

ABANDONED_S = 24 * 3600.0
"""Age from which a temporary file of another machine is taken for that of a process that died."""

STEM_LENGTH = 40
"""Characters of the final name in a temporary one, which must not become too long."""

FOLDER_TRIES = 5
"""How often a folder is made again that another process removes."""

# Machine, process and a random number.
_OWNER = re.compile(r"(?P<machine>[0-9a-f]{8})-(?P<process>\d+)-[0-9a-f]{8}")

# Stem, owner, "part" and the suffix of the final file.
_TEMPORARY = re.compile(rf"\..*\.{_OWNER.pattern}\.part(\..*)?")

_HOST_FILES = (Path("/proc/sys/kernel/random/boot_id"), Path("/etc/machine-id"))

_cleared: set[Path] = set()
"""Folders in which this process has looked for what others left behind."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside the final one, which is renamed when the block succeeds.

    The first time in a folder, temporary files of processes that were killed are removed.

    Args:
        path: the final path. Missing folders are created. The temporary name keeps the suffix,
            by which many writers choose the format.

    Yields:
        The temporary path, which the block writes.

    Raises:
        DeepDetectError: the file cannot be written (no permission, no space, not a folder).

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "out.txt"
        >>> with atomic_path(target) as temporary:
        ...     _ = temporary.write_text("whole")
        >>> target.read_text()
        'whole'
    """
    final = Path(path)
    temporary: Path | None = None
    try:
        folder = final.parent.absolute()
        if folder not in _cleared:
            _cleared.add(folder)
            for entry in _abandoned(folder, _TEMPORARY):
                with contextlib.suppress(OSError):
                    os.unlink(entry)
        owner = _owner()
        name = final.with_name(f".{final.stem[:STEM_LENGTH]}.{owner}.part{final.suffix}")
        _make_private(name)
        temporary = name
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(final)
    except DeepDetectError:  # of a missing file, which is an OSError
        raise
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): "
            "free some space, or choose another place"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _make_private(path: Path) -> None:
    """Make an empty file, which nobody else reads while it is not whole, and its folder."""
    for left in reversed(range(FOLDER_TRIES)):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
            return
        except FileNotFoundError:  # a command that failed has just removed its empty folders
            if not left:
                raise


def private_folder(prefix: str) -> Path:
    """Make a folder for temporary files, which only this user can read.

    Folders of the same prefix whose processes have ended are removed first.

    Args:
        prefix: how the folder's name begins.

    Returns:
        A new folder in the system's folder for temporary files. Who asks for it removes it.

    Raises:
        DeepDetectError: there is no folder for temporary files that can be written.

    Example:
        >>> folder = private_folder("example-")
        >>> folder.name.startswith("example-")
        True
        >>> folder.rmdir()
    """
    try:
        parent = Path(tempfile.gettempdir())
        for entry in _abandoned(parent, re.compile(re.escape(prefix) + _OWNER.pattern)):
            if _is_own_folder(entry):
                shutil.rmtree(entry, ignore_errors=True)
        folder = parent / f"{prefix}{_owner()}"
        folder.mkdir(mode=0o700)
    except OSError as error:
        raise DeepDetectError(
            f"cannot make a temporary folder ({error.strerror or error}): "
            "free some space, or set TMPDIR to a folder that can be written"
        ) from error
    return folder


def _abandoned(folder: Path, names: re.Pattern[str]) -> list[os.DirEntry[str]]:
    """List what processes that have ended have left in a folder, by the names of it.

    Whether a process of another machine, or of another container, has ended is not known: its
    files count as left when they are a day old.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        matches = [(entry, names.fullmatch(entry.name)) for entry in entries]
        return [
            entry
            for entry, match in matches
            if match and _is_abandoned(entry, match["machine"], int(match["process"]))
        ]
    return []


def _is_own_folder(entry: os.DirEntry[str]) -> bool:
    """Return whether it is a folder of this user: others write to the same parent."""
    try:
        own = not hasattr(os, "getuid") or entry.stat(follow_symlinks=False).st_uid == os.getuid()
        return own and entry.is_dir(follow_symlinks=False)
    except OSError:
        return False


def _owner() -> str:
    """Return the part of a temporary name that says which process it is of; new each time."""
    return f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


def _is_abandoned(entry: os.DirEntry[str], machine: str, process: int) -> bool:
    if machine == _machine() and os.name == "posix":
        try:
            os.kill(process, 0)  # only asks
        except ProcessLookupError:
            return True
        except (OSError, OverflowError):  # another user's
            return False
        return False
    try:
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > ABANDONED_S
    except OSError:
        return False


@lru_cache(maxsize=1)
def _machine() -> str:
    """Return a digest of what the numbers of processes are unique in."""
    try:
        namespace = os.readlink("/proc/self/ns/pid")  # containers may share a name and a folder
    except OSError:
        namespace = ""
    # Machines that share a folder may share a name, and their first namespaces have one number.
    owner = f"{platform.node()} {_host()} {namespace}"
    return hashlib.sha256(owner.encode()).hexdigest()[:8]


def _host() -> str:
    """Return what tells this machine from others of its name."""
    for path in _HOST_FILES:
        with contextlib.suppress(OSError, ValueError):
            if text := path.read_text(encoding="ascii").strip():
                return text
    return str(uuid.getnode())


@lru_cache(maxsize=1)
def _umask() -> int:
    """Return the mode bits that new files lack: temporary files are private."""
    umask = os.umask(0o077)  # it can only be read by setting it
    os.umask(umask)
    return umask
