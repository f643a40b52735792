"""Download data sets, unpack them, and check them. Broken downloads can be resumed.

Pooch is not used, because it cannot resume a broken download, such as the 19 GB of COCO.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from deepdetect._shared.errors import DeepDetectError, first_line
from deepdetect._shared.opencv import cv2
from deepdetect._shared.progress import progress
from deepdetect._shared.records import file_state
from deepdetect.io.image import find_images
from deepdetect.io.image_file import IMAGE_SUFFIXES

CHUNK_BYTES = 1 << 16
"""Downloads are written in blocks of this many bytes. An interruption loses at most one block."""

TIMEOUT_SECONDS = 60.0
"""A download from a host fails if no byte arrives for this time. Chosen by hand; not measured."""

ARCHIVE_SUFFIXES = (".zip", ".tar.gz", ".tgz", ".tar")

WRITE_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO),
    *(errno.EMFILE, errno.ENFILE),
)
"""Numbers of errors of the disk or system. Other errors in unpacking mean a damaged archive."""


@dataclass(frozen=True)
class RemoteFile:
    """A file to download.

    Attributes:
        urls: addresses in the order in which they are tried: the official host, then mirrors.
        size: approximate size in bytes.
        checksum: "md5:..." or "sha256:...". If it is None, only the contents of the finished data
            set are checked.
        into: folder to unpack the archive into; for any other file, its path in the data set.
        inside: folder inside the archive, if any, whose contents are moved up into `into`.
        suffixes: endings of the files to unpack from a tar archive; empty for all files.
    """

    urls: tuple[str, ...]
    size: int
    checksum: str | None = None
    into: str = "."
    inside: str = ""
    suffixes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The file's name on its host."""
        return Path(urlsplit(self.urls[0]).path).name


@dataclass(frozen=True)
class RemoteDataset:
    """A data set of images to download.

    Attributes:
        name: name by which users choose it.
        title: short description.
        files: archives to unpack, and single files.
        images: number of images.
        licence: the terms of use.
        contents: digests of files (see `content_digest`), by path in the data set.
        texts: contents of text files to write, by path in the data set.
        prepare: function that converts the unpacked files in a folder to the data set. Its second
            argument says whether progress bars are off.
    """

    name: str
    title: str
    files: tuple[RemoteFile, ...]
    images: int
    licence: str
    contents: Mapping[str, str] = field(default_factory=dict, repr=False)
    texts: Mapping[str, str] = field(default_factory=dict, repr=False)
    prepare: Callable[[Path, bool], None] | None = field(default=None, repr=False)

    @property
    def size(self) -> int:
        """Size of the download in bytes."""
        return sum(file.size for file in self.files)


def get_dataset(dataset: RemoteDataset, folder: str | Path, *, quiet: bool = True) -> Path:
    """Download and unpack a data set, unless the folder already holds it.

    An interrupted download is resumed. The folder appears only when all images are complete and
    correct. Then the archives are removed.

    Args:
        dataset: the data set.
        folder: folder for its images.
        quiet: show no progress bar.

    Returns:
        The folder.

    Raises:
        DeepDetectError: the download fails, a checksum is wrong, the disk is full, or the
            folder holds something else.
    """
    final = Path(folder)
    if final.is_dir() and any(final.iterdir()):
        _check(dataset, final, f"{final} exists and")
        return final
    store = final.with_name(f"{final.name}.download")
    try:
        store.mkdir(parents=True, exist_ok=True)
        paths = [store / f"{k:02d}-{file.name}" for k, file in enumerate(dataset.files)]
        every = zip(dataset.files, paths, strict=True)
        missing = [(file, path) for file, path in every if not path.exists()]
        # The archives and the unpacked files together need about twice the size of the download.
        done = sum(file_state(_part(path))[0] for _, path in missing)
        needed = dataset.size + sum(file.size for file, _ in missing) - done
        free = shutil.disk_usage(store).free
        if free < needed:
            raise DeepDetectError(
                f"{final.parent} has {free / 1e9:.1f} GB free, but {needed / 1e9:.1f} GB are "
                "needed: make room or choose another folder"
            )
        for file, path in missing:
            download(file, path, quiet=quiet)
        _assemble(dataset, paths, final, quiet)
        shutil.rmtree(store)
    except DeepDetectError:
        if store.is_dir() and not any(store.iterdir()):
            store.rmdir()
        raise
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): make room or choose another folder"
        ) from None
    return final


def download(file: RemoteFile, path: Path, *, quiet: bool = True) -> None:
    """Download a file to `path`, where it appears only when it is complete and correct.

    Until then its bytes are in a file with ".part" added to the name, so that the next call can
    resume. If all hosts fail, the error of the last host is raised.
    """
    from requests import RequestException

    part = _part(path)
    for k, url in enumerate(file.urls):
        if k and file.checksum is None:
            part.unlink(missing_ok=True)  # this host's file may differ from the previous one's
        try:
            _fetch(url, file, part, quiet)
            if file.checksum is not None and not has_checksum(part, file.checksum):
                part.unlink()
                raise DeepDetectError(
                    f"the file from {url} does not have the checksum {file.checksum}: try again "
                    "later"
                )
            part.replace(path)
            return
        except DeepDetectError as error:
            failure = error
        except RequestException as error:
            what, advice = type(error).__name__, "run the same command again to resume"
            if error.response is not None:
                what, advice = f"the server answers {error.response.status_code}", "try again later"
            failure = DeepDetectError(f"{url} cannot be downloaded ({what}): {advice}")
    raise failure


