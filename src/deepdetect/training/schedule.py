"""The steps of a training run, which follow from its options."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .recipe import Stage, TrainingOptions


@dataclass(frozen=True)
class Position:
    """Where a step lies.

    Attributes:
        number, stage: its stage.
        sample: its first crop's number in the stage.
        epoch_offset: the epochs of the stages before.
    """

    number: int
    stage: Stage
    sample: int
    epoch_offset: int


class Schedule:
    """The steps of a run over a number of photographs.

    Args:
        options: the recipe.
        photos: number of photographs.
    """

    def __init__(self, options: TrainingOptions, photos: int) -> None:
        self.options = options
        self.photos = photos
        self.steps_of_stage = [
            max(1, stage.epochs * photos // stage.batch) for stage in options.stages
        ]
        self.steps = sum(self.steps_of_stage)
        stages = [np.full(steps, k) for k, steps in enumerate(self.steps_of_stage)]
        within = [np.arange(steps) for steps in self.steps_of_stage]
        self._stages, self._within = np.concatenate(stages), np.concatenate(within)
        if options.interleave:
            shares = [(each + 0.5) / len(each) for each in within]
            order = np.argsort(np.concatenate(shares), kind="stable")
            self._stages, self._within = self._stages[order], self._within[order]

    def position(self, step: int) -> Position:
        """Find a step's stage and place in it.

        Raises:
            IndexError: the step lies behind the last one.
        """
        number = int(self._stages[step])
        stage = self.options.stages[number]
        before = sum(each.epochs for each in self.options.stages[:number])
        return Position(number, stage, int(self._within[step]) * stage.batch, before)

    def learning_rate(self, step: int) -> float:
        """Return the optimiser's rate at a step: a linear warm-up into cosine annealing."""
        options = self.options
        share = (1 + math.cos(math.pi * step / self.steps)) / 2
        rate = options.final_learning_rate + share * (
            options.learning_rate - options.final_learning_rate
        )
        return rate * min(1.0, (step + 1) / (options.warm_up + 1))

    def milestones(self, count: int) -> set[int]:
        """Return the numbers of steps done at `count` evenly spaced points, the end among them."""
        return {round(self.steps * part / count) for part in range(1, count + 1)} - {0}
