"""Views of photographs with their labels, in memory as far as there is room."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from .._shared.errors import ImageError
from .._shared.parallel import available_memory
from .cluster import distributed_context
from .label_cache import LabelCache
from .photos import Photo
from .views import View, render


class ViewStore:
    """Rendered views with their labels, kept in memory up to a limit.

    Args:
        labels: the label cache.
        memory: bytes that may be kept, default half of the free memory, shared by the
            processes of this machine; views beyond it are made anew each time.
    """

    def __init__(self, labels: LabelCache, memory: int | None = None) -> None:
        self.labels = labels
        if memory is None:
            memory = available_memory() // (2 * distributed_context().local_processes)
        self.memory = memory
        self._kept: dict[tuple[Path, View], tuple[np.ndarray, np.ndarray]] = {}
        self._lock = threading.Lock()

    def load(self, photo: Photo, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        key = (photo.path, view)
        if key in self._kept:
            return self._kept[key]
        image = render(photo.path, view)
        mask = self.labels.load(photo, view)
        if mask.shape != image.shape[:2]:
            raise ImageError(
                f"the label of {photo.path} has another size than the photograph: "
                f"delete {self.labels.folder} and start again"
            )
        with self._lock:
            if key not in self._kept and self.memory >= image.nbytes + mask.nbytes:
                self.memory -= image.nbytes + mask.nbytes
                self._kept[key] = image, mask
        return image, mask
