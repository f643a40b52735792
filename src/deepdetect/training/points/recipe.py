"""What decides which weights come out of a training of the ranker."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass

from ..._shared.errors import OptionError
from ..._shared.options import check_ranges, suggest_keywords
from .views import KINDS


@suggest_keywords
@dataclass(frozen=True)
class PointsTrainingOptions:
    """A training of the ranker.

    Attributes:
        steps: optimiser steps.
        pairs: of views in each step.
        side: of the square views in pixels.
        hidden: units of the ranker's two hidden layers.
        learning_rate: the highest; cosine annealing to 2 % of it.
        warm_up: steps to the full learning rate.
        weight_decay: of AdamW.
        max_gradient_norm: gradients are clipped to it.
        average_decay: of the running mean of the weights, which is what is measured and kept; 0
            keeps those of the last step.
        sharpness: standard deviation of the logits over the keypoints of a view, to which they
            are scaled before the loss: it cannot be lowered by sharper logits.
        temperature: of the soft choice of the best, in units of those logits.
        min_density, max_density: range of the budgets in keypoints per pixel, log-uniform.
        close_share: of the reward of a keypoint that is found again within 3 px, what it gets
            only within 1 px.
        match_weight: how much more a keypoint is worth whose upright descriptors match, in
            multiples of one that is only found again.
        max_candidates: of each view; the strongest are ranked.
        kind_weights: how often each of `views.KINDS` is drawn, relative to the others.
        seed: of the weights and the pairs.

    Raises:
        OptionError: a value is out of its range.
    """

    steps: int = 3000
    pairs: int = 4
    side: int = 224
    hidden: tuple[int, int] = (48, 32)
    learning_rate: float = 3e-3
    warm_up: int = 100
    weight_decay: float = 1e-4
    max_gradient_norm: float = 1.0
    average_decay: float = 0.995
    sharpness: float = 25.0
    temperature: float = 0.6
    min_density: float = 0.003
    max_density: float = 0.025
    close_share: float = 0.7
    match_weight: float = 0.0
    max_candidates: int = 2000
    kind_weights: tuple[float, ...] = (1.0,) * len(KINDS)
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("learning_rate", "max_gradient_norm", "sharpness", "temperature"),
                *("min_density", "max_density"),
            ),
            not_negative=("warm_up", "weight_decay", "match_weight", "seed"),
            fractions=("close_share",),
            between={
                "steps": (1, math.inf),
                "pairs": (1, math.inf),
                "max_candidates": (1, math.inf),
                "hidden": (1, math.inf),
                "side": (64, math.inf),
                "average_decay": (0, 0.999999),
            },
        )
        if self.min_density > self.max_density:
            raise OptionError("`min_density` must not be above `max_density`")
        if len(self.kind_weights) != len(KINDS) or not (
            min(self.kind_weights) >= 0 < sum(self.kind_weights)
        ):
            raise OptionError(f"`kind_weights` needs a number for each of {', '.join(KINDS)}")

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up into cosine annealing."""
        cosine = (1 + math.cos(math.pi * step / self.steps)) / 2
        return (
            self.learning_rate
            * (0.02 + 0.98 * cosine)
            * min(1.0, (step + 1) / max(self.warm_up, 1))
        )

    def to_json(self) -> str:
        """Return all options as one line of JSON."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)
