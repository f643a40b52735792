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
        DeepDetectError: the download fails, its checksum is wrong, or there is no room.
    """
    if importlib.util.find_spec("pooch") is None:
        raise MissingExtraError(
            "downloading data sets needs the package pooch, which is not installed: "
            "run pip install pooch"
        )
    final = Path(folder)
    if final.exists():
        return final
    archive = final.with_name(f"{final.name}.zip")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        if not archive.exists():
            # As much again as is missing, for what is unpacked.
            _need_room(final.parent, 2 * dataset.size - _size(_part(archive)))
        _download(dataset, archive, quiet)
        _unpack(archive, final, quiet)
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
    from requests import RequestException

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
    except RequestException as error:
        raise DeepDetectError(
            f"{dataset.url} cannot be downloaded ({error.__class__.__name__}): "
            "give the same command again to go on where it stopped"
        ) from None
    except ValueError:  # pooch's word for a wrong checksum
        raise DeepDetectError(
            f"{dataset.url} has another checksum than {dataset.checksum}: "
            "it has changed or was damaged on the way; try again later"
        ) from None


def _resuming(part: Path, dataset: RemoteDataset, quiet: bool) -> Callable[..., None]:
    """Make a downloader for pooch that keeps what it has got when it is broken off."""

    def download(url: str, output: str, _: Any) -> None:
        import requests

        have = _size(part)
        headers = {"Range": f"bytes={have}-"} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
            if response.status_code == 416:  # nothing is missing
                shutil.move(part, output)
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
        shutil.move(part, output)

    return download


def _unpack(archive: Path, final: Path, quiet: bool) -> None:
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
    unfinished.rename(final)
