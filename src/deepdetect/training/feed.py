"""Where a run's photographs come from, in the random order of each epoch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .photos import Photo
from .view_store import ViewStore
from .views import View


class Example(Protocol):
    """A photograph that can be trained on."""

    photo: Photo

    def load(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view as (H, W, 3) uint8 RGB, and its label as (H, W) bool."""
        ...


class Feed(Protocol):
    """The photographs of a run; each epoch gives every one of them once."""

    def __len__(self) -> int: ...

    def epoch(self, number: int, first: int = 0) -> Iterator[Example]:
        """Yield the photographs of an epoch from its place `first` on, always in one order."""
        ...


@dataclass(frozen=True)
class StoredExample:
    """A photograph in a file, with labels in the cache."""

    photo: Photo
    store: ViewStore

    def load(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return a view and its label."""
        return self.store.load(self.photo, view)


class FileFeed:
    """Photographs in files, which can be had in any order.

    Args:
        photos: the photographs.
        store: their views.
        seed: decides the order.
    """

    def __init__(self, photos: Sequence[Photo], store: ViewStore, seed: int) -> None:
        self.photos, self.store, self.seed = photos, store, seed

    def __len__(self) -> int:
        return len(self.photos)

    def epoch(self, number: int, first: int = 0) -> Iterator[StoredExample]:
        """Yield the photographs of an epoch."""
        order = np.random.default_rng([self.seed, 1, number]).permutation(len(self.photos))
        for k in order[first:]:
            yield StoredExample(self.photos[k], self.store)
