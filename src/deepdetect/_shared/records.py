"""Records of output files: their inputs and options, and whether they are complete.

A record tells whether work can be skipped, and whether its outputs may be replaced. The record of
an output NAME is `.deepdetect/NAME.json` in the same folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import atomic_path, write_whole
from .errors import DeepDetectError, MissingFileError, OptionError

FOLDER = ".deepdetect"
ADVICE = "choose another place with -o, or replace it with --overwrite"


def key(*values: Any) -> str:
    """Return a digest of values, 32 hexadecimal digits that are the same on every machine.

    Values may be JSON values, tuples, sets, bytes, arrays, dataclasses, and paths, which stand for
    the contents of their files. Raises a MissingFileError if a file is missing.
    """
    text = json.dumps(plain(values), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def plain(value: Any) -> Any:
    """Return a value in the types of JSON, with digests instead of bytes, arrays and files."""
    match value:
        case None | bool() | int() | float() | str():
            return value
        case Path():
            return file_digest(value)
        case bytes():
            return hashlib.sha256(value).hexdigest()
        case np.generic():
            return value.item()
        case np.ndarray():
            digest = hashlib.sha256(f"{value.dtype}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
            return digest.hexdigest()
        case Mapping():
            return {str(name): plain(each) for name, each in value.items()}
        case set() | frozenset():
            return sorted(plain(each) for each in value)
        case list() | tuple():
            return [plain(each) for each in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [each.name for each in dataclasses.fields(value)]
        return {"class": type(value).__name__} | {n: plain(getattr(value, n)) for n in names}
    raise TypeError(f"there is no digest of {type(value).__name__}")


def file_digest(path: Path) -> str:
    """Return a file's SHA-256, cached until the file changes, or raise a MissingFileError."""
    try:
        return _file_digest(path.resolve(), *file_state(path))
    except OSError as error:
        raise MissingFileError(f"{path} cannot be read ({error.strerror}): check it") from None


