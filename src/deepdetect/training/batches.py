"""Batches of random crops: a pure function of the seed and the step.

Nothing is remembered from one step to the next, so a run that was broken off
goes on with exactly the batches it would have seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .augmentation import flip, transpose, turn_hue, without_color
from .cluster import DistributedContext
from .feed import Example, Feed
from .photos import Photo
from .prefetch import prefetched
from .recipe import Stage
from .schedule import Schedule
from .views import View


@dataclass(frozen=True)
class _Plan:
    """A batch that is to be made: photographs, each with its epoch and its place in that."""

    stage: Stage
    draws: list[tuple[Example, int, int]]


class Batches:
    """The batches of a run.

    Args:
        feed: the photographs.
        schedule: the steps.
        place: this process's place among those of the run; it makes its part of each batch.
        num_workers: threads that make batches, each whole ones.

    Raises:
        OptionError: a batch cannot be shared evenly by the processes.
    """

    def __init__(
        self,
        feed: Feed,
        schedule: Schedule,
        place: DistributedContext = DistributedContext(),
        num_workers: int = 1,
    ) -> None:
        for stage in schedule.options.stages:
            place.local_slice(stage.batch)
        self.feed = feed
        self.schedule = schedule
        self.place = place
        self.num_workers = num_workers

    def batch(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Make a step's batch, or this process's part of it.

        Returns:
            (B, crop, crop, 3) uint8 RGB and (B, crop, crop) bool labels.
        """
        return self._make(next(self._plans(step, step + 1)))

    def stream(
        self, first: int, last: int | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the batches of the steps from `first` to before `last`, made ahead by threads.

        Args:
            first: the first step.
            last: the step after the last one; default: the end of the schedule.
        """
        end = self.schedule.steps if last is None else last
        plans = self._plans(first, end)
        yield from prefetched(self._make, plans, self.num_workers, self.num_workers + 3)

    def _plans(self, first: int, last: int) -> Iterator[_Plan]:
        """Yield what the batches are made of; all processes go through the same photographs."""
        # Of each stage the place that it has come to, and the photographs from there on.
        running: dict[int, tuple[tuple[int, int], Iterator[Example]]] = {}
        for step in range(first, last):
            position = self.schedule.position(step)
            draws = []
            for sample in range(position.sample, position.sample + position.stage.batch):
                epoch, place = divmod(sample, len(self.feed))
                epoch += position.epoch_offset
                there, examples = running.get(position.number, (None, None))
                if there != (epoch, place):
                    examples = self.feed.epoch(epoch, place)
                draws.append((next(examples), epoch, place))
                running[position.number] = (epoch, place + 1), examples
            yield _Plan(position.stage, draws[self.place.local_slice(position.stage.batch)])

    def _make(self, plan: _Plan) -> tuple[np.ndarray, np.ndarray]:
        crops = [self._crop(*draw, plan.stage) for draw in plan.draws]
        images, masks = zip(*crops, strict=True)
        return np.stack(images), np.stack(masks)

    def _crop(
        self, example: Example, epoch: int, place: int, stage: Stage
    ) -> tuple[np.ndarray, np.ndarray]:
        """Cut the crop of one sample, mirrored and with other colours by chance."""
        generator = np.random.default_rng([self.schedule.options.seed, 2, epoch, place])
        view = self._choose_view(example.photo, stage, generator)
        image, mask = example.load(view)
        side = stage.crop
        top = int(generator.integers(image.shape[0] - side + 1))
        left = int(generator.integers(image.shape[1] - side + 1))
        image = image[top : top + side, left : left + side]
        mask = mask[top : top + side, left : left + side]
        options = self.schedule.options
        for axis in (1, 0) if options.flips else ():  # left-right, then upside down
            if generator.random() < 0.5:
                image, mask = flip(image, mask, axis)
        if options.transpositions and generator.random() < 0.5:
            image, mask = transpose(image, mask)
        if generator.random() < options.color_jitter:
            # In the dark, where one level more or less makes a keypoint, only what is exact.
            if view.darkening is not None or generator.random() < 0.5:
                image = without_color(image)
            else:
                image = turn_hue(image, generator.uniform(0, 2 * np.pi), generator.uniform(0, 1.2))
        return image, mask

    def _choose_view(self, photo: Photo, stage: Stage, generator: np.random.Generator) -> View:
        """Choose the light by the dark fraction, then a size of the stage's."""
        dark = generator.random() < self.schedule.options.dark_fraction
        views = photo.dark if dark else photo.normal
        fitting = [
            view
            for view in views
            if view.short_side >= stage.crop and (not stage.sides or view.short_side in stage.sides)
        ]
        return fitting[int(generator.integers(len(fitting)))]
