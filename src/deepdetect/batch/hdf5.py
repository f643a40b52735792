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
from functools import partial
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
from .._shared.options import look_up
from .._shared.progress import progress
from .._shared.records import check_same, key, lock, plain
from .engines import ENGINES

SETTINGS = "deepdetect"
"""Attribute of the file: what its content depends on besides the inputs, as JSON."""

STATE = "source_state"
"""Attribute of a group."""

FORMAT = ("v110", "v110")
"""Of the files: read by HDF5 1.10 (2016) and later; groups of a million members stay fast."""

MIN_SHARDS = 256
"""Of as many inputs, so that all workers have something to do."""

LARGEST_SHARD = 32
"""Inputs of one: what a killed worker loses, against the number of files."""

State = tuple[int, ...]
"""Of an input of a group: whole numbers that change when it does."""

Item = tuple[Any, State]
"""An input by its name, with its state."""


@dataclass(frozen=True)
class Group:
    """A group of an HDF5 file: its path, its datasets and their attributes by name.

    `state` is that of its input.
    """

    name: str
    arrays: Mapping[str, np.ndarray]
    state: State = ()
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


MakeGroups = Callable[[Sequence[Item], dict[Any, int], list[str]], Iterator[Group]]
"""Makes the groups of inputs one by one; notes a count or a failure for each input."""


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


def fill_file(
    path: str | Path,
    settings: Mapping[str, Any],
    wanted: Mapping[Any, Mapping[str, State]],
    make: MakeGroups,
    *,
    of: str,
    others_stay: Callable[[str], bool],
    engine: str,
    workers: int | None,
    overwrite: bool,
    quiet: bool,
) -> BatchReport:
    """Make the groups that are wanted and not in the file yet, in the processes of an engine.

    The settings are all that the content depends on besides the inputs; shards of others are not
    used. Of an input any of its groups will do, if it has the named state; else the first is made.
    `others_stay` says which groups of other inputs, and of inputs that fail, stay in the file.
    """
    import_h5py()
    map_tasks, work = look_up("engine", engine, ENGINES), partial(_write_shard, make=make)
    list(map_tasks(work, [], workers))  # what the engine lacks is said before a file is made
    target, settings = Path(path).absolute(), plain(settings)
    if target.is_dir():
        raise OptionError(f"{target} is a folder: name a file in it with -o")
    before = [target] if target.exists() and not overwrite else []
    for kept in before:
        with open_hdf5(kept) as file:
            try:
                noted = json.loads(file.attrs.get(SETTINGS, "null"))
            except (ValueError, TypeError) as error:
                raise damaged(kept, error) from error
            check_same(kept, noted, settings)
    folder = target.with_name(target.name + ".shards")
    shards = folder / key(settings)
    try:
        shards.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {shards} ({error.strerror}): choose another place with -o"
        ) from error
    with lock(folder / "lock", target):
        states: dict[str, State] = {}
        for written in before + _shard_files(shards):
            with open_hdf5(written) as file:
                states |= {name: state_of(group) for name, group in _leaves(file)}
        left = [
            (name, next(iter(groups.values())))
            for name, groups in wanted.items()
            if not any(states.get(group) == state for group, state in groups.items())
        ]
        skipped = len(wanted) - len(left)
        counts: dict[Any, int] = {}
        failures: list[str] = []
        with progress(len(wanted), of, of.removesuffix("s"), quiet, skipped) as bar:
            for made, failed in map_tasks(work, _divided(left, shards), workers):
                bar.update(len(made) + len(failed))
                counts |= made
                failures += failed
        lacking = {name for name, _ in left} - counts.keys()
        stay = {group for name in wanted if name not in lacking for group in wanted[name]}
        gone = [name for name in states if not (name in stay or others_stay(name))]
        new = _shard_files(shards)
        if new or gone:
            with atomic_path(target) as temporary:
                for kept in before:
                    shutil.copyfile(kept, temporary)
                with (
                    progress(len(new), "merging", "shard", quiet) as bar,
                    _written(temporary, "r+" if before else "w") as merged,
                ):
                    merged.attrs[SETTINGS] = json.dumps(settings)
                    for shard in new:
                        _copy_groups(shard, merged)
                        bar.update(1)
                    for name in filter(merged.__contains__, gone):
                        del merged[name]
        with contextlib.suppress(OSError):  # what stays is merged again, to no effect
            shutil.rmtree(folder)
    return BatchReport(Path(path), dict(sorted(counts.items())), skipped, (*sorted(failures),), of)


def _shard_files(folder: Path) -> list[Path]:
    """List the shards, older ones first: newer ones replace what they hold."""
    shards = [path for path in folder.glob("*.h5") if not path.name.startswith(".")]
    return sorted(shards, key=lambda path: (path.stat().st_mtime_ns, path.name))


def _divided(items: Sequence[Item], folder: Path) -> list[tuple[Path, Sequence[Item]]]:
    """Divide inputs into shards; the same names give the same file."""
    size = min(LARGEST_SHARD, max(1, len(items) // MIN_SHARDS))
    parts = [items[k : k + size] for k in range(0, len(items), size)]
    return [(folder / f"{key([name for name, _ in part])}.h5", part) for part in parts]


def _write_shard(
    task: tuple[Path, Sequence[Item]], make: MakeGroups
) -> tuple[dict[Any, int], list[str]]:
    path, items = task
    counts: dict[Any, int] = {}
    failures: list[str] = []
    write_groups(path, make(items, counts, failures))
    return counts, failures


def _copy_groups(shard: Path, merged: Any) -> None:
    """Copy the groups of a shard, in the place of those of the same name."""
    with open_hdf5(shard) as file:
        for name, group in _leaves(file):
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
