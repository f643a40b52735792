"""Photographs to train on: crops of pictures in public repositories, each with its licence.

The list of them, `known/photographs.csv.gz`, is made by `benchmarks/list_photographs.py`. Pictures
that are nearly the same as another, and all of the data sets that the network is measured on, are
left out of it.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
from PIL import Image

from .._shared.errors import DeepDetectError
from .._shared.progress import progress
from ..io.image import load_image
from .download import RemoteDataset, RemoteFile

CROP_SIDE_PX = 480
JPEG_QUALITY = 97
"""Labels hardly change by it: the loss is below the noise of a photograph."""

VALIDATION_SHARE = 1 / 20

FREE_LICENCES = ("CC0", "CC BY", "CC BY-SA", "Unsplash")
"""Beginnings of the licences that allow any use, of weights that were trained on them too."""

RESTRICTED = re.compile(r"\b(n[cd]|non-?commercial|no-?deriv\w*)\b", re.IGNORECASE)
"""What a licence says that begins as a free one and is not."""

FREE_SOURCES = ("codecs", "gb82", "deepin", "budgie", "ukui", "endless", "boofcv")
"""Sources that have such pictures."""

LIST_FILE = "photographs.csv.gz"
LICENCES_FILE = "licences.csv"
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True)
class Source:
    """A public repository with photographs.

    Attributes:
        name: with which the names of its crops begin.
        repository: owner and name, on GitHub.
        commit: whose files are taken.
        folders: of these folders only; empty for all.
        licence: as the repository states it; single files may have others.
        megabytes: of the archive, about.
        other_licences: folders, and the licences of the files in them.
    """

    name: str
    repository: str
    commit: str
    folders: tuple[str, ...]
    licence: str
    megabytes: int
    other_licences: tuple[tuple[str, str], ...] = ()

    def licence_of(self, path: str) -> str:
        """Return the licence of a file."""
        for folder, licence in self.other_licences:
            if path.startswith(f"{folder}/"):
                return licence
        return self.licence

    @property
    def archive(self) -> RemoteFile:
        """The archive of the commit."""
        owner, name = self.repository.split("/")
        return RemoteFile(
            (f"https://github.com/{owner}/{name}/archive/{self.commit}.tar.gz",),
            self.megabytes * 1_000_000,
            into=f"{SOURCES_FOLDER}/{self.name}",
            inside=f"{name}-{self.commit}",
            suffixes=PICTURE_SUFFIXES,
        )


SOURCES_FOLDER = "sources"

SOURCES = (
    Source(
        "animals",
        "mateusrafael4/Atividade_programacao_pose_estimation",
        "dab5c74036184926803e5edcf2082b71e0c85c86",
        ("images",),
        "PASCAL VOC, research",
        380,
    ),
    Source(
        "houses",
        "emanhamed/Houses-dataset",
        "5e148219500558089cf5cf121b626b17fdde9b92",
        ("Houses Dataset",),
        "free with citation",
        180,
    ),
    Source(
        "imagenet1000",
        "EliSchwartz/imagenet-sample-images",
        "bc69043e2862758a1906c6a24a792bb28c6bb2ff",
        (),
        "ImageNet, research",
        110,
    ),
    Source(
        "imagen",
        "ajschumacher/imagen",
        "2e8718956e3bb046db9a8e488c2254fd9846b6c5",
        (),
        "ImageNet, research",
        110,
    ),
    Source(
        "osie",
        "NUS-VIP/predicting-human-gaze-beyond-pixels",
        "4a467890fcb40a2fec04cdded552760942bac7a4",
        ("data/stimuli",),
        "MIT (repository)",
        90,
    ),
    Source(
        "codecs",
        "imazen/codec-corpus",
        "55decfe826d350815e3af3b5ac69b882fb2943d3",
        ("CID22/CID22-512", "clic2025", "kodak"),
        "CC BY-SA 4.0",
        300,
        (("clic2025", "Unsplash"), ("kodak", "free, Kodak")),
    ),
    Source(
        "gb82",
        "gianni-rosato/gb82-image-set",
        "502f9f94cb73d1ad5c89ce06fe6b100d0a27df8f",
        ("png",),
        "CC0",
        30,
    ),
    Source(
        "denoising",
        "majedelhelou/denoising_datasets",
        "58234876fef6f1b56306705c78dfd40cdb837b86",
        ("CUrban100", "CSun_Hays80", "Urban100", "Sun_Hays80"),
        "research",
        450,
    ),
    Source(
        "mit1003",
        "cvzoya/saliency",
        "5951cdc7c2ba73e5951d4c36bea58e8c7d41e55d",
        ("code_forOptimization/ParameterTrainingOnICCV/100_ICCV_STIMULI",),
        "research",
        60,
    ),
    Source(
        "deepin",
        "linuxdeepin/deepin-wallpapers",
        "ac2fe33778aa16d332066227faaa6cc9baff6a1f",
        ("nonfree/unsplash.com",),
        "Unsplash",
        90,
    ),
    Source(
        "budgie",
        "BuddiesOfBudgie/budgie-backgrounds",
        "82067426f1dde366e9c9038fdbe457c2527525dd",
        ("backgrounds",),
        "CC0",
        40,
    ),
    Source(
        "kde",
        "KDE/plasma-workspace-wallpapers",
        "1b705475cc181da87ad1af0266cc7ebda3d8e9d5",
        (),
        "LGPL-3.0",
        200,
    ),
    Source(
        "popos",
        "pop-os/wallpapers",
        "03a25a14a76eaf3825b980ab50aad6698c1c5a35",
        ("original",),
        "mixed, see the repository",
        100,
    ),
    Source(
        "ukui",
        "ukui/ukui-wallpapers",
        "525cd36405a9258fac6764f2edeb606ad2570fab",
        ("backgrounds",),
        "CC BY-SA 3.0",
        40,
    ),
    Source(
        "opensuse",
        "openSUSE/wallpapers",
        "0ed35e392080349a70c283760a9661a85faf4e5e",
        ("leap15", "leap16"),
        "free, see the repository",
        60,
    ),
    Source(
        "endless",
        "endlessm/eos-media",
        "3f42869c4d20fe1343a43974ec1d3f2a0685ba3a",
        ("default_files/default_images",),
        "per file, LICENSE.tsv",
        60,
    ),
    Source(
        "boofcv",
        "lessthanoptimal/BoofCV-Data",
        "cc6d8adf795be2e0c6cc12b42b9ed0c92cab0fcf",
        ("example",),
        "CC BY 4.0",
        400,
    ),
    Source(
        "cameras",
        "drewnoakes/metadata-extractor-images",
        "4beba640487802442bc9931fb01274e908102d3a",
        ("jpg", "webp"),
        "none stated",
        300,
    ),
)


@dataclass(frozen=True)
class Crop:
    """A square of a picture.

    Attributes:
        source: name of its `Source`.
        path: of the picture in the repository.
        sha256: of the picture's file.
        licence: of the picture.
        short_side_px: that the picture is scaled to.
        x, y: upper left corner of the square in the scaled picture.
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
        """Whether the licence allows any use: CC BY does, CC BY-NC and CC BY-ND do not."""
        return self.licence.startswith(FREE_LICENCES) and not RESTRICTED.search(self.licence)

    @property
    def part(self) -> str:
        """Where it goes, "train" or "val": all crops of a picture to the same."""
        return "val" if int(self.sha256[:8], 16) < VALIDATION_SHARE * 2**32 else "train"


