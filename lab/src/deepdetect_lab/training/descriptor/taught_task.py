"""Training of a descriptor on outputs of published networks, and on pairs of synthetic views."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn
from torch.utils.data import Dataset

from ..recipe import DescriptorTrainingOptions, DeviceOptions
from ..teachers.readings import Whitening, reading_file
from ..trainer import seeded
from .crops import Crops, draw_crops
from .edge import BACKBONE, EdgeNetwork
from .losses import KINDS
from .task import DescriptorTrainer, PairDataset
from .teaching import PAIR_WEIGHT, crop_losses, measure_teaching
from .views import Pair

BACKBONE_RATE = 0.5
"""Factor of the learning rate of the layers that start from EdgePoint2's weights, so that they keep
more of what EdgePoint2 learned from real pairs. Chosen by hand."""

DECAY_SHARE = 0.82
"""The learning rate falls linearly to 0 over this last share of the steps, which is larger than
without teachers. In a run from trained weights, the measures on photos/val improved little in 1,300
steps at the highest rate, and more in the next 1,000, while the rate fell to 0.87 of it."""

VAL_CROPS = 8
"""Number of validation batches of crops, each as large as a step's batch. Chosen by hand."""


class TaughtDataset(Dataset[tuple[tuple[int, list[int], Pair | None], Crops]]):
    """The new pairs of each step, and crops of photographs whose readings are already written."""

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
    """Training of an `EdgeNetwork` on pairs of views, and on outputs of its teachers (readings).

    If readings are still being written during a run, its result depends on the times of writing.
    """

    purpose = (
        "that describes keypoints. It starts with layers of EdgePoint2-L64 (MIT, HITCSC-Robotics), "
        "and is taught by EdgePoint2-E64 (MIT, HITCSC-Robotics) and ALIKED-n16rot (BSD-3-Clause)"
    )
    measures = (
        "Share of keypoints whose mutual nearest neighbour is correct within 3 px, for the three "
        "kinds of pairs of views of the validation images; mean cosine of predicted codes to the "
        "whitened codes of both teachers; share of points whose predicted code is nearest to their "
        "own; correlation of scores with those of ALIKED; the score is the mean of the first five"
    )
    kind_of_network = EdgeNetwork
    no_kernels = ("at_half", "by_size", "score")
    decay_share = DECAY_SHARE
    network: EdgeNetwork
    average: EdgeNetwork
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
        read = [path for image in images if (path := reading_file(image, readings)).exists()]
        self.whiten = Whitening(read)
        rng = np.random.default_rng([options.seed, 7])
        drawn = (draw_crops(validation, readings, options.crops, rng) for _ in range(VAL_CROPS))
        self.val_crops = list(drawn)
        super().__init__(images, validation, options, init_weights, device)

    def first_network(self, init_weights: str | Path | None) -> nn.Module:
        """Return the network before the first step, with EdgePoint2's weights from a .pth file."""
        if init_weights is None or Path(init_weights).suffix != ".pth":
            return super().first_network(init_weights)
        network = seeded(EdgeNetwork, self.options.seed)
        network.start_from(Path(init_weights))
        return network

    def rate_factor(self, name: str) -> float:
        return BACKBONE_RATE if name.startswith(BACKBONE) else 1.0

    def dataset(self) -> Dataset[Any]:
        """Return a dataset of the new pairs and the crops of each step."""
        return TaughtDataset(self.files, self.options, self.readings)

    def loss(self, batch: tuple[tuple[int, list[int], Pair | None], Crops]) -> Tensor:  # type: ignore[override]
        """Return the sum of the losses of a step's pairs and crops."""
        pairs, self.crops = batch
        return super().loss(pairs)

    def loss_of_pairs(self, pairs: Pair, generator: np.random.Generator) -> Tensor:
        crops = self.on_device(self.crops)
        losses = crop_losses(self.network, crops).values()
        return sum(losses, PAIR_WEIGHT * super().loss_of_pairs(pairs, generator))

    def on_device(self, crops: Crops) -> Crops:
        """Return crops on the device, with whitened codes."""
        crops = Crops(*(values.to(self.device) for values in crops))
        return crops._replace(codes=self.whiten(crops.codes))

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs and crops."""
        shares = super().validate(step)
        crops = map(self.on_device, self.val_crops)
        measures = shares | measure_teaching(self.average, crops)
        counted = [f"{kind} correct" for kind in KINDS] + ["teachers score", "teachers found"]
        return measures | {"score": sum(measures[name] for name in counted) / len(counted)}
