"""HDF5 files that many processes fill, and that survive being killed.

HDF5 has one writer, and a file whose writer is killed may be lost. So each task writes a small file
of its own, a shard, whole or not at all. At the end one process merges the shards into a copy of
the file, which takes the file's place when it is whole. What is in shards or in the file stays,
whatever is killed.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import (
    BatchError,
    DeepDetectError,
    InvalidFileError,
    MissingFileError,
    OptionError,
    first_line,
    require_packages,
)
from .._shared.progress import progress
from .._shared.records import check_same, key, lock, plain

SETTINGS = "deepdetect"
"""Attribute of the file: what its content depends on besides the inputs, as JSON."""

STATE = "source_state"
"""Attribute of a group."""

FORMAT = ("v110", "v110")
"""Of the files: read by HDF5 1.10 (2016) and later; groups of a million members stay fast."""


MIN_SHARDS = 256
"""Of as many inputs, so that all workers have something to do."""

State = tuple[int, ...]
"""Of an input of a group: whole numbers that change when it does."""


@dataclass(frozen=True)
class Group:
    """A group of an HDF5 file: its path, its datasets and their attributes by name.

    `state` is that of its input.
    """

    name: str
    arrays: Mapping[str, np.ndarray]
    state: State = ()
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class BatchReport:
    """What was extracted or matched.

    Attributes:
        path: the file.
        counts: keypoints of each image, or matches of each pair, that was done now.
        skipped: number of images or pairs that had been done before.
        failures: a sentence on each that could not be worked on.
        of: "images" or "pairs".
    """

    path: Path
    counts: dict[Any, int] = field(repr=False)
    skipped: int
    failures: tuple[str, ...]
    of: str

    def check(self) -> None:
        """Raise a BatchError where something failed."""
        if self.failures:
            total = len(self.counts) + self.skipped + len(self.failures)
            raise BatchError(
                f"{len(self.failures)} of {total} {self.of} failed, the others are done",
                self.failures,
            )


def import_h5py() -> Any:
    """Import h5py, or raise a MissingExtraError."""
    require_packages("a file of features or matches", "h5py")
    import h5py

    return h5py


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file to read it; that it is damaged may be found while it is read."""
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
            f"{path} is no HDF5 file, or is damaged ({first_line(error)}): write it again"
        ) from error
    with file:
        try:
            yield file
        except DeepDetectError:
            raise
        except (OSError, RuntimeError, KeyError) as error:  # what h5py raises, by what is damaged
            raise damaged(path, error) from error


def feature_names(file: Any) -> list[str]:
    """List the images that have features in a file."""
    names: list[str] = []
    file.visit(names.append)
    return [name.removesuffix("/keypoints") for name in names if name.endswith("/keypoints")]


def damaged(path: Path, error: Exception) -> InvalidFileError:
    """Return the error of a file, or of a part of it, that cannot be read."""
    return InvalidFileError(f"{path} is damaged ({first_line(error)}): write it again")


