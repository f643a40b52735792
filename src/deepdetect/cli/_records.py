"""Records of what a command wrote, by which the same command goes on where it stopped."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .._shared.atomic import atomic_path, clear_abandoned
from .._shared.errors import DeepDetectError, ImageError, OptionError
from .._shared.signals import exit_by_signal, handle_signals

FOLDER = ".deepdetect"
ADVICE = "choose another folder with -o, or replace it with --overwrite"


class OutputRecords:
    """What a command made in a folder, from which files and how: a JSON file for each input.

    Two commands may write to one folder: a record is written before the outputs, which both then
    know as theirs, and again, with their sizes and digests, when they are whole.

    `changed` names the settings by which outputs that `find` has seen differ; they are replaced.

    Args:
        command: its name.
        folder: of the outputs; the records are in `.deepdetect/COMMAND` in it.
        settings: all that the outputs depend on besides the input, as JSON would give it back.
        overwrite: replace whatever there is.
    """

    def __init__(
        self, command: str, folder: Path, settings: Mapping[str, Any], overwrite: bool = False
    ) -> None:
        self.outputs = folder
        self.folder = folder / FOLDER / command
        self.settings = dict(settings)
        self.overwrite = overwrite
        self.changed: dict[Path, list[str]] = {}
        self._stale: dict[Path, list[Path]] = {}
        clear_abandoned(folder)

    def find(self, source: Path, outputs: Sequence[Path]) -> dict[str, Any] | None:
        """Return the numbers of an input whose outputs are done, None where work is left.

        Raises:
            OptionError: outputs exist that were made from another file or by something else.
        """
        if self.overwrite:
            return None
        record = _read(self._path(source))
        files = {} if record is None else record["files"]
        there = [path for path in outputs if path.exists()]
        there += [path for name in files if (path := outputs[0].with_name(name)).exists()]
        if not there:
            return None
        if record is None:
            raise _exists(there[0], f"and is not known to be of {source}")
        if record["input"] != str(source.resolve()):
            raise _exists(there[0], f"made from {record['input']}")
        before = record["settings"]
        for path in there:
            if path.name not in files or not _unchanged(path, files[path.name]):
                raise _exists(path, f"and is not what was made from {source}")
        names = sorted(n for n in {**before, **self.settings} if _differ(before, self.settings, n))
        if names:
            self.changed[source] = names
            self._stale[source] = [path for path in there if path not in outputs]
            return None
        done = all(path in there and files[path.name] is not None for path in outputs)
        numbers = record["numbers"]
        same_input = record["state"] == _state(source)
        return numbers if done and same_input and isinstance(numbers, dict) else None

    def begin(self, source: Path, outputs: Sequence[Path]) -> None:
        """Note that outputs are about to be written.

        Raises:
            DeepDetectError: the folder cannot be written.
        """
        self._write(source, dict.fromkeys(path.name for path in outputs), None)

    def finish(self, source: Path, outputs: Sequence[Path], numbers: Mapping[str, Any]) -> None:
        """Note that the outputs of an input are whole; `find` gives the numbers back.

        What was made with other settings, and is not made with these, is removed.

        Raises:
            DeepDetectError: the folder cannot be written.
        """
        for path in self._stale.pop(source, ()):
            path.unlink(missing_ok=True)
        self._write(source, {path.name: _fingerprint(path) for path in outputs}, numbers)

    def _path(self, source: Path) -> Path:
        return self.folder / f"{source.stem}.json"

    def _write(
        self, source: Path, files: dict[str, Any], numbers: Mapping[str, Any] | None
    ) -> None:
        record = {
            "input": str(source.resolve()),
            "state": _state(source),
            "settings": self.settings,
        }
        before = _read(self._path(source))
        same = () if before is None else [n for n, value in record.items() if before[n] == value]
        if before is not None and {"input", "settings"} <= {*same}:
            # Outputs of another format stay known; those of the input as it was are to be remade,
            # unless somebody has changed them.
            others = before["files"]
            if "state" not in same:
                others = {n: None for n, f in others.items() if _unchanged(self.outputs / n, f)}
            files = {**others, **files}
        with atomic_path(self._path(source)) as temporary:
            text = json.dumps({**record, "files": files, "numbers": numbers}, default=str)
            temporary.write_text(text, encoding="utf-8")


def check_outputs(
    command: str,
    inputs: Sequence[Path],
    outputs: Sequence[Path],
    overwrite: bool,
    growing: bool = False,
) -> None:
    """Refuse to replace outputs of other files; arguments and errors as of `claim_outputs`."""
    names = _names(inputs)
    for path in outputs:
        if overwrite or not path.exists():
            continue
        record = _read(_claim(command, path))
        if record is None or path.name not in record["files"]:
            raise _exists(path, f"and is not known to be of {' and '.join(names)}")
        if record["input"] != " and ".join(names):
            before = record["settings"].get("inputs")
            if not (growing and isinstance(before, list) and set(before) <= set(names)):
                raise _exists(path, f"made from {record['input']}")


def claim_outputs(
    command: str,
    inputs: Sequence[Path],
    outputs: Sequence[Path],
    overwrite: bool,
    growing: bool = False,
) -> None:
    """Note from which files each output is made; refuse to replace those of other files.

    Outputs of the same files are replaced, whatever the options were: call it before the work.

    Args:
        command: its name.
        inputs: files or folders.
        outputs: files or folders.
        overwrite: replace whatever there is.
        growing: outputs of a part of the inputs are replaced, too.

    Raises:
        OptionError: an output exists that was made from other files, or by something else.
        DeepDetectError: the folder cannot be written.
    """
    check_outputs(command, inputs, outputs, overwrite, growing)
    for path in outputs:
        with atomic_path(_claim(command, path)) as temporary:
            temporary.write_bytes(_record_of(inputs, path))


@contextmanager
def claimed_outputs(
    command: str, inputs: Sequence[Path], outputs: Sequence[Path], overwrite: bool
) -> Iterator[None]:
    """Claim outputs for the time of the work; one that fails or is stopped leaves no trace.

    Outputs that it has not replaced belong to the files that they belonged to before, and folders
    that were made for the records are removed again. SIGTERM, and SIGHUP of a terminal that is
    closed, stop it as Ctrl-C does. Where commands make one output at the same time, it belongs to
    the files of the one that wrote it last. Work that can be resumed keeps its records: it calls
    `claim_outputs`.

    Args:
        command: its name.
        inputs: files or folders.
        outputs: files or folders.
        overwrite: replace whatever there is.

    Raises:
        OptionError: an output exists that was made from other files, or by something else.
        DeepDetectError: the folder cannot be written.
    """
    check_outputs(command, inputs, outputs, overwrite)
    before = {path: (_state(path), _content(_claim(command, path))) for path in outputs}
    missing = {folder for path in outputs for folder in path.parents if not folder.exists()}
    ours = {path: _record_of(inputs, path) for path in outputs}
    with handle_signals(exit_by_signal):
        try:
            claim_outputs(command, inputs, outputs, overwrite)
            yield
            for path, record in ours.items():
                _put_back(_claim(command, path), record)  # another command may have changed it
        except BaseException:
            for path, (state, previous) in before.items():
                claim = _claim(command, path)
                if _state(path) == state and _content(claim) == ours[path]:
                    with contextlib.suppress(OSError, DeepDetectError):
                        _put_back(claim, previous)
            _remove_empty({_claim(command, path).parent for path in outputs})
            _remove_empty({path.parent / FOLDER for path in outputs})
            _remove_empty(missing)
            raise


def _record_of(inputs: Sequence[Path], output: Path) -> bytes:
    """Return the record of an output that is made from these inputs."""
    names = _names(inputs)
    value = {
        "input": " and ".join(names),
        "state": [0, 0],
        "settings": {"inputs": names},
        "files": {output.name: None},
        "numbers": None,
    }
    return json.dumps(value).encode()


def _content(path: Path) -> bytes | None:
    """Return what is in a file, None where there is none that can be read."""
    try:
        return path.read_bytes()
    except OSError:
        return None


def _put_back(path: Path, content: bytes | None) -> None:
    """Make a file what it was."""
    if content is None:
        path.unlink(missing_ok=True)
    elif content != _content(path):
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)


def _remove_empty(folders: set[Path]) -> None:
    """Remove folders that hold nothing, the innermost first."""
    for folder in sorted(folders, key=lambda path: len(path.parts), reverse=True):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _names(inputs: Sequence[Path]) -> list[str]:
    return [str(path.resolve()) for path in inputs]


def _claim(command: str, output: Path) -> Path:
    """Return where it is noted from what an output is made."""
    return output.parent / FOLDER / command / f"{output.name}.json"


def recorded_outputs(folder: Path) -> set[Path]:
    """Return the resolved paths of what commands made in a folder, or were about to make."""
    records = (_read(path) for path in folder.glob(f"{FOLDER}/*/*.json"))
    names = {name for record in records if record is not None for name in record["files"]}
    return {folder.resolve() / name for name in names}


def check_not_made(folder: Path, images: Iterable[Path]) -> None:
    """Refuse images below a folder that earlier runs of commands have made.

    Raises:
        OptionError: one of them is an output, or lies in a folder that is one.
    """
    made: dict[Path, set[str]] = {}
    for image in images:
        parts = image.relative_to(folder).parts
        for depth, name in enumerate(parts):
            parent = folder.joinpath(*parts[:depth])
            if parent not in made:
                made[parent] = {path.name for path in recorded_outputs(parent)}
            if name in made[parent]:
                raise OptionError(
                    f"{image} was made by an earlier run and is no photograph: move what was made "
                    f"out of {folder}, or list the photographs"
                )


def check_none_made(folder: Path, output: Path) -> None:
    """Refuse a folder of photographs that holds images which earlier runs of commands have made.

    Those below the output are not looked at. Nothing is said of a folder without images, nor of
    one that is missing: what reads it does.

    Raises:
        OptionError: one of them is an output, or lies in a folder that is one.
    """
    from ..io.image import find_images

    try:
        images = find_images(folder, [output])
    except ImageError:
        return
    check_not_made(folder, images)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path) -> dict[str, Any] | None:
    """Read a record, None where there is none or it is damaged."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    kinds = {"input": str, "state": list, "settings": dict, "files": dict}
    if not isinstance(record, dict) or "numbers" not in record:
        return None
    if not all(isinstance(record.get(name), kind) for name, kind in kinds.items()):
        return None
    return record if all(_is_file_name(name) for name in record["files"]) else None


def _is_file_name(name: str) -> bool:
    return name not in ("", "..") and Path(name).name == name


def _exists(path: Path, what: str) -> OptionError:
    return OptionError(f"{path} exists already, {what}: {ADVICE}")


def _differ(before: Mapping[str, Any], now: Mapping[str, Any], name: str) -> bool:
    return name not in before or name not in now or before[name] != now[name]


def _state(path: Path) -> list[int]:
    """Return a file's size in bytes and the time of its last change, zeros where there is none."""
    try:
        found = path.stat()
    except OSError:
        return [0, 0]
    return [found.st_size, found.st_mtime_ns]


def _fingerprint(path: Path) -> dict[str, Any]:
    return {"state": _state(path), "sha256": file_digest(path)}


def _unchanged(path: Path, fingerprint: object) -> bool:
    """Return whether a file is the one whose fingerprint was taken, or none was taken yet."""
    if fingerprint is None:
        return True
    state = fingerprint.get("state") if isinstance(fingerprint, dict) else None
    if not isinstance(fingerprint, dict) or not isinstance(state, list) or not path.is_file():
        return False
    # A copy of the folder has other times.
    now = _state(path)
    return now == state or (now[:1] == state[:1] and file_digest(path) == fingerprint.get("sha256"))
