"""The training of the ranker: its network, batches of pairs, loss and validation."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from deepdetect._shared.atomic import atomic_path
from deepdetect.detector.points.detection import detect_points
from deepdetect.detector.points.ranker import MAX_DEVIATIONS, Ranker, load_ranker

from ..recipe import PointsTrainingOptions
from ..sampler import milestones
from ..trainer import Trainer, digests, seeded
from .losses import pair_loss
from .measure import measure, validation_pairs
from .pairs import CandidatePair, PairDataset

STATISTICS_PAIRS = 64
"""Features are normalised by their statistics in this number of pairs of views. Chosen by hand."""

WARM_UP_STEPS = 100
FINAL_RATE = 0.02
"""The learning rate rises over `WARM_UP_STEPS` steps. Cosine annealing ends at the fraction
`FINAL_RATE` of the highest rate. Chosen by hand."""

WEIGHT_DECAY = 1e-4
"""Weight decay of AdamW. Chosen by hand."""

AVERAGE_DECAY = 0.995
"""Decay per step of the exponential average of the weights, which is saved. Chosen by hand."""

HIDDEN_UNITS = (48, 32)
"""Widths of the hidden layers. 96 and 48 units were no better on pairs from photos/val."""

MIN_DEVIATION = 1e-3
"""Features are divided by their standard deviation, or by this if it is larger. Chosen by hand."""

INITIAL_OUTPUT = 0.01
"""The initial weights of the last layer are multiplied by this factor. The layer then gives values
near 0, so an untrained ranker ranks by |det Hessian|."""


class RankerModule(nn.Module):
    """A ranker. Its logit is the first feature plus the output of a perceptron for all features.

    The perceptron gets features normalised by their `mean` and standard `deviation`, (F,) each.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, mean: np.ndarray, deviation: np.ndarray) -> None:
        super().__init__()
        self.register_buffer("mean", torch.from_numpy(mean.astype(np.float32)))
        spread = np.maximum(deviation, MIN_DEVIATION).astype(np.float32)
        self.register_buffer("deviation", torch.from_numpy(spread))
        first, second = HIDDEN_UNITS
        self.first = nn.Linear(len(mean), first)
        self.second = nn.Linear(first, second)
        self.output = nn.Linear(second, 1)
        with torch.no_grad():
            self.output.weight.mul_(INITIAL_OUTPUT)
            self.output.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        """Map (N, F) features to (N,) logits."""
        values = (features - self.mean) / self.deviation
        values = values.clamp(-MAX_DEVIATIONS, MAX_DEVIATIONS)
        values = self.second(self.first(values).relu()).relu()
        logits: Tensor = features[:, 0] + self.output(values)[:, 0]
        return logits

    def export(self, notes: dict[str, Any]) -> Ranker:
        """Return the same ranker as NumPy arrays, for use without torch."""
        layers = tuple(
            (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
            for layer in (self.first, self.second, self.output)
        )
        text = json.dumps(notes, default=str, sort_keys=True)
        return Ranker(self.mean.numpy().copy(), self.deviation.numpy().copy(), layers, text)


def save_ranker(ranker: Ranker, path: Path) -> None:
    """Write a ranker as an npz file for `load_ranker`. Equal rankers give identical files."""
    arrays = {"mean": ranker.mean, "deviation": ranker.deviation}
    for k, (weight, bias) in enumerate(ranker.layers):
        arrays |= {f"weight{k}": weight, f"bias{k}": bias}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, notes=np.array(ranker.notes), **arrays)


class RankerTrainer(Trainer):
    """Training of a ranker of keypoints on pairs of synthetic views of images."""

    objective, sign = "score", -1
    purpose = "that ranks maxima of |det Hessian| by how likely other views show them again"
    measures = (
        "For each kind of pairs of views of the validation images: one-to-one repeatability "
        "within 1 and 3 px for several numbers of keypoints (in an image of 800x640 pixels), and "
        "the number of matches correct within 1 px divided by the number of keypoints"
    )
    weights_file = "best.npz"
    max_gradient_norm = 1.0
    average_decay = AVERAGE_DECAY
    network: RankerModule
    average: RankerModule

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: PointsTrainingOptions,
        num_workers: int = 0,
    ) -> None:
        self.options, self.num_workers, self.files = options, num_workers, images
        self.pairs = validation_pairs(validation, options.val_pairs)
        dataset = PairDataset(self.files, options)
        pairs = (dataset[2**31, number] for number in range(STATISTICS_PAIRS))  # not trained on
        features = np.concatenate([view.features for pair in pairs for view in pair.views])
        features = features.astype(np.float64)
        make = partial(RankerModule, features.mean(0), features.std(0))
        self.network = seeded(make, options.seed)
        self.average = copy.deepcopy(self.network)
        self.optimizers = [
            torch.optim.AdamW(
                self.network.parameters(), options.learning_rate, weight_decay=WEIGHT_DECAY
            )
        ]
        self.steps = options.steps
        self.milestones = {0} | milestones(options.steps, options.val_count)
        self.origin = digests(images, validation)
        self.notes = {"images": str(len(self.files))}

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches, lists of pairs, from step `first` on."""
        steps, pairs = range(first, self.steps), range(self.options.pairs)
        return DataLoader(
            PairDataset(self.files, self.options),
            batch_sampler=[[(step, number) for number in pairs] for step in steps],
            collate_fn=list,
            num_workers=self.num_workers,
            generator=torch.Generator(),
        )

    def loss(self, batch: Sequence[CandidatePair]) -> Tensor:
        """Return the mean loss of pairs. Pairs with under two candidates in a view have loss 0."""
        losses = [
            pair_loss(self.network, pair)
            for pair in batch
            if min(len(view.xy) for view in pair.views) > 1
        ]
        if not losses:
            return torch.stack([p.sum() for p in self.network.parameters()]).sum() * 0
        return torch.stack(losses).sum() / len(batch)

    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up into cosine annealing."""
        cosine = (1 + math.cos(math.pi * step / self.steps)) / 2
        rate = self.options.learning_rate * (FINAL_RATE + (1 - FINAL_RATE) * cosine)
        return rate * min(1.0, (step + 1) / WARM_UP_STEPS)

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs."""
        return measure(partial(detect_points, ranker=self.average.export({})), self.pairs)

    def save(self, path: Path, notes: Mapping[str, Any]) -> None:
        save_ranker(self.average.export(dict(notes)), path)

    def read_notes(self, path: Path) -> Mapping[str, Any]:
        notes: dict[str, Any] = json.loads(load_ranker(path).notes)
        return notes
