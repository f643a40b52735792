"""Archives of data sets, and shards."""

from __future__ import annotations

import io
import json
import os
import tarfile
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from deepdetect_lab.datasets.download import RemoteFile, _unpack

from ..case import Target, expect, prepared
from ..mutations import mutate
from .images import scene

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


def shard_options() -> Any:
    """Return the recipe of the shards."""
    from deepdetect_lab.labels import LabelOptions
    from deepdetect_lab.training.recipe import Stage, TrainingOptions

    labels = LabelOptions(("fast", "sobel"))
    return TrainingOptions(
        stages=(Stage(32, 2, 1),), short_sides=(48,), labels=labels, val_fraction=0.3
    )


@prepared
def shard_files() -> dict[str, bytes]:
    """Return the files of a folder of shards of three images."""
    from deepdetect_lab.training.shards import write_shards

    with tempfile.TemporaryDirectory() as folder:
        images, output = Path(folder) / "images", Path(folder) / "shards"
        images.mkdir()
        for k in range(6):
            Image.fromarray(np.roll(scene(), 5 * k, axis=1)).save(images / f"photo-{k}.png")
        write_shards(images, output, shard_options(), workers=1)
        return {path.name: path.read_bytes() for path in output.iterdir()}


def shards(generator: np.random.Generator, folder: Path) -> None:
    """Read all images of shards of which one file is damaged."""
    from deepdetect_lab.training.shards import Shards, ShardSource

    options = shard_options()
    files = dict(shard_files())
    name = str(generator.choice(sorted(files)))
    if name == "shards.json" and generator.random() < 0.5:
        index = json.loads(files[name])
        row = index["training"][0]
        strange = ["/etc/passwd", "../secret.tar", "", None, 3, "\x00", {}]
        row["file"] = strange[int(generator.integers(len(strange)))]
        if generator.random() < 0.3:
            row["images"] = [-1, 10**9, None, "x", 1.5][int(generator.integers(5))]
        files[name] = json.dumps(index).encode()
    else:
        files[name] = mutate(files[name], generator)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    found = Shards.open(folder, options)
    for part in (found.training, found.validation):
        for path, _ in part:
            expect(path.parent == folder, f"a shard outside the folder: {path}")
        source = ShardSource(part, options)
        for k in range(min(len(source), 5)):
            image = source[k]
            for view in (*image.normal, *image.dark):
                if part is found.validation and view.augmentation is not None:
                    continue  # those are for training
                pixels, mask = source.load(k, view)
                expect(mask.shape == pixels.shape[:2], "a label of another size")


TARGETS = (
    Target("archives", "archives (zip, tar)", archives, 900),
    Target("shards", "shards", shards, 700, 350),
)
