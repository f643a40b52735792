"""Training of a descriptor that published ones teach: their readings beside our pairs of views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from ..recipe import DescriptorTrainingOptions, DeviceOptions
from .crops import Crops, draw_crops
from .losses import KINDS
from .task import DescriptorTrainer, PairDataset, pairs_to_draw
from .taught import TaughtNetwork
from .teaching import crop_losses, measure_teaching, pair_losses
from .views import Pair

VAL_CROPS = 8
"""Batches of crops for validation, with as many crops as a step has. Chosen by hand."""


class TaughtDataset(Dataset[tuple[tuple[int, list[int], Pair | None], Crops]]):
    """The new pairs of each step, and crops of the photographs that have been read by then."""

    def __init__(
        self, files: Sequence[Path], options: DescriptorTrainingOptions, readings: Path
    ) -> None:
        self.pairs, self.readings = PairDataset(files, options), readings

    def __getitem__(
        self, index: tuple[int, list[int]]
    ) -> tuple[tuple[int, list[int], Pair | None], Crops]:
        files, options = self.pairs.files, self.pairs.options
        generator = np.random.default_rng([options.seed, 6, index[0]])
        return self.pairs[index], draw_crops(files, self.readings, options.crops, generator)


class TaughtTrainer(DescriptorTrainer):
    """Training of a `TaughtNetwork` on pairs of views, and on readings of its teachers.

    A run that starts before all photographs are read depends on when each is read.
    """

    purpose = (
        "that describes keypoints, taught by EdgePoint2-E64 (MIT) and ALIKED-n16rot (BSD-3-Clause)"
    )
    measures = (
        "Share of the keypoints whose match, a mutual nearest neighbour, is correct within 3 px, "
        "for each kind of pairs of views of the validation images; mean cosine to the codes of "
        "both teachers; correlation of scores with the second one's; share of the keypoints whose "
        "angles agree to 20 degrees; the score is the mean of the first three and the cosines"
    )
    kind_of_network = TaughtNetwork
    no_kernels = ("at_half", "by_size", "score", "angle")
    network: TaughtNetwork
    average: TaughtNetwork
    crops: Crops

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: DescriptorTrainingOptions,
        init_weights: str | Path | None,
        device: DeviceOptions,
        readings: Path,
    ) -> None:
        self.readings = readings
        rng = np.random.default_rng([options.seed, 7])
        drawn = (draw_crops(validation, readings, options.crops, rng) for _ in range(VAL_CROPS))
        self.val_crops = list(drawn)
        super().__init__(images, validation, options, init_weights, device)

    def loader(self, first: int = 0, last: int | None = None) -> DataLoader[Any]:
        """Return a loader as of a `DescriptorTrainer`, each step with its crops."""
        to_draw = pairs_to_draw(self.options, first, self.steps if last is None else last)
        return DataLoader(
            TaughtDataset(self.files, self.options, self.readings),
            batch_size=None,
            sampler=list(to_draw),
            num_workers=self.num_workers,
            generator=torch.Generator(),
        )

    def loss(self, batch: tuple[tuple[int, list[int], Pair | None], Crops]) -> Tensor:  # type: ignore[override]
        """Return the sum of the losses of a step's pairs and crops."""
        pairs, self.crops = batch
        return super().loss(pairs)

    def loss_of_pairs(self, pairs: Pair, generator: np.random.Generator) -> Tensor:
        crops = Crops(*(values.to(self.device) for values in self.crops))
        losses = pair_losses(self.network, pairs, generator) | crop_losses(self.network, crops)
        return sum(losses.values(), next(iter(losses.values())).new_zeros(()))

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs and crops."""
        shares = super().validate(step)
        crops = (Crops(*(values.to(self.device) for values in each)) for each in self.val_crops)
        measures = shares | measure_teaching(self.average, crops, self.batches)
        counted = [f"{kind} correct" for kind in KINDS] + ["edgepoint score", "aliked score"]
        return measures | {"score": sum(measures[name] for name in counted) / len(counted)}

    def export(self, folder: Path) -> Path | None:
        """The core reads no such network yet."""
        return None
