"""The photographs of a run, their views, and which are held out for validation."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .._shared.errors import ImageError
from ..io.image import find_images
from .recipe import TrainingOptions
from .views import View, views_of

DIGESTED_BYTES = 65536
"""A photograph is told from others by its size and so many bytes from its start."""


@dataclass(frozen=True)
class Photo:
    """A photograph and its views.

    Attributes:
        path: its file.
        digest: eight hexadecimal digits that depend on the content.
        normal, dark: its views.
    """

    path: Path
    digest: str
    normal: tuple[View, ...]
    dark: tuple[View, ...]


def list_photos(
    root: Path,
    options: TrainingOptions,
    exclude: Sequence[Path] = (),
    limit: int | None = None,
) -> list[Photo]:
    """List the photographs below a folder with their views.

    Args:
        root: the folder.
        options: sizes and darkening of the views.
        exclude: folders below it that are left out.
        limit: take no more than so many, by the checksums of their names.

    Raises:
        ImageError: the folder is missing or empty.
    """
    paths = find_images(root, exclude)
    if limit is not None and len(paths) > limit:
        chosen = sorted(paths, key=lambda path: (zlib.crc32(path.name.encode()), path))[:limit]
        paths = sorted(chosen)
    return [
        Photo(
            path,
            _content_digest(path),
            *views_of(
                path.relative_to(root).as_posix(),
                options.short_sides,
                options.darkening,
                options.dark_variants,
                options.square,
                options.augmentations,
            ),
        )
        for path in paths
    ]


def train_val_split(photos: list[Photo], share: float = 0.05) -> tuple[list[Photo], list[Photo]]:
    """Split off a share of the photographs for validation, by the checksums of their names.

    A photograph stays on its side when others are added.

    Args:
        photos: the photographs.
        share: about so many of them are held out.

    Returns:
        The photographs to train on, and those held out.

    Raises:
        ImageError: there are too few photographs to split.
    """
    held: list[Photo] = []
    kept: list[Photo] = []
    for photo in photos:
        # Of the mirrored checksum, which has nothing to do with the choice of `list_photos`.
        draw = int(f"{zlib.crc32(photo.path.name.encode()):032b}"[::-1], 2) / 2**32
        part = held if draw < share else kept
        part.append(photo)
    if not held and len(photos) > 1:
        held, kept = photos[-1:], photos[:-1]
    if not held or not kept:
        raise ImageError(
            "one photograph is too few to train on: add more, "
            "or name a folder for validation with --validation"
        )
    return kept, held


def photos_digest(training: Sequence[Photo], held: Sequence[Photo]) -> str:
    """Return a digest of which photographs a run trains on and validates with."""
    digests = [photo.digest for photo in training] + ["|"] + [photo.digest for photo in held]
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()[:16]


def _content_digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            start = file.read(DIGESTED_BYTES)
        return f"{zlib.crc32(start, path.stat().st_size & 0xFFFFFFFF):08x}"
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check its rights") from None