@cache
def listed_crops() -> tuple[Crop, ...]:
    """Return all crops, those of a picture one after the other."""
    file = resources.files(__package__).joinpath(f"known/{LIST_FILE}")
    text = gzip.decompress(file.read_bytes()).decode()
    return tuple(
        Crop(*row[:4], *(int(number) for number in row[4:]))  # type: ignore[arg-type]
        for row in csv.reader(io.StringIO(text))
    )


def write_crops(folder: Path, crops: Sequence[Crop], quiet: bool = True) -> None:
    """Replace unpacked repositories by crops of their pictures.

    Args:
        folder: with the repositories below `sources`; gets `train`, `val` and `licences.csv`.
        crops: which ones, those of a picture one after the other.
        quiet: show no progress bar.

    Raises:
        DeepDetectError: a picture is missing, or is not the one that is listed.
    """
    rows = [("file", "picture", "licence", "sha256")]
    repositories = {source.name: source for source in SOURCES}
    with progress(len(crops), "cropping", "crop", quiet) as bar:
        for number, (crop, picture) in enumerate(_cut(folder / SOURCES_FOLDER, crops)):
            file = folder / crop.part / f"{crop.source}_{number:05d}.jpg"
            file.parent.mkdir(parents=True, exist_ok=True)
            picture.save(file, quality=JPEG_QUALITY, subsampling=0)
            source = repositories[crop.source]
            url = f"https://github.com/{source.repository}/blob/{source.commit}/{crop.path}"
            rows.append((file.relative_to(folder).as_posix(), url, crop.licence, crop.sha256))
            bar.update(1)
    with (folder / LICENCES_FILE).open("w", newline="", encoding="utf-8") as table:
        csv.writer(table).writerows(rows)
    shutil.rmtree(folder / SOURCES_FOLDER)


