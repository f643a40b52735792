"""Training photographs: crops of photographs in public repositories, each with its licence.

`benchmarks/list_photographs.py` of commit 81b8253 made the list `known/photographs.csv.gz`. It has
no near-duplicates and no images of the data sets used for evaluation.
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
"""Labels hardly change at this JPEG quality, because compression errors are smaller than image
noise."""

VALIDATION_SHARE = 1 / 20

FREE_LICENCES = ("CC0", "CC BY", "CC BY-SA", "Unsplash")
"""Prefixes of licences that allow any use, including use of weights trained on the images."""

RESTRICTED = re.compile(r"\b(n[cd]|non-?commercial|no-?deriv\w*)\b", re.IGNORECASE)
"""Restrictions in the names of licences that begin like a free licence."""

LICENCES_FILE = "licences.csv"
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
SOURCES_FOLDER = "sources"


@dataclass(frozen=True)
class Source:
    """A GitHub repository "OWNER/NAME" at a commit, as source of crops.

    `megabytes` is the size of its archive. The names of its crops begin with `name`.
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
    """Return the repositories of the listed crops, by name."""
    text = resources.files(__package__).joinpath("known/sources.json").read_text("utf-8")
    names = ("name", "repository", "commit", "megabytes")
    return {row["name"]: Source(*(row[name] for name in names)) for row in json.loads(text)}


@dataclass(frozen=True)
class Crop:
    """A square crop of a photograph of a `Source`, with its licence and the SHA-256 of its file.

    The photograph is scaled to a shorter side of `short_side_px`; (x, y) is the upper left corner.
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
        """Whether the licence allows any use, like CC BY, and unlike CC BY-NC and CC BY-ND."""
        return self.licence.startswith(FREE_LICENCES) and not RESTRICTED.search(self.licence)

    @property
    def part(self) -> str:
        """Part of the data set, "train" or "val", the same for all crops of a photograph."""
        return "val" if int(self.sha256[:8], 16) < VALIDATION_SHARE * 2**32 else "train"


@cache
def listed_crops() -> tuple[Crop, ...]:
    """Return all crops. The crops of one photograph follow each other."""
    file = resources.files(__package__).joinpath("known/photographs.csv.gz")
    text = gzip.decompress(file.read_bytes()).decode()
    return tuple(
        Crop(*row[:4], *(int(number) for number in row[4:]))  # type: ignore[arg-type]
        for row in csv.reader(io.StringIO(text))
    )


def write_crops(folder: Path, quiet: bool, crops: Sequence[Crop]) -> None:
    """Replace the repositories in `sources` by crops in `train` and `val`, and licences.csv.

    Crops of the same photograph must follow each other.
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
    """Yield each crop with its image. A photograph is read once for all of its crops."""
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
    """Scale a photograph and crop a square of `CROP_SIDE_PX`."""
    scale = short_side_px / min(picture.size)
    size = [max(short_side_px, round(side * scale)) for side in picture.size]
    # Only the crop is scaled, because some photographs have 100 megapixels.
    box = np.array([x, y, x + CROP_SIDE_PX, y + CROP_SIDE_PX]) * (
        np.array(picture.size * 2) / np.array(size * 2)
    )
    return picture.resize(
        (CROP_SIDE_PX, CROP_SIDE_PX), Image.Resampling.LANCZOS, tuple(box.tolist())
    )
