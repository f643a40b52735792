"""The photographs of a run, their views, and views in memory."""

from __future__ import annotations

import os
import threading
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import ImageError
from ..image import find_images
from .label_cache import LabelCache
from .recipe import TrainingOptions
from .views import View, render, views_of


@dataclass(frozen=True)
class Photo:
    """A photograph and its views."""

    path: Path
    normal: tuple[View, ...]
    dark: tuple[View, ...]


def list_photos(root: Path, options: TrainingOptions) -> list[Photo]:
    """List the photographs below a folder with their views.

    Raises:
        ImageError: the folder is missing or empty.
    """
    return [
        Photo(
            path,
            *views_of(
                path.relative_to(root).as_posix(),
                options.short_sides,
                options.darkening,
                options.dark_variants,
            ),
        )
        for path in find_images(root)
    ]


def hold_out(photos: list[Photo], share: int = 20) -> tuple[list[Photo], list[Photo]]:
    """Split off every twentieth photograph for validation, by the checksum of its name.

    A photograph stays on its side when others are added.

    Raises:
        ImageError: there are too few photographs to split.
    """
    held: list[Photo] = []
    kept: list[Photo] = []
    for photo in photos:
        part = held if zlib.crc32(photo.path.name.encode()) % share == 0 else kept
        part.append(photo)
    if not held and len(photos) > 1:
        held, kept = photos[-1:], photos[:-1]
    if not held or not kept:
        raise ImageError(
            "one photograph is too few to train on: add more, "
            "or name a folder for validation with --validation"
        )
    return kept, held


class ViewStore:
    """Rendered views with their labels, kept in memory up to a limit.

    Args:
        labels: the label cache.
        memory: bytes that may be kept, default half of the free memory; views beyond it
            are made anew each time.
    """

    def __init__(self, labels: LabelCache, memory: int | None = None) -> None:
        self.labels = labels
        self.memory = _half_of_free_memory() if memory is None else memory
        self._kept: dict[tuple[Path, View], tuple[np.ndarray, np.ndarray]] = {}
        self._lock = threading.Lock()

    def load(self, photo: Photo, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        key = (photo.path, view)
        if key in self._kept:
            return self._kept[key]
        image = render(photo.path, view)
        mask = self.labels.load(photo.path, view)
        if mask.shape != image.shape[:2]:
            raise ImageError(
                f"the label of {photo.path} has another size than the photograph: "
                f"delete {self.labels.folder} and start again"
            )
        with self._lock:
            if self.memory >= image.nbytes + mask.nbytes:
                self.memory -= image.nbytes + mask.nbytes
                self._kept[key] = image, mask
        return image, mask


def _half_of_free_memory() -> int:
    """Return half of the free memory in bytes, or 2 GB where the system does not tell."""
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return 2_000_000_000
