"""HDF5 files that many processes fill, and that survive a killed process.

Only one process at a time can write to an HDF5 file, and if that process is killed, the file may be
lost. So each task writes a small file of its own, a shard, which appears complete or not at all. At
the end one process merges the shards into a copy of the file, and the complete copy replaces it.
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
"""Name of the file attribute that stores, as JSON, the settings with which the file was made."""

STATE = "source_state"
"""Name of the group attribute that stores the `State` of the image or pair of the group."""

FORMAT = ("v110", "v110")
"""Oldest and newest file format to write: HDF5 1.10 (2016), in which large groups are fast."""

MIN_SHARDS, LARGEST_SHARD = 256, 32
"""MIN_SHARDS or more inputs make at least MIN_SHARDS shards, to keep all workers busy. A shard has
at most LARGEST_SHARD inputs, because a killed worker loses its shard. Chosen by hand."""

State = tuple[int, ...]
"""Numbers that change if an image or pair changes, such as a file's size and time of change."""

Item = tuple[Any, State]
"""An input, which is an image or a pair of images: its name (or pair of names) and its state."""


@dataclass(frozen=True)
class Group:
    """A group of an HDF5 file: its path, its datasets, their attributes, and its input's state."""

    name: str
    arrays: Mapping[str, np.ndarray]
    state: State = ()
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


MakeGroups = Callable[[Sequence[Item], dict[Any, int], list[str]], Iterator[Group]]
"""Function that yields the groups made from inputs. For each input, the function adds the number of
keypoints or matches to its second argument, or a sentence on the failure to its third."""


@dataclass(frozen=True)
class BatchReport:
    """Outcome of an extraction of features, or of a matching of pairs.

    Attributes:
        path: the HDF5 file.
        counts: number of keypoints of each image, or of matches of each pair, in this run.
        skipped: number of images or pairs that an earlier run had processed.
        failures: a sentence on each image or pair that could not be processed.
        of: what was processed, "images" or "pairs".
    """

    path: Path
    counts: dict[Any, int] = field(repr=False)
    skipped: int
    failures: tuple[str, ...]
    of: str

    def check(self) -> None:
        """Raise a BatchError if an image or a pair failed."""
        if self.failures:
            total = len(self.counts) + self.skipped + len(self.failures)
            raise BatchError(
                f"{len(self.failures)} of {total} {self.of} failed; the others are done",
                self.failures,
            )


def import_h5py() -> Any:
    """Import h5py, or raise a MissingExtraError."""
    require_packages("a file of features or matches", "h5py")
    import h5py

    return h5py


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading; raise an InvalidFileError if the block finds it damaged."""
    h5py = import_h5py()
    if path.is_dir():
        raise InvalidFileError(f"{path} is a folder: give a file of features or matches")
    if not path.is_file():
        raise MissingFileError(f"there is no file {path}: check the path")
    try:
        # A complete file is never written to, so it needs no lock; network folders may lack locks.
        file = h5py.File(path, "r", locking=False)
    except OSError as error:
        raise InvalidFileError(
            f"{path} is not an HDF5 file, or is damaged ({first_line(error)}): give one that "
            "`deepdetect extract` or `match-many` wrote"
        ) from error
    with file:
        try:
            yield file
        except DeepDetectError:
            raise
        except (OSError, RuntimeError, KeyError) as error:  # h5py's errors for damaged files
            raise damaged(path, error) from error


def feature_names(file: Any) -> list[str]:
    """List the images that have features in a file."""
    names: list[str] = []
    file.visit(names.append)
    return [name.removesuffix("/keypoints") for name in names if name.endswith("/keypoints")]


def damaged(path: Path, error: Exception) -> InvalidFileError:
    """Return the error for a file, or a part of it, that cannot be read."""
    return InvalidFileError(f"{path} is damaged ({first_line(error)}): write it again")


@contextmanager
def _written(path: Path, mode: str) -> Iterator[Any]:
    """Open an HDF5 file for writing; raise errors of the operating system as a short OSError."""
    try:
        with import_h5py().File(path, mode, libver=FORMAT) as file:
            yield file
    except (OSError, RuntimeError) as error:  # HDF5 raises either, with a long text
        number = re.search(r"errno = (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error


def write_groups(path: Path, groups: Iterable[Group]) -> None:
    """Write groups one by one to a file, complete or not at all; without groups, write no file."""
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
    """Return the state of a group's input, or () if another program wrote the file."""
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
    """Make the wanted groups that are not in the file yet, in parallel processes of `engine`.

    An existing file must have the same `settings`. Shards of an interrupted run with the same
    settings are used. `wanted` has a dictionary for each input: its keys are names of groups that
    may hold the input's result, its values the state of the input (size, date) that the group must
    record. If the file has none of these groups with this state, the first one is made. A group
    that is not wanted, or whose input fails, stays in the file only
    if `others_stay` returns True for the name of the group.
    """
    import_h5py()
    map_tasks, work = look_up("engine", engine, ENGINES), partial(_write_shard, make=make)
    list(map_tasks(work, [], workers))  # raises an error early if the engine is missing
    target, settings = Path(path).absolute(), plain(settings)
    if target.is_dir():
        raise OptionError(f"{target} is a folder: give a file in it with -o")
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
        counts, failures = dict[Any, int](), list[str]()
        size = min(LARGEST_SHARD, max(1, len(left) // MIN_SHARDS))
        parts = [left[k : k + size] for k in range(0, len(left), size)]
        # The file of a shard is named by a digest of the names of the shard's inputs.
        tasks = [(shards / f"{key([name for name, _ in part])}.h5", part) for part in parts]
        with progress(len(wanted), of, of.removesuffix("s"), quiet, skipped) as bar:
            for made, failed in map_tasks(work, tasks, workers):
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
        with contextlib.suppress(OSError):  # shards that remain do no harm to the next run
            shutil.rmtree(folder)
    return BatchReport(Path(path), dict(sorted(counts.items())), skipped, (*sorted(failures),), of)


def _shard_files(folder: Path) -> list[Path]:
    """List the shards, oldest first, because groups of newer ones replace those of older ones."""
    shards = [path for path in folder.glob("*.h5") if not path.name.startswith(".")]
    return sorted(shards, key=lambda path: (path.stat().st_mtime_ns, path.name))


def _write_shard(
    task: tuple[Path, Sequence[Item]], make: MakeGroups
) -> tuple[dict[Any, int], list[str]]:
    path, items = task
    counts, failures = dict[Any, int](), list[str]()
    write_groups(path, make(items, counts, failures))
    return counts, failures


def _copy_groups(shard: Path, merged: Any) -> None:
    """Copy the groups of a shard, replacing groups of the same name."""
    with open_hdf5(shard) as file:
        for name, group in _leaves(file):
            if name in merged:
                del merged[name]
            file.copy(group, merged, name=name)


def _leaves(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and the object of each group, at any depth, that this package has written."""
    for name, member in group.items():  # a dangling link in a damaged file is None
        if member is not None and STATE in member.attrs:
            yield prefix + name, member
        elif hasattr(member, "items"):
            yield from _leaves(member, f"{prefix}{name}/")
