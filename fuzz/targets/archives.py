"""Archives of data sets."""

from __future__ import annotations

import io
import os
import tarfile
import zipfile
from pathlib import Path

import numpy as np

from deepdetect_lab.datasets.download import RemoteFile, _unpack

from ..case import Target, expect
from ..mutations import mutate

NAMES = (
    *("image.png", "folder/image.png", "../outside.png", "/tmp/fuzz-outside.png", "a/../../b"),
    *("..\\outside.png", "", ".", "con", "x" * 300, "a\x00b", "folder/"),
)


def archives(generator: np.random.Generator, folder: Path) -> None:
    """Unpack archives that are damaged, or name files outside their folder."""
    kind = str(generator.choice(["zip", "tar", "tar.gz"]))
    content = zip_file(generator) if kind == "zip" else tar_file(generator, kind == "tar.gz")
    if generator.random() < 0.7:
        content = mutate(content, generator)
    path = folder / f"archive.{kind}"
    path.write_bytes(content)
    target = folder / "inside" / "target"
    file = RemoteFile((f"https://example.org/archive.{kind}",), len(content))
    try:
        _unpack(file, path, target, quiet=True)
    finally:
        outside = [
            each
            for each in folder.rglob("*")
            if each not in (path, target.parent, target) and not each.is_relative_to(target)
        ]
        expect(not outside, f"files outside the folder: {outside}")
        expect(not Path("/tmp/fuzz-outside.png").exists(), "a file at an absolute path")
        for each in target.rglob("*"):
            inside = Path(os.path.realpath(each)).is_relative_to(os.path.realpath(target))
            expect(inside, f"{each} leads outside the folder")


def zip_file(generator: np.random.Generator) -> bytes:
    """Return a zip archive of one to three members."""
    file = io.BytesIO()
    method = int(generator.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA]))
    with zipfile.ZipFile(file, "w", method) as archive:
        for k in range(int(generator.integers(1, 4))):
            name = str(generator.choice(NAMES)) if generator.random() < 0.5 else f"{k}.txt"
            archive.writestr(zipfile.ZipInfo(name), generator.bytes(100), method)
    content = bytearray(file.getvalue())
    if generator.random() < 0.2:  # says that it is encrypted, or of another version or method
        for signature, at in ((b"PK\x03\x04", 4), (b"PK\x01\x02", 6)):
            start = content.find(signature)
            shift = int(generator.choice([0, 2, 4]))
            content[start + at + shift] = int(generator.choice([1, 99, 255]))
    return bytes(content)


def tar_file(generator: np.random.Generator, compressed: bool) -> bytes:
    """Return a tar archive of files, links and devices."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:gz" if compressed else "w") as archive:
        for k in range(int(generator.integers(1, 4))):
            name = str(generator.choice(NAMES)) if generator.random() < 0.5 else f"{k}.txt"
            member = tarfile.TarInfo(name.replace("\x00", ""))
            kinds = [tarfile.REGTYPE, tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE]
            member.type = kinds[int(generator.choice(4, p=[0.7, 0.15, 0.1, 0.05]))]
            if member.type == tarfile.REGTYPE:
                member.size = 100
                archive.addfile(member, io.BytesIO(generator.bytes(100)))
            else:
                member.linkname = str(generator.choice(["/etc/passwd", "../../outside", "0.txt"]))
                archive.addfile(member)
    return file.getvalue()


TARGETS = (Target("archives", "archives (zip, tar)", archives, 900),)
