from __future__ import annotations

import functools
import hashlib
import http.server
import io
import json
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

import deepdetect_lab.datasets.download as download
from deepdetect import DeepDetectError
from deepdetect_lab.datasets import (
    RemoteDataset,
    RemoteFile,
    get_dataset,
    remote_datasets,
)
from deepdetect_lab.datasets.download import content_digest

NAMES = [f"train/{k:04d}.jpg" for k in range(5)]


class Server(http.server.ThreadingHTTPServer):
    """Serves one archive on loopback, by ranges; it can break off after some bytes."""

    daemon_threads = True
    content = b""
    break_after: int | None = None

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.ranges: list[str | None] = []
        self.contents: dict[str, bytes] = {}

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/train.zip"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        self.server.ranges.append(asked)
        first = 0
        content = self.server.contents.get(self.path, self.server.content)
        if asked:
            first = int(asked.removeprefix("bytes=").removesuffix("-"))
            if first >= len(content):
                self.send_error(416)
                return
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(content) - first))
        self.end_headers()
        part = content[first:]
        self.wfile.write(part[: self.server.break_after])

    def log_message(self, *arguments: object) -> None:
        pass


def archive() -> bytes:
    """A zip archive of five files that do not compress, 1 MB together."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for k, name in enumerate(NAMES):
            noise = b"".join(
                hashlib.sha256(f"{k} {block}".encode()).digest() for block in range(6500)
            )
            file.writestr(name, noise)
    return buffer.getvalue()


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as made:
        made.content = archive()
        thread = threading.Thread(target=functools.partial(made.serve_forever, 0.01), daemon=True)
        thread.start()
        yield made
        made.shutdown()


@pytest.fixture
def dataset(server: Server) -> RemoteDataset:
    checksum = "md5:" + hashlib.md5(server.content).hexdigest()
    file = RemoteFile((server.url,), len(server.content), checksum)
    return RemoteDataset("tiny", "a test", (file,), 5, "none")


def with_file(dataset: RemoteDataset, **changes: object) -> RemoteDataset:
    """The data set, with its only file changed."""
    return replace(dataset, files=(replace(dataset.files[0], **changes),))


def unpacked(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.jpg"))


def test_what_is_there_is_not_done_again(
    dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    for _ in range(2):
        folder = get_dataset(dataset, tmp_path / "data" / "tiny")
        assert unpacked(folder) == NAMES
        assert [path.name for path in folder.parent.iterdir()] == ["tiny"], "nothing else is left"
    assert len(server.ranges) == 1


def test_a_download_goes_on_where_it_was_broken_off(
    dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    server.break_after = 400_000
    with pytest.raises(DeepDetectError):
        get_dataset(dataset, tmp_path / "tiny")
    assert not (tmp_path / "tiny").exists()
    server.break_after = None
    assert unpacked(get_dataset(dataset, tmp_path / "tiny")) == NAMES
    first, second = server.ranges
    assert first is None
    assert second is not None
    assert 300_000 < int(second.removeprefix("bytes=").removesuffix("-")) <= 400_000


def test_a_wrong_checksum_is_refused_and_nothing_stays(
    dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    server.content = server.content[:-1] + b"?"
    with pytest.raises(DeepDetectError):
        get_dataset(dataset, tmp_path / "tiny")
    assert list(tmp_path.iterdir()) == []


def test_a_stop_while_the_checksum_is_taken_loses_nothing(
    dataset: RemoteDataset, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*arguments: object, **options: object) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(download, "has_checksum", stopped)
        with pytest.raises(KeyboardInterrupt):
            get_dataset(dataset, tmp_path / "tiny")
    left = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")]
    assert left == ["tiny.download", "tiny.download/00-train.zip.part"]
    assert unpacked(get_dataset(dataset, tmp_path / "tiny")) == NAMES
    assert server.ranges == [None, f"bytes={len(server.content)}-"], "no byte came twice"


def test_a_folder_of_something_else_is_refused(
    dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "mine.jpg").touch()
    with pytest.raises(DeepDetectError):
        get_dataset(dataset, tmp_path / "tiny")
    assert server.ranges == []


def test_a_mirror_is_asked_when_a_host_fails_or_sends_wrong_bytes(
    dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    good = server.content
    bad = good[:-1] + b"?"
    server.contents = {"/train.zip": bad, "/mirror.zip": good}
    urls = "http://127.0.0.1:9/train.zip", server.url, server.url.replace("train", "mirror")
    assert unpacked(get_dataset(with_file(dataset, urls=urls), tmp_path / "tiny")) == NAMES
    assert server.ranges == [None, None], "nothing of the wrong bytes is kept"


def tar_of(names: list[str]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as file:
        for k, name in enumerate(names):
            picture = io.BytesIO()
            Image.new("RGB", (8, 8), (k, 0, 0)).save(picture, "PPM")
            entry = tarfile.TarInfo(name)
            entry.size = len(picture.getvalue())
            file.addfile(entry, io.BytesIO(picture.getvalue()))
    return buffer.getvalue()


def test_archives_and_single_files_are_put_together(server: Server, tmp_path: Path) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (8, 8), (1, 0, 0)).save(picture, "PNG")
    server.contents = {
        "/a.tar.gz": tar_of(["top/img1.ppm", "top/img2.ppm"]),
        "/b.png": picture.getvalue(),
    }
    root = server.url.removesuffix("/train.zip")
    made = RemoteDataset(
        "mixed",
        "a test",
        (
            RemoteFile((f"{root}/a.tar.gz",), 100, into="scene", inside="top"),
            RemoteFile((f"{root}/b.png",), 100, into="other/left.png"),
        ),
        3,
        "none",
        texts={"other/calib.json": "{}\n"},
    )
    folder = get_dataset(made, tmp_path / "mixed")
    found = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    assert found == ["other/calib.json", "other/left.png", "scene/img1.ppm", "scene/img2.ppm"]
    # The second picture of the archive is the same one in another format.
    same = content_digest(folder, "other/left")
    assert same == content_digest(folder, "scene/img2") != content_digest(folder, "scene/img1")
    checked = replace(made, contents={"scene/img2": same})
    assert get_dataset(checked, tmp_path / "again").is_dir()
    for name in ("scene/img1", "scene/img9"):
        with pytest.raises(DeepDetectError, match=name):
            get_dataset(replace(made, contents={name: same}), tmp_path / "wrong")
        assert not (tmp_path / "wrong").exists()
        assert not (tmp_path / "wrong.download").exists()


def zipped(names: list[str]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name in names:
            file.writestr(name, b"content")
    return buffer.getvalue()


DAMAGED_ARCHIVES = {
    "a name too long": zipped(["a" * 300 + ".jpg"]),
    "a file that is a folder, too": zipped(["a.jpg", "a.jpg/b.jpg"]),
    "an offset before its start": archive()[600_000:],
    "a wrong checksum of gzip": tar_of(NAMES)[:-6] + bytes(6),
}


@pytest.mark.parametrize("kind", DAMAGED_ARCHIVES)
def test_damaged_archives_are_one_sentence_and_do_not_stay(
    kind: str, dataset: RemoteDataset, server: Server, tmp_path: Path
) -> None:
    server.content = DAMAGED_ARCHIVES[kind]
    with pytest.raises(DeepDetectError, match=server.url):
        get_dataset(with_file(dataset, checksum=None), tmp_path / "tiny")
    assert list(tmp_path.iterdir()) == []
    server.content = archive()
    assert unpacked(get_dataset(with_file(dataset, checksum=None), tmp_path / "tiny")) == NAMES


@pytest.mark.parametrize("name", ["oxford", "middlebury", "hpatches"])
def test_the_known_contents_are_those_of_the_reference_data(shared: Path, name: str) -> None:
    dataset = remote_datasets()[name]
    assert dataset.contents
    for path, digest in list(dataset.contents.items())[:12]:
        assert content_digest(shared / "data" / name, path) == digest
    for path, text in dataset.texts.items():
        ours, theirs = json.loads(text), json.loads((shared / "data" / name / path).read_text())
        truth, reference = (values.pop("ground_truth", {}) for values in (ours, theirs))
        assert ours == pytest.approx({key: theirs[key] for key in ours})
        assert truth == pytest.approx({key: reference[key] for key in truth})


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("../outside.txt", tarfile.REGTYPE),
        ("/outside.txt", tarfile.REGTYPE),
        ("link", tarfile.SYMTYPE),
        ("device", tarfile.CHRTYPE),
    ],
)
def test_no_member_leads_outside(name: str, kind: bytes, tmp_path: Path) -> None:
    archive, target = tmp_path / "archive.tar", tmp_path / "data" / "target"
    with tarfile.open(archive, "w") as tar:
        good = tarfile.TarInfo("folder/image.txt")
        good.size = 3
        tar.addfile(good, io.BytesIO(b"yes"))
        member = tarfile.TarInfo(name)
        member.type, member.linkname = kind, "/etc/passwd"
        tar.addfile(member)
    with pytest.raises(DeepDetectError):
        download._unpack(RemoteFile(("https://example.org/a.tar",), 1), archive, target, True)
    assert (target / "folder" / "image.txt").read_bytes() == b"yes"
    assert not (target / "link").is_symlink()
    assert not list(tmp_path.glob("outside*"))
    assert not Path("/outside.txt").exists()


def test_an_archive_may_be_unpacked_in_part_and_prepared(server: Server, tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name in ("repo-1/a.JPG", "repo-1/b.txt", "repo-1/sub/c.jpg"):
            member = tarfile.TarInfo(name)
            member.size = len(name)
            tar.addfile(member, io.BytesIO(name.encode()))
    server.contents["/archive/1.tar.gz"] = buffer.getvalue()
    url = server.url.replace("/train.zip", "/archive/1.tar.gz")
    file = RemoteFile((url,), 1000, into="sources", inside="repo-1", suffixes=(".jpg",))
    seen: list[str] = []

    def prepare(folder: Path, quiet: bool) -> None:
        seen.extend(
            path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
        )
        (folder / "sources" / "sub" / "c.jpg").rename(folder / "c.jpg")
        (folder / "sources" / "a.JPG").unlink()

    made = RemoteDataset("tiny", "a test", (file,), 1, "none", prepare=prepare)
    folder = get_dataset(made, tmp_path / "tiny")
    assert sorted(seen) == ["sources/a.JPG", "sources/sub/c.jpg"]
    assert unpacked(folder) == ["c.jpg"]