def has_checksum(path: Path, checksum: str) -> bool:
    """Return whether a file has the given checksum, such as "sha256:..." or "md5:..."."""
    algorithm, _, digest = checksum.partition(":")
    with path.open("rb") as file:
        return hashlib.file_digest(file, algorithm).hexdigest() == digest


def content_digest(folder: Path, name: str) -> str | None:
    """Return the SHA-256 of a file's content, or None if there is no such file.

    `name` is the path in the folder; for an image, it is given without suffix. The digest of an
    image covers its pixels, shape and data type, so a lossless copy in another format has the same
    digest. The digest of a text file does not depend on the kind and amount of white space.
    """
    path = folder / name
    if path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES:
        words = path.read_text(encoding="utf-8", errors="replace").split()
        return hashlib.sha256(" ".join(words).encode()).hexdigest()
    for candidate in sorted(path.parent.glob(f"{path.name}.*")):
        if candidate.suffix.lower() in IMAGE_SUFFIXES:
            pixels = cv2.imread(str(candidate), cv2.IMREAD_UNCHANGED)
            if pixels is None:
                return None
            head = f"{pixels.shape} {pixels.dtype}".encode()
            return hashlib.sha256(head + pixels.tobytes()).hexdigest()
    return None


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _fetch(url: str, file: RemoteFile, part: Path, quiet: bool) -> None:
    import requests

    have = file_state(part)[0]
    headers = {"Range": f"bytes={have}-"} if have else {}
    with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT_SECONDS) as response:
        if response.status_code == 416:  # the file is complete; `download` checks it
            if file.checksum is None:
                part.unlink()
                raise requests.ConnectionError("the partial file belongs to another file")
            return
        response.raise_for_status()
        if response.status_code != 206:  # the server cannot resume and sends the whole file
            have = 0
        length = response.headers.get("Content-Length")
        total = have + int(length) if length else max(file.size, have)
        with (
            part.open("ab" if have else "wb") as target,
            progress(total, file.name, "B", quiet, have) as bar,
        ):
            bar.unit_scale = True
            for chunk in response.iter_content(CHUNK_BYTES):
                target.write(chunk)
                bar.update(len(chunk))
    if length and file_state(part)[0] < total:
        raise requests.ConnectionError("the connection broke off")


def _check(dataset: RemoteDataset, folder: Path, subject: str) -> None:
    count = len(find_images(folder))
    if count != dataset.images:
        raise DeepDetectError(
            f"{subject} holds {count:,} images, not {dataset.images:,}: choose another folder"
        )
    for name, digest in dataset.contents.items():
        found = content_digest(folder, name)
        if found != digest:
            state = "is missing" if found is None else "has other contents"
            raise DeepDetectError(
                f"{subject} holds another version of {dataset.name}, whose {name} {state}: "
                "get it again"
            )


def _assemble(dataset: RemoteDataset, paths: Sequence[Path], final: Path, quiet: bool) -> None:
    """Unpack the files into a temporary folder, and rename it to `final` if all is correct."""
    unfinished = final.with_name(f".{final.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        for file, path in zip(dataset.files, paths, strict=True):
            target = unfinished / file.into
            if file.name.endswith(ARCHIVE_SUFFIXES):
                _unpack(file, path, target, quiet)
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
        for name, text in dataset.texts.items():
            (unfinished / name).parent.mkdir(parents=True, exist_ok=True)
            (unfinished / name).write_text(text, encoding="utf-8")
        if dataset.prepare is not None:
            dataset.prepare(unfinished, quiet)
        _check(dataset, unfinished, "the download")
    except DeepDetectError:
        shutil.rmtree(unfinished)
        for path in paths:  # the next call would use the same wrong files again
            path.unlink()
        raise
    if final.exists():
        final.rmdir()
    unfinished.rename(final)


def _unpack(file: RemoteFile, archive: Path, target: Path, quiet: bool) -> None:
    target.mkdir(parents=True, exist_ok=True)
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as zipped:
                _extract(zipped.infolist(), lambda one: zipped.extract(one, target), quiet)
        else:
            with tarfile.open(archive) as tar:
                while tar.fileobj.read(CHUNK_BYTES):
                    pass  # reads a gzip file to its end, where its checksum is
                endings = file.suffixes or ("",)
                members = [m for m in tar if not m.isdir() and m.name.lower().endswith(endings)]
                _extract(members, lambda one: _extract_file(tar, one, target), quiet)
    except Exception as error:  # zip, tar and their compressions raise errors of many types
        if isinstance(error, OSError) and error.errno in WRITE_ERRORS:
            raise
        raise DeepDetectError(
            f"{file.urls[0]} cannot be unpacked ({first_line(error)}): try again"
        ) from None
    if file.inside and (target / file.inside).is_dir():
        for entry in sorted((target / file.inside).iterdir()):
            entry.rename(target / entry.name)
        (target / file.inside).rmdir()


def _extract_file(tar: tarfile.TarFile, member: tarfile.TarInfo, target: Path) -> None:
    """Extract a file of a tar archive into a folder. A link becomes a copy of its target.

    Python's own filter for safe extraction is not used, because it exists only since 3.11.4.
    """
    path, content = target / member.name, tar.extractfile(member)
    if content is None or not path.resolve().is_relative_to(target.resolve()):
        raise tarfile.TarError(f"{member.name!r} would lie outside the folder, or is not a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    with content, path.open("wb") as file:
        shutil.copyfileobj(content, file)


def _extract(members: Sequence[Any], extract: Callable[[Any], object], quiet: bool) -> None:
    with progress(len(members), "unpacking", "file", quiet) as bar:
        for member in members:
            extract(member)
            bar.update(1)