def _cut(sources: Path, crops: Sequence[Crop]) -> Iterator[tuple[Crop, Image.Image]]:
    """Yield crops with their pixels; a picture is read once for all of its crops."""
    held: tuple[str, Image.Image] | None = None
    for crop in crops:
        path = sources / crop.source / crop.path
        if held is None or held[0] != crop.sha256:
            try:
                content = path.read_bytes()
            except OSError:
                raise DeepDetectError(
                    f"{crop.source} has no {crop.path}: the archive is not the one that is listed"
                ) from None
            if hashlib.sha256(content).hexdigest() != crop.sha256:
                raise DeepDetectError(
                    f"{crop.path} of {crop.source} is not the picture that is listed: it has "
                    "changed or was damaged on the way"
                )
            held = crop.sha256, Image.fromarray(load_image(content))
        yield crop, cut(held[1], crop.short_side_px, crop.x, crop.y)


def cut(picture: Image.Image, short_side_px: int, x: int, y: int) -> Image.Image:
    """Scale a picture and cut a square of `CROP_SIDE_PX` out of it."""
    scale = short_side_px / min(picture.size)
    size = [max(short_side_px, round(side * scale)) for side in picture.size]
    # Only what is needed is scaled: some pictures have 100 megapixels.
    box = np.array([x, y, x + CROP_SIDE_PX, y + CROP_SIDE_PX]) * (
        np.array(picture.size * 2) / np.array(size * 2)
    )
    return picture.resize(
        (CROP_SIDE_PX, CROP_SIDE_PX), Image.Resampling.LANCZOS, tuple(box.tolist())
    )


def _write_all(folder: Path, quiet: bool) -> None:
    write_crops(folder, listed_crops(), quiet)


def _write_free(folder: Path, quiet: bool) -> None:
    write_crops(folder, [crop for crop in listed_crops() if crop.is_free], quiet)


PHOTOGRAPHS = RemoteDataset(
    name="photographs",
    title=f"crops of {CROP_SIDE_PX}x{CROP_SIDE_PX} pixels of photographs, to train on",
    files=tuple(source.archive for source in SOURCES),
    images=9522,
    licence=f"each photograph its own, in {LICENCES_FILE}: some for research only",
    prepare=_write_all,
)

PHOTOGRAPHS_FREE = RemoteDataset(
    name="photographs-free",
    title="those of them whose licence allows any use",
    files=tuple(source.archive for source in SOURCES if source.name in FREE_SOURCES),
    images=1165,
    licence=f"each photograph its own, in {LICENCES_FILE}: {', '.join(FREE_LICENCES)}",
    prepare=_write_free,
)