@contextmanager
def _written(path: Path, mode: str) -> Iterator[Any]:
    """Open a temporary file to write it; what the system refuses is an OSError with its number."""
    try:
        with import_h5py().File(path, mode, libver=FORMAT) as file:
            yield file
    except (OSError, RuntimeError) as error:  # HDF5 raises both, with pages of text
        number = re.search(r"errno = (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def write_groups(path: Path, groups: Iterable[Group]) -> None:
    """Write a file of groups, whole or not at all; without any there is no file.

    They are written one by one: an iterator needs the memory of one.
    """
    groups = iter(groups)
    first = next(groups, None)
    if first is None:
        return
    with atomic_path(path) as temporary, _written(temporary, "w") as file:
        for group in itertools.chain([first], groups):
            made = file.create_group(group.name)
            made.attrs[STATE] = np.array(group.state, np.int64)
            for name, array in group.arrays.items():
                dataset = made.create_dataset(name, data=array)
                dataset.attrs.update(group.attributes.get(name, {}))


def state_of(group: Any) -> State:
    """Return the state of a group's input; empty where another program has written it."""
    return tuple(int(number) for number in group.attrs.get(STATE, ()))


class ShardedWriter:
    """Writes an HDF5 file by shards, in PATH.shards beside it, which many processes may fill.

    Settings are all that the content depends on besides the inputs; shards of others are not used.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], overwrite: bool = False) -> None:
        self.path = path
        self.folder = path.with_name(path.name + ".shards")
        self.settings = plain(settings)
        self.shards = self.folder / key(settings)
        self.keep = path.exists() and not overwrite

    @contextmanager
    def opened(self) -> Iterator[ShardedWriter]:
        """Hold the file for this process.

        An OptionError says that it was made with other settings or by another program, or is being
        made by another process.
        """
        import_h5py()
        if self.path.is_dir():
            raise OptionError(f"{self.path} is a folder: name a file in it with -o")
        if self.keep:
            with open_hdf5(self.path) as file:
                noted = file.attrs.get(SETTINGS)
                check_same(self.path, None if noted is None else json.loads(noted), self.settings)
        try:
            self.shards.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DeepDetectError(
                f"cannot write {self.shards} ({error.strerror}): choose another place with -o"
            ) from error
        with lock(self.folder / "lock", self.path):
            yield self

    def done(self, wanted: Mapping[str, State]) -> set[str]:
        """Return which groups are in the file or in shards with the states that are wanted."""
        found: set[str] = set()
        for path in [self.path] * self.keep + self._shard_files():
            with open_hdf5(path) as file:
                for name, group in _leaves(file):
                    found -= {name}
                    if wanted.get(name) == state_of(group):
                        found.add(name)
        return found

    def shard(self, names: Sequence[Any]) -> Path:
        """Return the file for the shard of these inputs: the same names give the same file."""
        return self.shards / f"{key(names)}.h5"

    def tasks(
        self, items: Sequence[tuple[Any, State]], most: int
    ) -> list[tuple[Path, Sequence[tuple[Any, State]]]]:
        """Divide inputs and their states into shards of at most so many, or fewer of a few."""
        size = min(most, max(1, len(items) // MIN_SHARDS))
        shards = [items[k : k + size] for k in range(0, len(items), size)]
        return [(self.shard([name for name, _ in shard]), shard) for shard in shards]

    @staticmethod
    def collect(
        outcomes: Iterable[tuple[dict[Any, int], list[str]]], bar: Any
    ) -> tuple[dict[Any, int], list[str]]:
        """Join the counts and the failures of shards as they are made."""
        counts: dict[Any, int] = {}
        failures: list[str] = []
        for made, failed in outcomes:
            bar.update(len(made) + len(failed))
            counts |= made
            failures += failed
        return counts, failures

    def merge(self, quiet: bool = True, stays: Callable[[str], bool] = lambda name: True) -> None:
        """Merge all shards into the file, and remove them; `stays` says which groups may be in it.

        Where the file cannot be written the shards stay.
        """
        shards, removed = self._shard_files(), []
        if self.keep:
            with open_hdf5(self.path) as file:
                removed = [name for name, _ in _leaves(file) if not stays(name)]
        if shards or removed:
            with atomic_path(self.path) as temporary:
                if self.keep:
                    shutil.copyfile(self.path, temporary)
                with (
                    progress(len(shards), "merging", "shard", quiet) as bar,
                    _written(temporary, "r+" if self.keep else "w") as merged,
                ):
                    merged.attrs[SETTINGS] = json.dumps(self.settings)
                    for name in removed:
                        del merged[name]
                    for shard in shards:
                        _copy_groups(shard, merged, stays)
                        bar.update(1)
        with contextlib.suppress(OSError):  # what stays is merged again, to no effect
            shutil.rmtree(self.folder)

    def _shard_files(self) -> list[Path]:
        """List the shards, older ones first: newer ones replace what they hold."""
        shards = [path for path in self.shards.glob("*.h5") if not path.name.startswith(".")]
        return sorted(shards, key=lambda path: (path.stat().st_mtime_ns, path.name))


def _copy_groups(shard: Path, merged: Any, stays: Callable[[str], bool]) -> None:
    """Copy the groups of a shard, in the place of those of the same name."""
    with open_hdf5(shard) as file:
        for name, group in _leaves(file):
            if stays(name):
                if name in merged:
                    del merged[name]
                file.copy(group, merged, name=name)


def _leaves(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the groups that this package has written, with their paths."""
    for name, member in group.items():  # None: a link that leads nowhere, of a damaged file
        if member is not None and STATE in member.attrs:
            yield prefix + name, member
        elif hasattr(member, "items"):
            yield from _leaves(member, f"{prefix}{name}/")
