"""Data sets on the web: what they are made of, and how they are put together."""

from __future__ import annotations

import gzip
import shutil
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._shared.errors import DeepDetectError, MissingExtraError
from .._shared.progress import progress
from ..io.image import find_images
from .contents import content_digest
from .download import RemoteFile, download, have_pooch, partial_size

GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class RemoteDataset:
    """A data set of images on the web.

    Attributes:
        name: the name users choose it by.
        title: what it is.
        files: archives, which are unpacked, and single files.
        images: number of images.
        licence: what they may be used for.
        contents: by path in the data set, the digest of what is in a file (`content_digest`):
            it holds whichever archive and image format the file came in.
        texts: files that are written, not downloaded, by path in the data set.
    """

    name: str
    title: str
    files: tuple[RemoteFile, ...]
    images: int
    licence: str
    contents: Mapping[str, str] = field(default_factory=dict, repr=False)
    texts: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def size(self) -> int:
        """Bytes of the download."""
        return sum(file.size for file in self.files)


def get_dataset(dataset: RemoteDataset, folder: str | Path, *, quiet: bool = True) -> Path:
    """Download and unpack a data set; what is there already is not done again.

    A download that was broken off goes on where it stopped. The folder appears when all
    images are in it and are the right ones; then the archives are removed.

    Args:
        dataset: the data set.
        folder: where its images go.
        quiet: show no progress bar.

    Returns:
        The folder.

    Raises:
        MissingExtraError: pooch is not installed.
        DeepDetectError: the download fails, a checksum is wrong, there is no room, or
            the folder holds something else.
    """
    if not have_pooch():
        raise MissingExtraError(
            "downloading data sets needs the package pooch, which is not installed: "
            "run pip install pooch"
        )
    final = Path(folder)
    if final.is_dir() and any(final.iterdir()):
        _check(dataset, final, f"{final} is there and")
        return final
    store = final.with_name(f"{final.name}.download")
    try:
        store.mkdir(parents=True, exist_ok=True)
        paths = [store / f"{k:02d}-{file.name}" for k, file in enumerate(dataset.files)]
        missing = [
            (file, path)
            for file, path in zip(dataset.files, paths, strict=True)
            if not path.exists()
        ]
        # As much again, for what is unpacked.
        there = sum(partial_size(path) for _, path in missing)
        _need_room(store, dataset.size + sum(file.size for file, _ in missing) - there)
        for file, path in missing:
            download(file, path, quiet=quiet)
        _put_together(dataset, paths, final, quiet)
        shutil.rmtree(store)
    except DeepDetectError:
        if store.is_dir() and not any(store.iterdir()):
            store.rmdir()
        raise
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): make room or choose another place"
        ) from None
    return final


def _need_room(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise DeepDetectError(
            f"{folder.parent} has {free / 1e9:.1f} GB free, {needed / 1e9:.1f} GB are needed: "
            "make room or choose another place with -o"
        )


def _check(dataset: RemoteDataset, folder: Path, subject: str) -> None:
    """Make sure that the folder holds the data set."""
    count = len(find_images(folder))
    if count != dataset.images:
        raise DeepDetectError(
            f"{subject} holds {count:,} images, not the {dataset.images:,} of {dataset.name}: "
            "choose another folder with -o"
        )
    for name, digest in dataset.contents.items():
        found = content_digest(folder, name)
        if found != digest:
            state = "is missing" if found is None else "is not the one of the data set"
            raise DeepDetectError(
                f"{subject} holds another {dataset.name}: {name} {state}; "
                "it has changed or was damaged on the way"
            )


def _put_together(dataset: RemoteDataset, paths: list[Path], final: Path, quiet: bool) -> None:
    """Unpack into a folder beside the final one, and rename it when all is there and right."""
    unfinished = final.with_name(f".{final.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        for file, path in zip(dataset.files, paths, strict=True):
            _place(file, path, unfinished / file.into, quiet)
        for name, text in dataset.texts.items():
            (unfinished / name).parent.mkdir(parents=True, exist_ok=True)
            (unfinished / name).write_text(text, encoding="utf-8")
        _check(dataset, unfinished, "the download")
    except DeepDetectError:
        shutil.rmtree(unfinished)
        for path in paths:  # else the same wrong files would be taken again
            path.unlink()
        raise
    if final.exists():
        final.rmdir()
    unfinished.rename(final)


def _place(file: RemoteFile, path: Path, target: Path, quiet: bool) -> None:
    """Put a downloaded file to its place, or what is in it."""
    if not file.is_archive:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        return
    target.mkdir(parents=True, exist_ok=True)
    try:
        _unpack(path, target, file.inside, quiet)
    except (zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError):
        raise DeepDetectError(
            f"{file.urls[0]} is no archive that can be unpacked: try again"
        ) from None


def _unpack(archive: Path, target: Path, inside: str, quiet: bool) -> None:
    """Unpack a zip or tar archive; what lies below its folder `inside` is moved up."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as file:
            _each(file.infolist(), lambda member: file.extract(member, target), quiet)
    else:
        _check_gzip(archive)
        with tarfile.open(archive) as tar:
            _each(tar.getmembers(), lambda one: tar.extract(one, target, filter="data"), quiet)
    if inside and (target / inside).is_dir():
        for entry in sorted((target / inside).iterdir()):
            entry.rename(target / entry.name)
        (target / inside).rmdir()


def _check_gzip(archive: Path) -> None:
    """Read a gzip file to its end, where its checksum is: unpacking a tar stops before it."""
    with archive.open("rb") as start:
        if start.read(2) != GZIP:
            return
    with gzip.open(archive) as file:
        while file.read(1 << 20):
            pass


def _each(members: list[Any], extract: Callable[[Any], object], quiet: bool) -> None:
    with progress(len(members), "unpacking", "file", quiet) as bar:
        for member in members:
            extract(member)
            bar.update(1)
