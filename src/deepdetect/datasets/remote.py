"""Data sets on the web: downloaded with their checksum by pooch, and unpacked whole."""

from __future__ import annotations

import importlib.util
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import DeepDetectError, MissingExtraError
from ..image import find_images
from ..progress import progress

CHUNK = 1 << 16  # bytes; so many are lost when a download is broken off
TIMEOUT = 60  # seconds without a byte


@dataclass(frozen=True)
class RemoteDataset:
    """A zip archive of images on the web.

    Attributes:
        name: the name users choose it by.
        title: what it is.
        url: the archive.
        checksum: "md5:..." or "sha256:...", as its makers or many users give it.
        size: bytes of the archive.
        images: number of images.
        licence: what they may be used for.
    """

    name: str
    title: str
    url: str
    checksum: str
    size: int
    images: int
    licence: str


def get_dataset(dataset: RemoteDataset, folder: str | Path, *, quiet: bool = True) -> Path:
    """Download and unpack a data set; what is there already is not done again.

    A download that was broken off goes on where it stopped. The folder appears when all
    images are in it; then the archive is removed.

    Args:
        dataset: the data set.
        folder: where its images go.
        quiet: show no progress bar.

    Returns:
        The folder.

    Raises:
        MissingExtraError: pooch is not installed.
        DeepDetectError: the download fails, its checksum is wrong, there is no room, or
            the folder holds something else.
    """
    if importlib.util.find_spec("pooch") is None:
        raise MissingExtraError(
            "downloading data sets needs the package pooch, which is not installed: "
            "run pip install pooch"
        )
    final = Path(folder)
    if final.is_dir() and any(final.iterdir()):
        _check_count(dataset, final, f"{final} is there and")
        return final
    archive = final.with_name(f"{final.name}.zip")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        if not archive.exists():
            # As much again, for what is unpacked.
            _need_room(final.parent, 2 * dataset.size - _size(_part(archive)))
            _download(dataset, archive, quiet)
        _need_room(final.parent, dataset.size)
        _unpack(dataset, archive, final, quiet)
        archive.unlink()
    except OSError as error:
        raise DeepDetectError(
            f"cannot write {final} ({error.strerror or error}): make room or choose another place"
        ) from None
    return final


def _need_room(folder: Path, needed: int) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise DeepDetectError(
            f"{folder} has {free / 1e9:.0f} GB free, {needed / 1e9:.0f} GB are needed: "
            "make room or choose another place with -o"
        )


def _part(archive: Path) -> Path:
    return archive.with_name(f"{archive.name}.part")


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _download(dataset: RemoteDataset, archive: Path, quiet: bool) -> None:
    import pooch
    from requests import HTTPError, RequestException

    part = _part(archive)
    pooch.get_logger().setLevel("WARNING")  # the progress bar says enough
    try:
        pooch.retrieve(
            dataset.url,
            dataset.checksum,
            fname=archive.name,
            path=archive.parent,
            downloader=_resuming(part, dataset, quiet),
        )
    except HTTPError as error:
        raise DeepDetectError(
            f"{dataset.url} cannot be downloaded (the server answers "
            f"{error.response.status_code}): try again later"
        ) from None
    except RequestException as error:
        raise DeepDetectError(
            f"{dataset.url} cannot be downloaded ({error.__class__.__name__}): "
            "give the same command again to go on where it stopped"
        ) from None
    except ValueError:  # pooch's word for a wrong checksum
        part.unlink(missing_ok=True)
        raise DeepDetectError(
            f"{dataset.url} has another checksum than {dataset.checksum}: "
            "it has changed or was damaged on the way; try again later"
        ) from None
    part.unlink(missing_ok=True)


def _resuming(part: Path, dataset: RemoteDataset, quiet: bool) -> Callable[..., None]:
    """Make a downloader for pooch that keeps what it has got when it is broken off."""

    def download(url: str, output: str, _: Any) -> None:
        import requests

        have = _size(part)
        headers = {"Range": f"bytes={have}-"} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
            if response.status_code == 416:  # nothing is missing
                _second_name(part, Path(output))
                return
            response.raise_for_status()
            if response.status_code != 206:  # the server sends all of it again
                have = 0
            total = have + int(response.headers.get("Content-Length", dataset.size - have))
            with (
                part.open("ab" if have else "wb") as file,
                progress(total, dataset.name, "B", quiet, have) as bar,
            ):
                bar.unit_scale = True
                for chunk in response.iter_content(CHUNK):
                    file.write(chunk)
                    bar.update(len(chunk))
        if part.stat().st_size < total:
            raise requests.ConnectionError("the connection broke off")
        _second_name(part, Path(output))

    return download


def _second_name(part: Path, output: Path) -> None:
    """Give the file to pooch, which deletes it when it is stopped, and keep it."""
    output.unlink(missing_ok=True)
    try:
        output.hardlink_to(part)
    except OSError:  # a file system without links
        shutil.copyfile(part, output)


def _check_count(dataset: RemoteDataset, folder: Path, subject: str) -> None:
    count = len(find_images(folder))
    if count != dataset.images:
        raise DeepDetectError(
            f"{subject} holds {count:,} images, not the {dataset.images:,} of {dataset.name}: "
            "choose another folder with -o"
        )


def _unpack(dataset: RemoteDataset, archive: Path, final: Path, quiet: bool) -> None:
    """Unpack into a folder beside the final one, and rename it when all is there."""
    unfinished = final.with_name(f".{final.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with zipfile.ZipFile(archive) as file:
            members = file.infolist()
            with progress(len(members), "unpacking", "file", quiet) as bar:
                for member in members:
                    file.extract(member, unfinished)
                    bar.update(1)
    except zipfile.BadZipFile:
        raise DeepDetectError(f"{archive} is no zip archive: delete it and try again") from None
    _check_count(dataset, unfinished, str(archive))
    if final.exists():
        final.rmdir()
    unfinished.rename(final)
