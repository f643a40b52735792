"""The steps of a run and their batches, which do not change if the run is interrupted."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from .recipe import Stage, TrainingOptions

FINAL_LEARNING_RATE = 1e-6
"""Cosine annealing of the learning rate ends at this value (paper, Section III-B)."""


class CropIndex(NamedTuple):
    """Index of a crop: number of the image, epoch, place in the epoch's random order, and stage."""

    image: int
    epoch: int
    position: int
    stage: Stage


class Schedule:
    """The steps of a run: their stages, batches and learning rates.

    Args:
        options: the recipe.
        images: number of images.

    Example:
        >>> schedule = Schedule(TrainingOptions(stages=(Stage(240, 2, 1),)), images=4)
        >>> [[index.image for index in batch] for batch in schedule.batches()]
        [[3, 0], [2, 1]]
    """

    def __init__(self, options: TrainingOptions, images: int) -> None:
        self.options = options
        self.images = images
        self.steps_of_stage = [
            max(1, stage.epochs * images // stage.batch) for stage in options.stages
        ]
        self.steps = sum(self.steps_of_stage)
        stages = [np.full(steps, k) for k, steps in enumerate(self.steps_of_stage)]
        within = [np.arange(steps) for steps in self.steps_of_stage]
        self._stages, self._within = np.concatenate(stages), np.concatenate(within)
        if options.interleave:
            progress = [(each + 0.5) / len(each) for each in within]
            order = np.argsort(np.concatenate(progress), kind="stable")
            self._stages, self._within = self._stages[order], self._within[order]
        batches = np.array([stage.batch for stage in options.stages])
        self._crops = np.concatenate([[0], np.cumsum(batches[self._stages])])

    def batches(self, first: int = 0) -> Iterator[list[CropIndex]]:
        """Return an iterator over the batches from step `first` on, for a torch `DataLoader`."""
        return map(self.batch, range(first, self.steps))

    def batch(self, step: int) -> list[CropIndex]:
        """Return the crops of a step."""
        number = int(self._stages[step])
        stage = self.options.stages[number]
        first_epoch = sum(each.epochs for each in self.options.stages[:number])
        start = int(self._within[step]) * stage.batch
        batch = []
        for sample in range(start, start + stage.batch):
            epoch, place = divmod(sample, self.images)
            epoch += first_epoch
            order = epoch_order(self.options.seed, epoch, self.images)
            batch.append(CropIndex(int(order[place]), epoch, place, stage))
        return batch

    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up into cosine annealing."""
        options = self.options
        cosine = (1 + math.cos(math.pi * step / self.steps)) / 2
        rate = FINAL_LEARNING_RATE + cosine * (options.learning_rate - FINAL_LEARNING_RATE)
        return rate * min(1.0, (step + 1) / (options.warm_up * self.steps + 1))

    def crops_until(self, step: int) -> int:
        """Return the number of crops in all earlier steps."""
        return int(self._crops[step])


def milestones(steps: int, count: int) -> set[int]:
    """Return the steps after which to validate: `count` evenly spaced ones, including the last."""
    return {round(steps * part / count) for part in range(1, count + 1)} - {0}


@functools.lru_cache(maxsize=16)  # interleaved stages are in different epochs
def epoch_order(seed: int, epoch: int, count: int) -> np.ndarray:
    """Return the numbers of the images in the random order of an epoch."""
    return np.random.default_rng([seed, 1, epoch]).permutation(count)
