"""Batches of random crops: a pure function of the seed and the step.

Nothing is remembered from one step to the next, so a run that was broken off
goes on with exactly the batches it would have seen.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from .cluster import Place
from .photos import Photo
from .prefetch import prefetched
from .recipe import Schedule
from .view_store import ViewStore
from .views import View


class Batches:
    """The batches of a run.

    Args:
        photos: the photographs.
        store: their views.
        schedule: the steps.
        place: this process's place among those of the run; it makes its part of each batch.
        loaders: threads that make batches, each whole ones.

    Raises:
        OptionError: a batch cannot be shared evenly by the processes.
    """

    def __init__(
        self,
        photos: list[Photo],
        store: ViewStore,
        schedule: Schedule,
        place: Place = Place(),
        loaders: int = 1,
    ) -> None:
        for stage in schedule.options.stages:
            place.share(stage.batch)
        self.photos = photos
        self.store = store
        self.schedule = schedule
        self.place = place
        self.loaders = loaders

    def batch(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Make a step's batch, or this process's part of it.

        Returns:
            (B, crop, crop, 3) uint8 RGB and (B, crop, crop) bool labels.
        """
        position = self.schedule.position(step)
        stage = position.stage
        numbers = range(position.sample, position.sample + stage.batch)[
            self.place.share(stage.batch)
        ]
        crops = [self._crop(position.epoch_offset, k, stage.crop) for k in numbers]
        images, masks = zip(*crops, strict=True)
        return np.stack(images), np.stack(masks)

    def stream(
        self, first: int, last: int | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the batches of the steps from `first` to before `last`, made ahead by threads.

        Args:
            first: the first step.
            last: the step after the last one; default: the end of the schedule.
        """
        end = self.schedule.steps if last is None else last
        yield from prefetched(self.batch, range(first, end), self.loaders, self.loaders + 3)

    def _crop(self, epoch_offset: int, sample: int, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Cut the crop of one sample, flipped by chance."""
        seed = self.schedule.options.seed
        epoch, place = divmod(sample, len(self.photos))
        epoch += epoch_offset
        order = self._order(epoch)
        generator = np.random.default_rng([seed, 2, epoch, place])
        photo = self.photos[order[place]]
        image, mask = self.store.load(photo, self._choose_view(photo, side, generator))
        top = int(generator.integers(image.shape[0] - side + 1))
        left = int(generator.integers(image.shape[1] - side + 1))
        image = image[top : top + side, left : left + side]
        mask = mask[top : top + side, left : left + side]
        for axis in (1, 0):  # left-right, then upside down
            if generator.random() < 0.5:
                # Copies a hundred times faster than a negative stride.
                image = cv2.flip(image, axis)
                mask = cv2.flip(mask.view(np.uint8), axis).view(bool)
        return image, mask

    def _choose_view(self, photo: Photo, side: int, generator: np.random.Generator) -> View:
        """Choose the light by the dark fraction, then a size that holds the crop."""
        dark = generator.random() < self.schedule.options.dark_fraction
        views = photo.dark if dark else photo.normal
        fitting = [view for view in views if view.short_side >= side]
        return fitting[int(generator.integers(len(fitting)))]

    def _order(self, epoch: int) -> np.ndarray:
        """Return the epoch's order of the photographs (the latest is kept)."""
        kept = getattr(self, "_kept_order", None)
        if kept is None or kept[0] != epoch:
            generator = np.random.default_rng([self.schedule.options.seed, 1, epoch])
            kept = self._kept_order = (epoch, generator.permutation(len(self.photos)))
        return kept[1]
