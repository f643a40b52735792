"""HDF5 files that many processes fill, and that survive being killed.

HDF5 has one writer, and a file whose writer is killed may be lost. So each task writes a small
file of its own, a part, under a temporary name that becomes final when the part is whole. At the
end one process merges the parts into a copy of the file, which takes the file's place when it is
whole, and removes them. Whatever is killed, what is in parts or in the file stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import (
    DeepDetectError,
    InvalidFileError,
    MissingExtraError,
    MissingFileError,
    OptionError,
)
from .._shared.progress import progress

SETTINGS = "deepdetect"
"""Attribute of the file: what its content depends on besides the inputs, as JSON."""

STATE = "source_state"
"""Attribute of a group: whole numbers that change when its input does."""

FORMAT = ("v110", "v110")
"""Of the files: read by HDF5 1.10 (2016) and later; groups of a million members stay fast."""

SETTINGS_FILE = "settings.json"
LOCK_FILE = "lock"


@dataclass(frozen=True)
class Group:
    """A group of an HDF5 file.

    Attributes:
        name: its path in the file.
        arrays: its datasets by name.
        state: of its input.
        attributes: of datasets, by the name of the dataset.
    """

    name: str
    arrays: Mapping[str, np.ndarray]
    state: tuple[int, ...] = ()
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def import_h5py() -> Any:
    """Import h5py.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise MissingExtraError(
            "files of features and matches need h5py: run pip install h5py"
        ) from None
    return h5py


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file to read it.

    Raises:
        DeepDetectError: it is missing or damaged, which may be found while it is read.
        MissingExtraError: h5py is not installed.
    """
    h5py = import_h5py()
    if path.is_dir():
        raise InvalidFileError(f"{path} is a folder: name a file of features or matches")
    if not path.is_file():
        raise MissingFileError(f"there is no file {path}: check the path")
    try:
        # Nobody writes to a file under its final name, and network folders may know no locks.
        file = h5py.File(path, "r", locking=False)
    except OSError as error:
        raise DeepDetectError(
            f"{path} is no HDF5 file, or is damaged ({str(error).splitlines()[0]}): write it again"
        ) from error
    with file:
        try:
            yield file
        except DeepDetectError:
            raise
        except (OSError, RuntimeError, KeyError) as error:  # what h5py raises, by what is damaged
            raise damaged(path, error) from error


def damaged(path: Path, error: Exception) -> InvalidFileError:
    """Return the error of a file, or of a part of it, that cannot be read."""
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return InvalidFileError(f"{path} is damaged ({reason}): write it again")


@contextmanager
def _written(path: Path, mode: str) -> Iterator[Any]:
    """Open a temporary file to write it; what the system refuses is an OSError with its number."""
    h5py = import_h5py()
    try:
        with h5py.File(path, mode, libver=FORMAT) as file:
            yield file
    except (OSError, RuntimeError) as error:  # HDF5 raises both, with pages of text
        number = re.search(r"errno = (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def write_groups(path: Path, groups: Iterable[Group]) -> int:
    """Write a file of groups, whole or not at all; return how many there are.

    They are written one by one: an iterator needs the memory of one. Without any there is no file.

    Raises:
        DeepDetectError: it cannot be written.
    """
    import_h5py()
    count = 0
    with _unless_empty(), atomic_path(path) as temporary:
        with _written(temporary, "w") as file:
            for group in groups:
                _write_group(file, group)
                count += 1
        if not count:
            raise _Empty
    return count


class _Empty(Exception):
    """There is nothing to be written."""


@contextmanager
def _unless_empty() -> Iterator[None]:
    with contextlib.suppress(_Empty):
        yield


def _write_group(file: Any, group: Group) -> None:
    made = file.create_group(group.name)
    made.attrs[STATE] = np.array(group.state, np.int64)
    for name, array in group.arrays.items():
        dataset = made.create_dataset(name, data=array)
        dataset.attrs.update(group.attributes.get(name, {}))


def state_of(group: Any) -> tuple[int, ...]:
    """Return the state of a group's input; empty where another program has written it."""
    return tuple(int(number) for number in group.attrs.get(STATE, ()))


