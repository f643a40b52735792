"""What decides which weights come out of a training of the head."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass

from ..._shared.errors import OptionError, unknown_name
from .views import KINDS

LOSSES = ("budget", "ranking")


@dataclass(frozen=True)
class PointsTrainingOptions:
    """A training of the head.

    Attributes:
        steps: optimiser steps.
        pairs: of views in each step.
        side: of the square views in pixels.
        levels: of the pyramid that both views are shown as.
        learning_rate: the highest; cosine annealing to 2 % of it.
        warm_up: steps to the full learning rate.
        weight_decay: of AdamW.
        max_gradient_norm: gradients are clipped to it.
        average_decay: of the running mean of the weights, which is what is measured and kept; 0
            keeps those of the last step.
        loss: "budget": expected repeats at a fixed number of keypoints; "ranking": found again
            ones before others, pair by pair, and the same logit in both views.
        sharpness: standard deviation of the logits over the candidates of an image, to which they
            are scaled before the loss: it cannot be lowered by sharper logits.
        temperature: of the soft choice of the best, in units of those logits.
        min_density, max_density: range of the budgets in keypoints per pixel, log-uniform.
        position_weight: of the distance between keypoints that are found again.
        kind_weights: how often each of `views.KINDS` is drawn, relative to the others.
        initial_sigma_px: of the |det H| that the untrained head ranks by.
        seed: of the weights and the pairs.
    """

    steps: int = 20_000
    pairs: int = 4
    side: int = 160
    levels: int = 5
    learning_rate: float = 6e-4
    warm_up: int = 100
    weight_decay: float = 1e-4
    max_gradient_norm: float = 1.0
    average_decay: float = 0.99
    loss: str = "budget"
    sharpness: float = 25.0
    temperature: float = 3.0
    min_density: float = 0.0012
    max_density: float = 0.016
    position_weight: float = 0.0
    kind_weights: tuple[float, ...] = (1.0,) * len(KINDS)
    initial_sigma_px: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise unknown_name("loss", self.loss, LOSSES)
        if min(self.steps, self.pairs, self.levels) < 1 or self.side < 64:
            raise OptionError("steps, pairs and levels must be 1 or more, the side 64 or more")
        if not 0 < self.min_density <= self.max_density:
            raise OptionError("the densities must be above 0, the lowest first")
        if len(self.kind_weights) != len(KINDS) or min(self.kind_weights) < 0:
            raise OptionError(f"`kind_weights` needs a number for each of {', '.join(KINDS)}")

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up into cosine annealing."""
        cosine = (1 + math.cos(math.pi * step / self.steps)) / 2
        return self.learning_rate * (0.02 + 0.98 * cosine) * min(1.0, (step + 1) / self.warm_up)

    def to_json(self) -> str:
        """Return all options as one line of JSON."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)