@lru_cache(maxsize=4096)
def _file_digest(path: Path, size: int, changed: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def file_state(path: Path) -> tuple[int, int]:
    """Return a file's size in bytes and its time of change in ns, or zeros if it is missing."""
    try:
        status = path.stat()
    except OSError:
        return (0, 0)
    return (status.st_size, status.st_mtime_ns)


def check_same(place: Path, before: object, now: Mapping[str, Any], advice: str = ADVICE) -> None:
    """Raise an OptionError unless an existing output was made with the settings of this run.

    `before` are the settings of the output, `now` those of this run, both as `plain` returns them.
    """
    if not isinstance(before, Mapping):
        raise OptionError(f"{place} exists, written by another program: {advice}")
    names = sorted(n for n in now if n not in before or before[n] != now[n])
    if names:
        other = ", ".join(f"`{name}`" for name in names)
        raise OptionError(f"{place} exists, made with other settings ({other}): {advice}")


@dataclass(frozen=True)
class Outputs:
    """The outputs of one piece of work, each with a record of its inputs and settings.

    Attributes:
        paths: output files or folders.
        inputs: input files or folders.
        settings: other values on which the outputs depend, of the types that `key` accepts.
        overwrite: replace any existing output.
        growing: outputs that were made from only some of the inputs may also be replaced.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> outputs = Outputs([folder / "points.txt"], [folder / "image.png"], {"count": 2})
        >>> with outputs.writing() as values:
        ...     _ = outputs.paths[0].write_text("1 2")
        ...     values["seconds"] = 0.5
        >>> outputs.find()
        {'seconds': 0.5}
    """

    paths: Sequence[Path]
    inputs: Sequence[Path]
    settings: Mapping[str, Any] = field(default_factory=dict)
    overwrite: bool = False
    growing: bool = False

    def check(self) -> None:
        """Raise an OptionError if an output exists, but no record of these inputs and settings."""
        if not self.overwrite:
            for path in self.paths:
                self._known(path)

    def find(self) -> dict[str, Any] | None:
        """Return the values noted with the outputs if all are complete and up to date, else None.

        Raises:
            OptionError: `check` fails, or an output was changed after it was made.
        """
        if self.overwrite:
            return None
        records = [self._known(path) for path in self.paths]
        for path, record in zip(self.paths, records, strict=True):
            if not record or not record["digest"] or list(file_state(path)) == record["state"]:
                continue
            if file_digest(path) != record["digest"]:  # a copied file has another time
                raise OptionError(f"{path} exists, and was changed after it was made: {ADVICE}")
        states = [list(file_state(path)) for path in self.inputs]
        done = all(record and record["whole"] and record["states"] == states for record in records)
        return records[0]["values"] if done and records[0] else None

    @contextmanager
    def writing(self) -> Iterator[dict[str, Any]]:
        """Write the records before and after the block; yield a dictionary that is stored in them.

        If the block fails, outputs that it left unchanged get their former records back. If the
        process is killed, the records name the inputs, and mark the outputs as incomplete.

        Raises:
            OptionError: `check` fails.
            DeepDetectError: the folder cannot be written.
        """
        self.check()
        records = [_record(path) for path in self.paths]
        missing = {each for path in records for each in path.parents if not each.exists()}
        before = [
            (file_state(path), record.read_bytes() if record.is_file() else None)
            for path, record in zip(self.paths, records, strict=True)
        ]
        values: dict[str, Any] = {}
        try:
            self._note(False, values)
            yield values
            self._note(True, values)
        except BaseException:
            for path, record, (state, content) in zip(self.paths, records, before, strict=True):
                if file_state(path) == state:
                    with contextlib.suppress(OSError, DeepDetectError):
                        if content is None:
                            record.unlink()
                        else:
                            write_whole(record, content)
            for folder in sorted(missing, reverse=True):  # inner folders first
                with contextlib.suppress(OSError):  # the folder is not empty
                    folder.rmdir()
            raise

    def _known(self, path: Path) -> dict[str, Any] | None:
        """Return the record of an output that may be replaced, or None if there is no output."""
        if not path.exists():
            return None
        names = [str(each.resolve()) for each in self.inputs]
        record = _read(path)
        if record is None:
            origin = " and ".join(names)
            raise OptionError(
                f"{path} exists, but no record says that it was made from {origin}: {ADVICE}"
            )
        before = record["inputs"]
        if before != names and not (self.growing and {*before} <= {*names}):
            raise OptionError(f"{path} exists, made from {' and '.join(before)}: {ADVICE}")
        check_same(path, record["settings"], plain(self.settings))
        return record

    def _note(self, done: bool, values: Mapping[str, Any]) -> None:
        note = {
            "inputs": [str(each.resolve()) for each in self.inputs],
            "states": [file_state(each) for each in self.inputs],
            "settings": plain(self.settings),
            "values": plain(values),
        }
        for path in self.paths:
            whole = done and path.exists()
            digest = file_digest(path) if whole and path.is_file() else None
            state = {"whole": whole, "state": file_state(path), "digest": digest}
            write_whole(_record(path), json.dumps(note | state))


def _record(output: Path) -> Path:
    return output.parent / FOLDER / f"{output.name}.json"


def _read(output: Path) -> dict[str, Any] | None:
    """Read the record of an output; return None if that file is missing or damaged."""
    with contextlib.suppress(OSError, ValueError):
        record = json.loads(_record(output).read_bytes())
        fields = {"inputs", "states", "settings", "values", "whole", "state", "digest"}
        return record if isinstance(record, dict) and fields <= {*record} else None
    return None


def inputs_of(path: Path) -> list[str]:
    """Return the inputs of an output as resolved paths, or an empty list if it has no record."""
    record = _read(path)
    return [] if record is None else list(record["inputs"])


def was_made(path: Path, root: Path) -> bool:
    """Return whether a file below `root`, or a folder that contains it, is a recorded output."""
    return path != root and (_record(path).is_file() or was_made(path.parent, root))


def save_arrays(path: str | Path, arrays: Mapping[str, Any], *, compress: bool = True) -> None:
    """Write named arrays to an NPZ file, which appears complete or not at all."""
    # Level 1 leaves 28% of a file of dense keypoints; NumPy's level 6 leaves 24%, 8 times slower.
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", method, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Read arrays that `save_arrays` wrote; return None if the file is missing or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return dict(file)
    except Exception:  # a damaged file raises one of a dozen errors of zip, zlib and numpy
        return None


@contextmanager
def lock(path: Path, final: Path) -> Iterator[None]:
    """Lock `final` by the lock file `path`; raise an OptionError if another process holds the lock.

    On Windows, and in network folders without locks, nothing is locked.
    """
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
                f"another process is writing {final}: wait, or choose another file with -o"
            ) from None
        except OSError:  # a network folder without locks
            pass
        yield
