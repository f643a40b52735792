"""Downloading one file: mirrors, checksum, resuming, through pooch."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from .._shared.errors import DeepDetectError
from .._shared.progress import progress

CHUNK = 1 << 16  # bytes; so many are lost when a download is broken off
TIMEOUT = 60  # seconds without a byte
ARCHIVES = (".zip", ".tar.gz", ".tgz", ".tar")


@dataclass(frozen=True)
class RemoteFile:
    """A file on the web.

    Attributes:
        urls: its official host first, then mirrors; the next one is asked when one fails.
        size: bytes, roughly.
        checksum: "md5:..." or "sha256:..."; None where none is known: then the SHA-256 that the
            host itself states is checked, if it does, and the contents of the data set.
        into: in the data set, the folder that an archive is unpacked into, or the path of a
            single file.
        inside: folder of the archive whose contents are taken.
    """

    urls: tuple[str, ...]
    size: int
    checksum: str | None = None
    into: str = "."
    inside: str = ""

    @property
    def name(self) -> str:
        """The file's name on its host."""
        return Path(urlsplit(self.urls[0]).path).name

    @property
    def is_archive(self) -> bool:
        """Whether it is unpacked."""
        return self.name.endswith(ARCHIVES)


def have_pooch() -> bool:
    """Tell whether pooch is installed."""
    return importlib.util.find_spec("pooch") is not None


def partial_size(path: Path) -> int:
    """Return how many bytes of a file are there from a download that was broken off."""
    part = _part(path)
    return part.stat().st_size if part.exists() else 0


def download(file: RemoteFile, path: Path, *, quiet: bool = True) -> None:
    """Download a file; it appears when it is whole and its checksum right.

    Args:
        file: what, and from where.
        path: the final path.
        quiet: show no progress bar.

    Raises:
        DeepDetectError: no host gives it; the last one's trouble is told.
    """
    failed: DeepDetectError | None = None
    for k, url in enumerate(file.urls):
        if k and file.checksum is None:
            _part(path).unlink(missing_ok=True)  # nothing tells that the hosts' bytes are the same
        try:
            _download_from(url, file, path, quiet)
            return
        except DeepDetectError as error:
            failed = error
    assert failed is not None
    raise failed


def _part(path: Path) -> Path:
    return path.with_name(f"{path.name}.part")


def _download_from(url: str, file: RemoteFile, path: Path, quiet: bool) -> None:
    import pooch
    from requests import HTTPError, RequestException

    part = _part(path)
    pooch.get_logger().setLevel("WARNING")  # the progress bar says enough
    try:
        pooch.retrieve(
            url,
            file.checksum,
            fname=path.name,
            path=path.parent,
            downloader=_resuming(part, file, quiet),
        )
    except HTTPError as error:
        raise DeepDetectError(
            f"{url} cannot be downloaded (the server answers "
            f"{error.response.status_code}): try again later"
        ) from None
    except RequestException as error:
        raise DeepDetectError(
            f"{url} cannot be downloaded ({error.__class__.__name__}): "
            "give the same command again to go on where it stopped"
        ) from None
    except ValueError:  # pooch's word for a wrong checksum
        part.unlink(missing_ok=True)
        raise _wrong_bytes(url, str(file.checksum)) from None
    part.unlink(missing_ok=True)


def _wrong_bytes(url: str, checksum: str) -> DeepDetectError:
    return DeepDetectError(
        f"{url} has another checksum than {checksum}: "
        "it has changed or was damaged on the way; try again later"
    )


def _resuming(part: Path, file: RemoteFile, quiet: bool) -> Callable[..., None]:
    """Make a downloader for pooch that keeps what it has got when it is broken off."""

    def fetch(url: str, output: str, _: Any) -> None:
        import requests

        have = part.stat().st_size if part.exists() else 0
        headers = {"Range": f"bytes={have}-"} if have else {}
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
            if response.status_code == 416:  # nothing is missing, as the checksum will tell
                if file.checksum is None:
                    part.unlink()
                    raise requests.ConnectionError("what is there is of another file")
                _second_name(part, Path(output))
                return
            response.raise_for_status()
            if response.status_code != 206:  # the server sends all of it again
                have = 0
            length = response.headers.get("Content-Length")
            total = have + int(length) if length else max(file.size, have)
            with (
                part.open("ab" if have else "wb") as target,
                progress(total, file.name, "B", quiet, have) as bar,
            ):
                bar.unit_scale = True
                for chunk in response.iter_content(CHUNK):
                    target.write(chunk)
                    bar.update(len(chunk))
        if length and part.stat().st_size < total:
            raise requests.ConnectionError("the connection broke off")
        if file.checksum is None:
            _check_stated(url, response, part)
        _second_name(part, Path(output))

    return fetch


def _check_stated(url: str, response: Any, part: Path) -> None:
    """Check a file against the SHA-256 that its host states on the way to it.

    Hugging Face's hub names that of a large file in a header of its redirection (`X-Linked-Etag`
    in huggingface_hub's file_download.py).
    """
    import pooch

    for answer in (*response.history, response):
        stated = answer.headers.get("X-Linked-Etag", "").strip('"').lower()
        if re.fullmatch("[0-9a-f]{64}", stated) and pooch.file_hash(part, "sha256") != stated:
            part.unlink()
            raise _wrong_bytes(url, f"sha256:{stated}, which the host states")


def _second_name(part: Path, output: Path) -> None:
    """Give the file to pooch, which deletes it when it is stopped, and keep it."""
    output.unlink(missing_ok=True)
    try:
        output.hardlink_to(part)
    except OSError:  # a file system without links
        shutil.copyfile(part, output)