class PartedFile:
    """An HDF5 file, and the folder of parts that will be merged into it.

    Args:
        path: the file; the parts are in PATH.parts beside it.
        settings: all that the content depends on besides the inputs, as JSON would give it back.
        overwrite: replace the file; parts made with the same settings are those of an attempt to
            do so, and stay.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], overwrite: bool = False) -> None:
        self.path = path
        self.parts = path.with_name(path.name + ".parts")
        self.settings = json.loads(json.dumps(settings, default=str))
        self.overwrite = overwrite
        self._in_parts: dict[str, tuple[int, ...]] = {}

    @contextmanager
    def opened(self) -> Iterator[PartedFile]:
        """Hold the file for this process: read which parts there are.

        Raises:
            OptionError: the file or its parts were made with other settings, by another program,
                or are being made by another process.
            DeepDetectError: the folder cannot be written, or the file is damaged.
        """
        import_h5py()
        if self.path.is_dir():
            raise OptionError(f"{self.path} is a folder: name a file in it with -o")
        if self.path.exists() and not self.overwrite:
            with open_hdf5(self.path) as file:
                self._check(self.path, file.attrs.get(SETTINGS))
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DeepDetectError(
                f"cannot write {self.parts} ({error.strerror}): choose another place with -o"
            ) from error
        with _locked(self.parts / LOCK_FILE, self.path):
            noted = self.parts / SETTINGS_FILE
            before = noted.read_text(encoding="utf-8") if noted.exists() else None
            if self.overwrite and self._differences(before) != []:
                for part in self._part_files():
                    part.unlink(missing_ok=True)
            if before is not None and self._part_files():
                self._check(self.parts, before)
            else:
                with atomic_path(noted) as temporary:
                    temporary.write_text(json.dumps(self.settings), encoding="utf-8")
            self._in_parts = {}
            for part in self._part_files():
                with open_hdf5(part) as file:
                    for name, group in _leaves(file):
                        self._in_parts[name] = state_of(group)
            yield self

    def done(self, wanted: Iterable[tuple[str, tuple[int, ...]]]) -> set[str]:
        """Return which of the names are in the file or in parts with these states."""
        wanted = list(wanted)
        found = {name for name, state in wanted if self._in_parts.get(name) == state}
        if not self.overwrite and self.path.exists():
            with open_hdf5(self.path) as file:
                for name, state in wanted:
                    if name not in found and name in file and state_of(file[name]) == state:
                        found.add(name)
        return found

    def part(self, names: Sequence[str]) -> Path:
        """Return the file for the part with these groups: the same names give the same file."""
        digest = hashlib.sha256("\n".join(names).encode("utf-8", "surrogateescape")).hexdigest()
        return self.parts / f"{digest[:32]}.h5"

    def merge(
        self,
        quiet: bool = True,
        names: Collection[str] | None = None,
        gone: Collection[str] = (),
    ) -> None:
        """Merge all parts into the file, and remove them.

        Args:
            quiet: show no progress bar.
            names: groups that may stay or be added; others are removed. None: all.
            gone: groups that are removed.

        Raises:
            DeepDetectError: the file cannot be written; the parts stay.
        """
        parts = self._part_files()
        keep = self.path.exists() and not self.overwrite
        removed: list[str] = []
        if keep and (names is not None or gone):
            with open_hdf5(self.path) as file:
                removed = [
                    name
                    for name, _ in _leaves(file)
                    if name in gone or (names is not None and name not in names)
                ]
        if parts or removed:
            with atomic_path(self.path) as temporary:
                if keep:
                    shutil.copyfile(self.path, temporary)
                with (
                    progress(len(parts), "merging", "part", quiet) as bar,
                    _written(temporary, "r+" if keep else "w") as merged,
                ):
                    merged.attrs[SETTINGS] = json.dumps(self.settings)
                    for name in removed:
                        del merged[name]
                    for part in parts:
                        _copy_groups(part, merged, names)
                        bar.update(1)
        with contextlib.suppress(OSError):  # what stays is merged again, to no effect
            shutil.rmtree(self.parts)

    def _part_files(self) -> list[Path]:
        """List the parts, older ones first: newer ones replace what they hold."""
        parts = [path for path in self.parts.glob("*.h5") if not path.name.startswith(".")]
        return sorted(parts, key=lambda path: (path.stat().st_mtime_ns, path.name))

    def _differences(self, noted: object) -> list[str] | None:
        """Return which settings differ from those that were noted; None where none were."""
        try:
            before = json.loads(str(noted))
        except (ValueError, RecursionError):
            return None
        if not isinstance(before, dict):
            return None
        names = {*before, *self.settings}
        return sorted(n for n in names if before.get(n, ...) != self.settings.get(n, ...))

    def _check(self, place: Path, noted: object) -> None:
        other = self._differences(noted)
        advice = "choose another file with -o, or replace it with --overwrite"
        if other is None:
            raise OptionError(f"{place} exists already, written by something else: {advice}")
        if other:
            listed = ", ".join(f"`{name}`" for name in other)
            raise OptionError(
                f"{place} exists already, made with other settings ({listed}): {advice}"
            )


def _copy_groups(part: Path, merged: Any, names: Collection[str] | None) -> None:
    """Copy the groups of a part, in the place of those of the same name."""
    with open_hdf5(part) as file:
        for name, group in _leaves(file):
            if names is not None and name not in names:
                continue
            if name in merged:
                del merged[name]
            file.copy(group, merged, name=name)


def _leaves(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the groups that this package has written, with their paths."""
    for name, member in group.items():
        if STATE in member.attrs:
            yield prefix + name, member
        elif hasattr(member, "items"):
            yield from _leaves(member, f"{prefix}{name}/")


@contextmanager
def _locked(path: Path, final: Path) -> Iterator[None]:
    """Let one process at a time write a file; the system unlocks it when that ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OptionError(
                f"{final} is being written by another process: wait for it, or choose another file "
                "with -o"
            ) from None
        except OSError:  # a network folder without locks
            pass
        yield
