"""Cut the training images from photographs in public repositories, each with its licence.

The list of crops is `known/photographs.csv.gz`. `benchmarks/list_photographs.py` of commit 81b8253
made it. The list has no near-duplicates, and no images of the data sets used for evaluation.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import json
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
from PIL import Image

from deepdetect._shared.errors import DeepDetectError
from deepdetect._shared.progress import progress
from deepdetect.io.image import load_image

from .download import RemoteFile

CROP_SIDE_PX = 480
JPEG_QUALITY = 97
"""JPEG quality of the crops. Compression then changes pixels less than image noise does, so labels
hardly change."""

VALIDATION_SHARE = 1 / 20

FREE_LICENCES = ("CC0", "CC BY", "CC BY-SA", "Unsplash")
"""Licences with these name prefixes allow any use, including of weights trained on the images."""

RESTRICTED = re.compile(r"\b(n[cd]|non-?commercial|no-?deriv\w*)\b", re.IGNORECASE)
"""Licences with these words in their names restrict use, even if they match `FREE_LICENCES`."""

LICENCES_FILE = "licences.csv"
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
SOURCES_FOLDER = "sources"


@dataclass(frozen=True)
class Source:
    """A commit of the GitHub repository "OWNER/NAME", from whose photographs crops are cut.

    `megabytes` is the size of the commit's archive. The file names of the crops begin with `name`.
    """

    name: str
    repository: str
    commit: str
    megabytes: int

    @property
    def archive(self) -> RemoteFile:
        """The archive of the commit, as a file to download."""
        owner, name = self.repository.split("/")
        return RemoteFile(
            (f"https://github.com/{owner}/{name}/archive/{self.commit}.tar.gz",),
            self.megabytes * 1_000_000,
            into=f"{SOURCES_FOLDER}/{self.name}",
            inside=f"{name}-{self.commit}",
            suffixes=PICTURE_SUFFIXES,
        )


@cache
def listed_sources() -> dict[str, Source]:
    """Return the repositories from which the listed crops are cut, by name of the source."""
    text = resources.files(__package__).joinpath("known/sources.json").read_text("utf-8")
    names = ("name", "repository", "commit", "megabytes")
    return {row["name"]: Source(*(row[name] for name in names)) for row in json.loads(text)}


@dataclass(frozen=True)
class Crop:
    """A square crop of a photograph from a `Source`.

    `path`, `sha256` and `licence` are those of the photograph. Its shorter side is scaled to
    `short_side_px`. In the scaled photograph, (x, y) is the upper left corner of the crop.
    """

    source: str
    path: str
    sha256: str
    licence: str
    short_side_px: int
    x: int
    y: int

    @property
    def is_free(self) -> bool:
        """Whether the licence allows any use. CC BY does, CC BY-NC and CC BY-ND do not."""
        return self.licence.startswith(FREE_LICENCES) and not RESTRICTED.search(self.licence)

    @property
    def part(self) -> str:
        """Part of the data set: "train" or "val". All crops of a photograph are in one part."""
        return "val" if int(self.sha256[:8], 16) < VALIDATION_SHARE * 2**32 else "train"


@cache
def listed_crops() -> tuple[Crop, ...]:
    """Return all listed crops. Crops of the same photograph follow each other in the list."""
    file = resources.files(__package__).joinpath("known/photographs.csv.gz")
    text = gzip.decompress(file.read_bytes()).decode()
    return tuple(
        Crop(*row[:4], *(int(number) for number in row[4:]))  # type: ignore[arg-type]
        for row in csv.reader(io.StringIO(text))
    )


def write_crops(folder: Path, quiet: bool, crops: Sequence[Crop]) -> None:
    """Write crops to the folders train and val, and their licences to licences.csv.

    The photographs are read from repositories in the folder sources, which is then removed. Crops
    of the same photograph must follow each other in `crops`.
    """
    rows = [("file", "picture", "licence", "sha256")]
    with progress(len(crops), "cropping", "crop", quiet) as bar:
        for number, (crop, picture) in enumerate(_cut(folder / SOURCES_FOLDER, crops)):
            file = folder / crop.part / f"{crop.source}_{number:05d}.jpg"
            file.parent.mkdir(parents=True, exist_ok=True)
            picture.save(file, quality=JPEG_QUALITY, subsampling=0)
            source = listed_sources()[crop.source]
            url = f"https://github.com/{source.repository}/blob/{source.commit}/{crop.path}"
            rows.append((file.relative_to(folder).as_posix(), url, crop.licence, crop.sha256))
            bar.update(1)
    with (folder / LICENCES_FILE).open("w", newline="", encoding="utf-8") as table:
        csv.writer(table).writerows(rows)
    shutil.rmtree(folder / SOURCES_FOLDER)


def _cut(sources: Path, crops: Sequence[Crop]) -> Iterator[tuple[Crop, Image.Image]]:
    """Yield each crop with its image. Each photograph is read only once for all of its crops."""
    for listed, of_picture in groupby(crops, attrgetter("source", "path", "sha256")):
        source, path, sha256 = listed
        try:
            content = (sources / source / path).read_bytes()
        except OSError:
            raise DeepDetectError(f"{source} has no {path}: get the archive again") from None
        if hashlib.sha256(content).hexdigest() != sha256:
            raise DeepDetectError(
                f"{path} of {source} differs from the listed photograph: get the archive again"
            )
        picture = Image.fromarray(load_image(content))
        for crop in of_picture:
            yield crop, cut(picture, crop.short_side_px, crop.x, crop.y)


def cut(picture: Image.Image, short_side_px: int, x: int, y: int) -> Image.Image:
    """Scale a photograph to the shorter side `short_side_px`, and crop a square at (x, y)."""
    scale = short_side_px / min(picture.size)
    size = [max(short_side_px, round(side * scale)) for side in picture.size]
    # Only the crop is scaled, because some photographs have 100 megapixels.
    box = np.array([x, y, x + CROP_SIDE_PX, y + CROP_SIDE_PX]) * (
        np.array(picture.size * 2) / np.array(size * 2)
    )
    return picture.resize(
        (CROP_SIDE_PX, CROP_SIDE_PX), Image.Resampling.LANCZOS, tuple(box.tolist())
    )
